"""Finds the needle: the one dark, slender thing in the dish whose two ends are a tail and a tip."""

from __future__ import annotations

import cv2
import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.vision.images import RIM_PX, Picture, Wall
from magnetosuture_thread.vision.needle.measure import measure_needle
from magnetosuture_thread.vision.needle.measured_needle import MeasuredNeedle
from magnetosuture_thread.vision.needle.size import NeedleSize
from magnetosuture_thread.vision.needle.steel_map import COLOURED, SteelMap, closed_along_lines
from magnetosuture_thread.vision.sampling import middle, straighten
from magnetosuture_thread.vision.scene_mask import SceneMask

DARK = 0.55  # of the floor's brightness
INSIDE = 0.985  # part of the dish's radius that is looked at first, to stay off the rim
AT_WALL = "at the wall"
AT_WALL_PX = 2.0  # from what is looked at first, within which a thing may go on
WIDE_PX = 4.0  # a needle at least this wide is searched at half the size
MIN_AREA = 0.33  # of the needle's own
AROUND_PX = 24.0  # around a dark thing, that is measured on
AXIS_POINTS = 15
BEYOND_PX, BEYOND_ROWS = 14.0, 3  # beyond an end, that is looked at, and rows of it with steel that goes on there
OTHER = 0.03  # of the floor's brightness, that an opaque line is paler or more coloured
RIM_REACH_PX = 5.0  # off the wall, from which its rim is not mixed in
BODY, STEEL = 0.3, 0.75  # of the body's width, to both sides, that is dark there; of its darkness, at least
COLOUR_EDGE_PX = 1  # of a coloured line, whose colour is mixed with others
MAX_GAP = 4.0  # times the needle's width, that an opaque line hides along it
MAX_CANDIDATES = 6  # beyond which the image is no dish with a needle


def search_factor(width_px: float) -> int:
    """Return by how much an image may be shrunk to search for a needle of a width [px]."""
    return 2 if width_px >= WIDE_PX else 1


def find_needles(
    picture: Picture, view: DishView, dish_radius: float, size: NeedleSize, toward: np.ndarray | None = None
) -> tuple[list[MeasuredNeedle], list[str]]:
    """Find all that may be the needle.

    Dark pixels in the dish form components; each of about the right area is measured.

    Args:
        picture: the frame or a part of it.
        view: where the dish is in the picture, whose first pixel is (0, 0).
        dish_radius: [m]
        size: of the needle in the picture.
        toward: where the needle must point, u right and v down; settles which end is which where both look
            alike, as when the tip is blurred.

    Returns:
        The needles, and in words why each of the other candidates is none.
    """
    needles, refused = _measured(picture, view, dish_radius, size, toward)
    if not needles and refused:
        # What of a dark shape the tolerance leaves may have grown together with the needle, or the wall is beside it.
        needles, again = _measured(picture, view, dish_radius, size, toward, tight=True)
        refused = [reason for reason in refused if reason != AT_WALL] or again or refused
    if not needles and refused and picture.darkest is not picture.brightest:
        # A program may have drawn an opaque line across it.
        needles, _ = _measured(picture, view, dish_radius, size, toward, bridged=True)
    return needles, refused


def _measured(
    picture: Picture,
    view: DishView,
    dish_radius: float,
    size: NeedleSize,
    toward: np.ndarray | None,
    *,
    tight: bool = False,
    bridged: bool = False,
) -> tuple[list[MeasuredNeedle], list[str]]:
    """Find the needles of a size, shapes and wall cut out up to their very outlines if `tight`.

    If `bridged`, what a coloured line cuts in two is one; see `SteelMap.bridged`.
    """
    radius = dish_radius / view.metres_per_pixel
    radius = radius - RIM_PX if tight else INSIDE * radius
    wall = Wall(view.centre_px, radius)
    off_rim = Wall(view.centre_px, dish_radius / view.metres_per_pixel - RIM_REACH_PX)
    needles: list[MeasuredNeedle] = []
    refused: list[str] = []
    mask, factor = picture.mask, picture.factor
    gap = MAX_GAP * size.width_px if bridged else 0.0
    candidates = _dark_components(picture, view, radius, size.length_px * size.width_px, tight, gap)
    if len(candidates) > MAX_CANDIDATES:
        return [], [f"{len(candidates)} dark things"]
    for points in candidates:
        if not tight and np.hypot(*(points - view.centre_px).T).max() > radius - AT_WALL_PX:
            refused.append(AT_WALL)  # which may have cut off a part
            continue
        low, high = points.min(axis=0) - AROUND_PX, points.max(axis=0) + AROUND_PX
        near = mask is not None and mask.deepest(low, high) > 0.0

        steel = SteelMap.around(points, picture.brightest, picture.darkest, factor, wall)
        if bridged:
            steel = steel.bridged(_coloured(picture, steel.box), gap)
        if mask is not None and near:
            steel = steel.hidden_where(mask.depth[steel.box] > (0.0 if tight else mask.tolerance_px))
        if tight:
            steel = steel.hidden_where(wall.distances(steel.box) > radius)
        found = measure_needle(steel, size, toward)
        if mask is not None and near and isinstance(found, MeasuredNeedle) and _is_inside(mask, found, size.width_px):
            found = "inside of a shape of the scene"
        if isinstance(found, MeasuredNeedle) and _goes_on(picture, found, off_rim):
            found = "something over its end"
        if isinstance(found, MeasuredNeedle):
            needles.append(found)
        else:
            refused.append(found)
    return needles, refused


def _coloured(picture: Picture, box: tuple[slice, slice]) -> np.ndarray:
    """Return where a part of a picture is of a colour that neither floor nor steel has, with a line's blurred edge."""
    differs = np.zeros((box[0].stop - box[0].start, box[1].stop - box[1].start), np.float32)
    factor, shape = picture.factor, differs.shape
    for layer, sign in ((picture.brightest, 1.0), (picture.darkest, -1.0)):
        rows, columns = (slice(side.start // factor, -(-side.stop // factor)) for side in box)
        floor = cv2.resize(layer.floor[rows, columns], shape[::-1], interpolation=cv2.INTER_LINEAR)
        differs += sign * layer.pixels[box] / np.maximum(floor, 1)
    line = cv2.compare(differs, COLOURED, cv2.CMP_GT)
    return cv2.dilate(line, np.ones((3, 3), np.uint8), iterations=COLOUR_EDGE_PX) > 0


def _dark_components(
    picture: Picture, view: DishView, radius_px: float, area: float, tight: bool, gap_px: float
) -> list[np.ndarray]:
    """Return the pixels of each dark component of at least a part `MIN_AREA` of an area [px^2], shape (m, 2).

    Parts of it may be apart by a coloured line, up to `gap_px`.
    """
    factor = picture.factor
    shift = 0.5 * (factor - 1)
    u, v = ((c - shift) / factor for c in view.centre_px)
    radius = radius_px / factor
    left, top = (max(0, int(c - radius)) for c in (u, v))
    window = slice(top, max(top, int(v + radius) + 2)), slice(left, max(left, int(u + radius) + 2))
    dark = cv2.compare(
        picture.brightest.small[window], cv2.convertScaleAbs(picture.brightest.floor[window], alpha=DARK), cv2.CMP_LT
    )
    if dark is None or dark.size == 0:
        return []
    if gap_px:
        closed = closed_along_lines(dark, gap_px / factor)
        rows, columns = picture.brightest.pixels.shape
        line = _coloured(picture, (slice(0, rows), slice(0, columns))).astype(np.uint8)
        small = cv2.resize(line, picture.brightest.small.shape[::-1], interpolation=cv2.INTER_NEAREST)[window]
        dark = cv2.bitwise_or(dark, cv2.bitwise_and(closed, 255 * small))
    mask = np.zeros(dark.shape, np.uint8)
    cv2.circle(mask, (round((u - left) * 16), round((v - top) * 16)), round(radius * 16), 255, -1, cv2.LINE_8, 4)
    if picture.mask is not None:
        cut = picture.mask.inside if tight else picture.mask.solid
        cv2.subtract(mask, cut[window], mask)
    cv2.bitwise_and(dark, mask, dark)
    outlines, _ = cv2.findContours(dark, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    result = []
    for outline in outlines:
        # A component is no larger than its box, so most are passed over at once.
        x, y, wide, high = cv2.boundingRect(outline)
        if wide * high * factor**2 < MIN_AREA * area:
            continue
        own = np.zeros((high, wide), np.uint8)
        cv2.drawContours(own, [outline], -1, 255, -1, cv2.LINE_8, offset=(-x, -y))
        rows, columns = np.nonzero(own & dark[y : y + high, x : x + wide])
        if len(rows) * factor**2 < MIN_AREA * area:
            continue
        at = np.column_stack([columns + x + left, rows + y + top]).astype(float)
        result.append(at * factor + shift)
    return result


def _goes_on(picture: Picture, needle: MeasuredNeedle, wall: Wall) -> bool:
    """Say whether steel goes on beyond an end, behind an opaque line that is paler or more coloured than the floor.

    A line that crosses a needle slantwise grinds the part before it to a seeming point.
    """
    beyond = np.arange(0.0, BEYOND_PX, 1.0)
    aside = BODY * needle.width_px * np.array([-1.0, 0.0, 1.0])
    bright, dark = np.empty((2, len(beyond), len(aside)))
    u, v = (needle.arc.at(0.5 * needle.length_px) / picture.factor).astype(int)
    rows, columns = picture.brightest.floor.shape
    at = min(max(v, 0), rows - 1), min(max(u, 0), columns - 1)
    floor, darkest_floor = float(picture.brightest.floor[at]), float(picture.darkest.floor[at])
    for arc in (needle.arc.reversed_at(needle.length_px), needle.arc):
        start = float(arc.start[0]), float(arc.start[1]), arc.angle, arc.curvature
        straighten(picture.brightest.pixels, start, -beyond, aside, bright)
        straighten(picture.darkest.pixels, start, -beyond, aside, dark)
        other = np.maximum(dark - darkest_floor, bright - dark - (floor - darkest_floor)).mean(axis=1)
        inside = np.hypot(*(arc.at(-beyond) - wall.centre).T) < wall.radius
        steel = (bright < floor * (1.0 - STEEL * needle.contrast)).all(axis=1) & inside
        line = np.flatnonzero(other > OTHER * floor)
        if len(line) and steel[line[0] :].sum() >= BEYOND_ROWS:
            return True
    return False


def _is_inside(mask: SceneMask, needle: MeasuredNeedle, width: float) -> bool:
    """Say whether a needle's axis lies in shapes: that of a real one stays half its width off their outlines [px]."""
    depths = mask.depths(needle.arc.at(np.linspace(0.0, needle.length_px, AXIS_POINTS)))
    return middle(depths) > mask.tolerance_px - 0.5 * width
