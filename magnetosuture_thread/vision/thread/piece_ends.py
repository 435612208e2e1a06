"""Tells why a piece of a thread ends: below something, at the frame, at the wall, or on bare floor."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.thread_observation import PieceEnd
from magnetosuture_thread.vision.images import Picture
from magnetosuture_thread.vision.needle.measured_needle import MeasuredNeedle
from magnetosuture_thread.vision.thread.appearance import FAINTEST, Appearance, across, sampled, sampled_colours
from magnetosuture_thread.vision.thread.hiding import Hiding
from magnetosuture_thread.vision.thread.order import end_direction
from magnetosuture_thread.vision.thread.strands import SPACING_PX, Strand, below_needle

NEAR_PX = 7.0  # from an end up to which something hides the thread that goes on there
AHEAD_PX, AHEAD = (3.0, 5.0, 7.0, 9.0, 11.0), math.radians(50.0)  # beyond an end, where floor must be seen
BESIDE_POINTS = 6  # last vertices of a piece, beside which its floor is measured
BARE_STEP, BARE_CHANGE = 0.025, 0.06  # of the floor's light: off a straight line from beside an end to beyond; in all
BARE_COLOUR, FAR_RINGS = 0.03, 3  # of it, by which colours may change apart, on average over the farthest rings
GOES_ON = 0.5  # of its strength, with which a thread would go on beyond an end
SURE_STRENGTH = 2.0  # of the faintest that is seen, that a thread must have where it is seen to end


def _off_line() -> NDArray[np.float64]:
    """Return the matrix that takes light at the vertices and ahead to what it is off a straight line fitted to it."""
    line = np.vander(np.concatenate([SPACING_PX * np.arange(1 - BESIDE_POINTS, 1), AHEAD_PX]), 2)
    return np.asarray(np.eye(len(line)) - line @ np.linalg.pinv(line))


OFF_LINE = _off_line()


def why_it_ends(
    picture: Picture,
    gray: NDArray[np.uint8],
    thread: Appearance,
    strand: Strand,
    needle: MeasuredNeedle,
    hiding: Hiding,
) -> tuple[PieceEnd, int]:
    """Tell why a piece ends at its last point, and the number of the area that it runs into, 0 for none."""
    point, way = strand.points[-1], end_direction(strand.points)
    aside = np.array([-way[1], way[0]])
    rows, columns = gray.shape
    for ahead in np.arange(0.0, NEAR_PX + 0.5):
        for beside in (0.0, -1.5, 1.5):
            at = point + ahead * way + beside * aside
            area = hiding.area_at(at)
            if area > 0:
                return PieceEnd.COVERED, area
            if not (1.0 <= at[0] < columns - 2 and 1.0 <= at[1] < rows - 2):
                return PieceEnd.FRAME, 0
            if area < 0:
                return PieceEnd.UNKNOWN, 0
    return (PieceEnd.FREE if is_bare_beyond(picture, gray, thread, strand, needle) else PieceEnd.UNKNOWN), 0


def is_bare_beyond(
    picture: Picture, gray: NDArray[np.uint8], thread: Appearance, strand: Strand, needle: MeasuredNeedle
) -> bool:
    """Say whether there is nothing but floor beyond a piece's last point, like that beside it, where it is strong."""
    if len(strand.points) < BESIDE_POINTS:
        return False
    usual = float(_medians(strand.strength[None, -BESIDE_POINTS:])[0])
    if usual < max(SURE_STRENGTH * FAINTEST, 2.0 * SURE_STRENGTH * thread.noise):
        return False
    point, way = strand.points[-1], end_direction(strand.points)
    angle = math.atan2(way[1], way[0])
    turns = np.linspace(-AHEAD, AHEAD, 9)
    reach = np.array(AHEAD_PX)
    ahead = point + reach[:, None, None] * np.stack([np.cos(angle + turns), np.sin(angle + turns)], axis=-1)[None]
    rows, columns = gray.shape
    if ahead.min() < 2.0 or (ahead > np.array([columns, rows]) - 3.0).any():
        return False
    if below_needle(needle, ahead.reshape(-1, 2)).any():
        return False
    aside = thread.beside_px + np.array([0.5, 1.5, 2.5])
    last = strand.points[-BESIDE_POINTS - 1 :]  # with one more, for the direction at the first
    beside = across(last, np.concatenate([-aside, aside]))[-BESIDE_POINTS:]
    floor, beyond = float(_medians(sampled(gray, beside).reshape(1, -1))[0]), sampled(gray, ahead)
    off = beyond[1:] - floor if thread.pale else floor - beyond[1:]
    if float(off.max()) > max(GOES_ON * usual, FAINTEST + 3.0 * thread.noise):
        return False
    light = np.vstack([_medians(sampled_colours(picture.image, at)) for at in (beside, ahead)])
    light /= np.maximum(_medians(light[None, : len(beside)])[0], 1.0)
    mean = light.mean(axis=1)
    step = np.abs(OFF_LINE @ mean).max()
    even = step < BARE_STEP and np.abs(mean - 1.0).max() < BARE_CHANGE
    return bool(even and np.ptp(light[-FAR_RINGS:].mean(axis=0)) < BARE_COLOUR)


def _medians(values: NDArray[Any]) -> NDArray[Any]:
    """Return medians along the second axis; for few values numpy's own takes several times as long."""
    ordered, count = np.sort(values, axis=1), values.shape[1]
    return np.asarray(0.5 * (ordered[:, (count - 1) // 2] + ordered[:, count // 2]))
