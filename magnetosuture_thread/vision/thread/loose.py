"""Tells whether there is a thread in the dish that does not leave the needle."""

from __future__ import annotations

import cv2
import numpy as np

from magnetosuture_thread.vision.images import Picture, Wall
from magnetosuture_thread.vision.needle.measured_needle import MeasuredNeedle
from magnetosuture_thread.vision.sampling import middle

WINDOW_PX = 7  # wider than the thread looks
FAINTEST, NOISES = 8.0, 5.0  # grey levels, and how many times the noise, that a ridge is stronger than at least
OFF_WALL_PX = 8.0  # of what is looked at
COVERED_PX = 5.0  # beside and beyond the needle, where a thread is its own
TAIL_PX = 2  # beyond, up to which what leaves the tail begins
BRANCH = 0.2  # of the length looked for, that a line on one side of the needle has at least
_WINDOW = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (WINDOW_PX, WINDOW_PX))


def has_loose_thread(picture: Picture, needle: MeasuredNeedle, wall: Wall, length: float) -> bool:
    """Say whether something as long as a thread lies away from a needle.

    Args:
        picture: the frame or a part of it.
        needle: in the picture's pixels.
        wall: of the dish.
        length: half of its outline's, at least [px].
    """
    smooth = cv2.GaussianBlur(picture.darkest.pixels, (5, 5), 0.7)
    ridge = cv2.morphologyEx(smooth, cv2.MORPH_BLACKHAT, _WINDOW)
    noise = middle(ridge[::5, ::5])
    strong = (ridge > noise + max(FAINTEST, NOISES * noise)).astype(np.uint8)
    whole = slice(0, picture.shape[0]), slice(0, picture.shape[1])
    strong[wall.distances(whole) > wall.radius - OFF_WALL_PX] = 0
    if picture.mask is not None:
        strong[np.abs(picture.mask.depth) < picture.mask.band_px] = 0
        strong[picture.mask.depth > 0.0] = 0
    # What leaves the tail may be its own thread, of which nothing was followed, and so may one line that leaves its
    # side, folded below it. One that leaves it on two sides passes it.
    axis = needle.arc.at(np.linspace(-COVERED_PX, needle.length_px + COVERED_PX, 24))
    at = np.round(axis * 16.0).astype(np.int32)
    covered = np.zeros_like(strong)
    cv2.polylines(covered, [at], False, 1, round(needle.width_px + 2.0 * COVERED_PX), cv2.LINE_8, 4)
    leaves = cv2.dilate(strong & covered, np.ones((3, 3), np.uint8))
    strong[covered > 0] = 0
    u, v = np.round(needle.tail_px).astype(int)
    cv2.circle(strong, (int(u), int(v)), round(0.5 * needle.width_px + COVERED_PX + TAIL_PX), 1, -1)
    cv2.floodFill(strong, None, (int(u), int(v)), 0, flags=8)
    outlines, _ = cv2.findContours(strong, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    passing: list[float] = []
    for outline in outlines:
        extent = 0.5 * cv2.arcLength(outline, True)
        touches = bool(leaves[outline[:, 0, 1], outline[:, 0, 0]].any())
        if extent > length and not touches:
            return True
        if touches and extent > BRANCH * length:
            passing.append(extent)
    return len(passing) > 1 and sum(passing) > length
