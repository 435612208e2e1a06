"""Tells whether there is a thread in the dish that does not leave the needle."""

from __future__ import annotations

import cv2
import numpy as np

from magnetosuture_thread.vision.images import Picture, Wall
from magnetosuture_thread.vision.needle.measured_needle import MeasuredNeedle
from magnetosuture_thread.vision.sampling import middle

WINDOW_PX = 7  # wider than the thread looks
FAINTEST, NOISES = 8.0, 5.0  # grey levels, and how many times the noise, that a ridge is stronger than at least
DARK = 15.0  # the same of a thread that is dark beyond doubt
BESIDE_PX = 8.0  # of what is followed, where its edges and its shadow are
OFF_WALL_PX = 8.0  # of what is looked at
COVERED_PX = 5.0  # beside and beyond the needle, where a thread is its own
TAIL_PX = 2  # beyond, up to which what leaves the tail begins
SPLIT_PX = 4  # around that, within which a line that touches it is cut into what lies on both sides
BRANCH = 0.2  # of the length looked for, that a line on one side has at least
_WINDOW = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (WINDOW_PX, WINDOW_PX))


def has_loose_thread(
    picture: Picture, needle: MeasuredNeedle, wall: Wall, length: float, followed: np.ndarray | None = None
) -> bool:
    """Say whether something as long as a thread lies away from a needle.

    Args:
        picture: the frame or a part of it.
        needle: in the picture's pixels.
        wall: of the dish.
        length: half of its outline's, at least [px].
        followed: a faint or pale line from the tail on, shape (m, 2) [px]: only what lies elsewhere and is dark beyond
            doubt counts then.
    """
    smooth = cv2.GaussianBlur(picture.darkest.pixels, (5, 5), 0.7)
    ridge = cv2.morphologyEx(smooth, cv2.MORPH_BLACKHAT, _WINDOW)
    noise = middle(ridge[::5, ::5])
    faintest = FAINTEST if followed is None else DARK
    strong = (ridge > noise + max(faintest, NOISES * noise)).astype(np.uint8)
    if followed is not None:
        at = np.round(followed * 16.0).astype(np.int32)
        cv2.polylines(strong, [at], False, 0, round(2.0 * BESIDE_PX), cv2.LINE_8, 4)
    whole = slice(0, picture.shape[0]), slice(0, picture.shape[1])
    strong[wall.distances(whole) > wall.radius - OFF_WALL_PX] = 0
    if picture.mask is not None:
        strong[np.abs(picture.mask.depth) < picture.mask.band_px] = 0
        strong[picture.mask.depth > 0.0] = 0
    # What leaves the tail in one direction may be its own thread, of which nothing was followed, and so may one line
    # that leaves its side, folded below it. One that leaves either on two sides, or passes close by, passes it.
    axis = needle.arc.at(np.linspace(-COVERED_PX, needle.length_px + COVERED_PX, 24))
    at = np.round(axis * 16.0).astype(np.int32)
    width = round(needle.width_px + 2.0 * COVERED_PX)
    covered, around = np.zeros_like(strong), np.zeros_like(strong)
    cv2.polylines(covered, [at], False, 1, width, cv2.LINE_8, 4)
    cv2.polylines(around, [at], False, 1, width + 2 * SPLIT_PX, cv2.LINE_8, 4)
    leaves = cv2.dilate(strong & covered, np.ones((3, 3), np.uint8))
    strong[covered > 0] = 0
    u, v = np.round(needle.tail_px).astype(int)
    tail, radius = (int(u), int(v)), round(0.5 * needle.width_px + COVERED_PX + TAIL_PX)
    cv2.circle(strong, tail, radius, 1, -1)
    at_tail = strong.copy()
    cv2.floodFill(strong, None, tail, 0, flags=8)
    at_tail -= strong
    cv2.circle(at_tail, tail, radius + SPLIT_PX, 0, -1)
    outlines, _ = cv2.findContours(strong, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    touching = np.zeros_like(strong)
    for index, outline in enumerate(outlines):
        if leaves[outline[:, 0, 1], outline[:, 0, 0]].any():
            cv2.drawContours(touching, outlines, index, 1, -1)
        elif _extent(outline) > length:
            return True
    lines = (touching & strong | at_tail) & ~around
    branches, _ = cv2.findContours(lines, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    extents = [extent for extent in map(_extent, branches) if extent > BRANCH * length]
    return len(extents) > 1 and sum(extents) > length


def _extent(outline: np.ndarray) -> float:
    """Return the length of a line, half of its outline's [px]."""
    return 0.5 * float(cv2.arcLength(outline, True))
