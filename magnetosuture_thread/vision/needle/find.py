"""Finds the needle: the one dark, slender thing in the dish whose two ends are a tail and a tip."""

from __future__ import annotations

import cv2
import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.vision.images import RIM_PX, Picture, Wall
from magnetosuture_thread.vision.needle.arc import MeasuredNeedle, NeedleSize
from magnetosuture_thread.vision.needle.measure import measure_needle
from magnetosuture_thread.vision.needle.steel_map import SteelMap
from magnetosuture_thread.vision.sampling import middle
from magnetosuture_thread.vision.scene_mask import SceneMask

DARK = 0.55  # of the floor's brightness
AT_WALL = "at the wall"
MIN_AREA = 0.33  # of the needle's own
AROUND_PX = 24.0  # around a dark thing, that is measured on


def search_factor(width_px: float) -> int:
    """Return by how much an image may be shrunk to search for a needle of a width [px]."""
    return 2 if width_px >= 4.0 else 1


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
    return needles, refused


def _measured(
    picture: Picture,
    view: DishView,
    dish_radius: float,
    size: NeedleSize,
    toward: np.ndarray | None,
    *,
    tight: bool = False,
) -> tuple[list[MeasuredNeedle], list[str]]:
    """Find the needles of a size, shapes and wall cut out up to their very outlines if `tight`."""
    radius = dish_radius / view.metres_per_pixel
    radius = radius - RIM_PX if tight else 0.985 * radius  # at first off the rim
    wall = Wall(view.centre_px, radius)
    needles: list[MeasuredNeedle] = []
    refused: list[str] = []
    mask, factor = picture.mask, picture.factor
    candidates = _dark_components(picture, view, radius, size.length_px * size.width_px, tight)
    if len(candidates) > 6:
        return [], [f"{len(candidates)} dark things"]
    for points in candidates:
        if not tight and np.hypot(*(points - view.centre_px).T).max() > radius - 2.0:
            refused.append(AT_WALL)  # which may have cut off a part
            continue
        low, high = points.min(axis=0) - AROUND_PX, points.max(axis=0) + AROUND_PX
        near = mask is not None and mask.deepest(low, high) > 0.0

        steel = SteelMap.around(points, picture.brightest, picture.darkest, factor, wall)
        if mask is not None and near:
            steel = steel.hidden_where(mask.depth[steel.box] > (0.0 if tight else mask.tolerance_px))
        if tight:
            steel = steel.hidden_where(wall.distances(steel.box) > radius)
        found = measure_needle(steel, size, toward)
        if mask is not None and near and isinstance(found, MeasuredNeedle) and _is_inside(mask, found, size.width_px):
            found = "inside of a shape of the scene"
        if isinstance(found, MeasuredNeedle):
            needles.append(found)
        else:
            refused.append(found)
    return needles, refused


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
    depths = mask.depths(needle.arc.at(np.linspace(0.0, needle.length_px, 15)))
    return middle(depths) > mask.tolerance_px - 0.5 * width
