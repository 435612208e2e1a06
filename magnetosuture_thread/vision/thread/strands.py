"""A line along a thread with what is measured on it, and how it is cut where the thread isn't visible."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.vision.needle.measured_needle import MeasuredNeedle
from magnetosuture_thread.vision.thread.appearance import (
    FAINTEST,
    MIN_SHARE,
    SURE_STRENGTH,
    Appearance,
    faintly_visible,
    runs,
    strengths,
)
from magnetosuture_thread.vision.thread.hiding import NEEDLE_PX

SPACING_PX = 2.0  # of a line's vertices
GAP_PX, OBJECT_GAP_PX = 13.0, 6.0  # a piece has no gap longer than this, and below an object none longer than that
MEETS_PX = 6.0  # from another piece's end, where the way through a crossing isn't known

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Strand:
    """A line along a thread.

    Attributes:
        points: its vertices, shape (m, 2) [px].
        strength: how much darker, or brighter, each is than the floor beside it, shape (m,) [grey levels].
        visible: where the thread is visible, shape (m,).
    """

    points: Points
    strength: NDArray[np.float64]
    visible: NDArray[np.bool_]

    def turned(self) -> Strand:
        """Return it from its other end."""
        return Strand(self.points[::-1], self.strength[::-1], self.visible[::-1])

    def part(self, first: int, last: int) -> Strand:
        """Return the vertices from one to before another."""
        return Strand(self.points[first:last], self.strength[first:last], self.visible[first:last])


def strand_along(
    gray: NDArray[np.uint8], thread: Appearance, points: Points, below: NDArray[np.bool_] | None = None
) -> Strand:
    """Return a line with where the thread is visible."""
    strength = strengths(gray, points, thread)
    shown = strength > max(FAINTEST, MIN_SHARE * thread.strength)
    if thread.strength < SURE_STRENGTH:
        shown |= faintly_visible(gray, points, thread, SPACING_PX)
    return Strand(points, strength, shown if below is None else shown & ~below)


def gaps_of(shown: NDArray[np.bool_], max_gap: float, begin: int) -> NDArray[np.bool_]:
    """Return where a walk isn't visible for more than a length, in gaps that begin at a vertex or later."""
    gone = np.zeros_like(shown)
    for first, last in runs(~shown):
        gone[first:last] = first >= begin and last < len(shown) and (last - first) * SPACING_PX > max_gap
    return gone


def first_clear_of(needle: MeasuredNeedle, walk: Points) -> int:
    """Return the first vertex of a walk that lies clear of the needle."""
    along, aside = needle.arc.coordinates(walk)
    near = (along > -NEEDLE_PX) & (along < needle.length_px + NEEDLE_PX)
    near &= np.abs(aside) < 0.5 * needle.width_px + 2.0 * NEEDLE_PX
    return len(near) if near.all() else max(1, int(np.argmin(near)))


def parts_without(line: Strand, gone: NDArray[np.bool_]) -> list[Strand]:
    """Return what is left of a walk, the part that leaves the needle first."""
    return [line.part(first, last) for first, last in runs(~gone) if last - first > 1]


def cut_where_met(strand: Strand, others: list[Points]) -> list[Strand]:
    """Cut the piece that leaves the needle where another piece begins on it: there the thread may go on along it."""
    ends = np.array([end for other in others for end in (other[0], other[-1])]).reshape(-1, 2)
    if not len(ends):
        return [strand]
    apart = np.hypot(*(strand.points[:, None] - ends[None]).transpose(2, 0, 1))
    inside = arc_lengths(strand.points)
    met = (apart.min(axis=1) < MEETS_PX) & (inside > MEETS_PX) & (inside < inside[-1] - 2.0 * MEETS_PX)
    found = runs(met)
    if not found:
        return [strand]
    parts = [strand.part(0, found[0][0])]
    for (_, first), last in zip(found, [begin for begin, _ in found[1:]] + [len(met)], strict=True):
        parts.append(strand.part(first, last))
    return [parts[0], *(part for part in parts[1:] if len(part.points) * SPACING_PX > GAP_PX)]


def without_hidden_end(strand: Strand) -> Strand:
    """Return the piece that leaves the needle without its end where nothing is visible."""
    shown = np.flatnonzero(strand.visible)
    return strand.part(0, max(2, int(shown[-1]) + 1)) if len(shown) else strand


def below_needle(needle: MeasuredNeedle, points: Points) -> NDArray[np.bool_]:
    """Return which points the needle hides, with its blurred edge."""
    along, aside = needle.arc.coordinates(points)
    return np.asarray(
        (along > 1.0) & (along < needle.length_px + NEEDLE_PX) & (np.abs(aside) < 0.5 * needle.width_px + 1.0)
    )
