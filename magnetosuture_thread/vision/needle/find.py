"""Finds the needle: the one dark, slender thing in the dish whose two ends are a tail and a tip."""

from __future__ import annotations

import cv2
import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.vision.images import RIM_PX, Picture, Wall, without_wall
from magnetosuture_thread.vision.needle.arc import Arc, fit_arc
from magnetosuture_thread.vision.needle.body import MeasuredNeedle, measure_body
from magnetosuture_thread.vision.needle.overlaid import ALIKE, measure_overlaid, points_forward
from magnetosuture_thread.vision.needle.steel import SteelMap
from magnetosuture_thread.vision.sampling import middle
from magnetosuture_thread.vision.scene_mask import SceneMask

DARK = 0.55  # of the floor's brightness
INSIDE = 0.985  # part of the dish's radius that is looked at first, to stay off the rim
AT_WALL = "at the wall"
AT_WALL_PX = 2.0  # from what is looked at first, within which a thing may go on
WIDE_PX = 4.0  # a needle at least this wide is searched at half the size
MIN_AREA = 0.33  # of the needle's own
ON_AXIS = 0.85  # of a needle's dark pixels lie along one arc; more beside it belong to what touches it
AROUND_PX = 24.0  # around a dark thing, that is measured on
AXIS_POINTS = 15
MAX_WIDTH, MORE_WIDTH_PX = 1.2, 0.3  # of the width, and beyond, that a body alone looks wide
MAX_CANDIDATES = 6  # beyond which the image is no dish with a needle


def search_factor(width_px: float) -> int:
    """Return by how much an image may be shrunk to search for a needle of a width [px]."""
    return 2 if width_px >= WIDE_PX else 1


def find_needles(
    picture: Picture, view: DishView, dish_radius: float, length: float, width: float, toward: np.ndarray | None = None
) -> tuple[list[MeasuredNeedle], list[str]]:
    """Find all that may be the needle.

    Dark pixels in the dish form components; each of about the right area is measured.

    Args:
        picture: the frame or a part of it.
        view: where the dish is in the picture, whose first pixel is (0, 0).
        dish_radius: [m]
        length: of the needle [m].
        width: of the needle's body [m].
        toward: where the needle must point, u right and v down; settles which end is which where both look
            alike, as when the tip is blurred.

    Returns:
        The needles, and in words why each of the other candidates is none.
    """
    expected, thickness = length / view.metres_per_pixel, width / view.metres_per_pixel
    needles, refused = _measured(picture, view, dish_radius, expected, thickness, toward)
    if not needles and refused:
        # What of a dark shape the tolerance leaves may have grown together with the needle, or the wall is beside it.
        needles, again = _measured(picture, view, dish_radius, expected, thickness, toward, tight=True)
        refused = [reason for reason in refused if reason != AT_WALL] or again or refused
    return needles, refused


def _measured(
    picture: Picture,
    view: DishView,
    dish_radius: float,
    expected: float,
    thickness: float,
    toward: np.ndarray | None,
    *,
    tight: bool = False,
) -> tuple[list[MeasuredNeedle], list[str]]:
    """Find the needles of a length and a width [px], shapes and wall cut out up to their very outlines if `tight`."""
    radius = dish_radius / view.metres_per_pixel
    radius = radius - RIM_PX if tight else INSIDE * radius
    wall = Wall(view.centre_px, radius)
    needles: list[MeasuredNeedle] = []
    refused: list[str] = []
    mask, factor = picture.mask, picture.factor
    candidates = _dark_components(picture, view, radius, expected * thickness, tight)
    if len(candidates) > MAX_CANDIDATES:
        return [], [f"{len(candidates)} dark things"]
    for points in candidates:
        if not tight and np.hypot(*(points - view.centre_px).T).max() > radius - AT_WALL_PX:
            refused.append(AT_WALL)  # which may have cut off a part
            continue
        low, high = points.min(axis=0) - AROUND_PX, points.max(axis=0) + AROUND_PX
        near = mask is not None and mask.deepest(low, high) > 0.0

        alone, steel = picture.brightest, SteelMap.around(points, picture.brightest, picture.darkest, factor, wall)
        if mask is not None and near:  # A strip along the needle takes its ground from beside it, which a shape may be.
            deep = 0.0 if tight else mask.tolerance_px
            alone = alone.replaced(mask.without_shapes(alone.pixels, alone.floor, low, high, deep))
            steel = steel.hidden_where(mask.depth[steel.box] > deep)
        if tight:
            alone = alone.replaced(without_wall(alone, factor, wall, low, high))
            steel = steel.hidden_where(wall.distances(steel.box) > radius)
        found = _measured_alone(alone.pixels, points, expected, thickness, toward)
        if isinstance(found, MeasuredNeedle) and toward is None and not _is_sure(steel, found, thickness):
            found = ALIKE
        if isinstance(found, str):
            overlaid = measure_overlaid(steel, expected, thickness, toward)
            found = overlaid if isinstance(overlaid, MeasuredNeedle) else found
        if mask is not None and near and isinstance(found, MeasuredNeedle) and _is_inside(mask, found, thickness):
            found = "inside of a shape of the scene"
        if isinstance(found, MeasuredNeedle):
            needles.append(found)
        else:
            refused.append(found)
    return needles, refused


def _is_sure(steel: SteelMap, needle: MeasuredNeedle, width: float) -> bool:
    """Say whether a needle that was measured alone points the way it seems to.

    A thread beside the body widens it, and can make the tail look like the tip.
    """
    return needle.width_px < MORE_WIDTH_PX + MAX_WIDTH * width and points_forward(steel, needle)


def _measured_alone(
    gray: np.ndarray, points: np.ndarray, expected: float, thickness: float, toward: np.ndarray | None
) -> MeasuredNeedle | str:
    """Measure a component that is nothing but a needle; see `measure_body`."""
    guess = _rough_axis(points, thickness)
    if guess is None:
        return "no arc"
    arc, first, last = guess
    if not 0.6 * expected < last - first < 1.4 * expected:
        return f"{last - first:.0f} px long instead of {expected:.0f}"
    if abs(arc.curvature) * expected > 1.25 * np.pi:
        return "bent beyond a half circle"
    return measure_body(gray, arc, first, last, expected, thickness, toward)


def _dark_components(picture: Picture, view: DishView, radius_px: float, area: float, tight: bool) -> list[np.ndarray]:
    """Return the pixels of each dark component of at least a part `MIN_AREA` of an area [px^2], shape (m, 2)."""
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


def _is_inside(mask: SceneMask, needle: MeasuredNeedle, width: float) -> bool:
    """Say whether a needle's axis lies in shapes: that of a real one stays half its width off their outlines [px]."""
    depths = mask.depths(needle.arc.at(np.linspace(0.0, needle.length_px, AXIS_POINTS)))
    return middle(depths) > mask.tolerance_px - 0.5 * width


def _rough_axis(points: np.ndarray, width: float) -> tuple[Arc, float, float] | None:
    """Return an arc through a component, and the lengths along it between which it lies; None if it is no arc."""
    kept = points
    for _ in range(3):
        if len(kept) < 8:
            return None
        arc = fit_arc(kept)
        along, aside = arc.coordinates(points)
        near = np.abs(aside) < 0.5 * width + 1.5
        before, kept = len(kept), points[near]
        if len(kept) == before:
            break
    inner = np.abs(aside) < 0.5 * width + 2.0
    if inner.mean() < ON_AXIS:
        return None
    return arc, float(along[inner].min()) - 0.5, float(along[inner].max()) + 0.5
