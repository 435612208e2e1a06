"""What a frame shows of the thread: its pieces, which of their ends are real, and what hides the rest."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.vision.images import Picture, Wall
from magnetosuture_thread.vision.needle.measured_needle import MeasuredNeedle
from magnetosuture_thread.vision.thread.appearance import (
    FAINTEST,
    GAP_PX,
    MIN_SHARE,
    OBJECT_GAP_PX,
    SPACING_PX,
    Appearance,
    Gray,
    Strand,
    appearance_of,
    below_needle,
    deviations,
    first_clear_of,
    gaps_of,
    parts_without,
    respaced,
    runs,
    strand_along,
    strengths,
    tangents_of,
)
from magnetosuture_thread.vision.thread.centreline import smooth_without_needle
from magnetosuture_thread.vision.thread.hiding import Hiding, find_hiding
from magnetosuture_thread.vision.thread.order import Order, Piece, find_order
from magnetosuture_thread.vision.thread.pieces import (
    MIN_LENGTH_PX,
    find_pieces,
    fresh_parts,
    is_bare_beyond,
    why_it_ends,
)

LENGTH_TOLERANCE = 0.03  # of the thread's length, that a whole thread may be seen shorter or longer by
LENGTH_ERROR = 0.01  # of an arc length: by noise along the walk
END_ERROR_PX = 4.0  # of an arc length, by the places where pieces begin and end
SCALE_ERROR = 0.001  # see `look`
MEETS_PX = 6.0  # from another piece's end, where the way through a crossing isn't known


def observe(
    picture: Picture,
    needle: MeasuredNeedle,
    walk: Points,
    view: DishView,
    radius: float,
    thread_length: float,
    *,
    scale_known: bool,
    search: bool = True,
) -> ThreadObservation:
    """Tell what a picture shows of the thread.

    The walk from the tail is the first piece, up to where the thread isn't seen for more than `GAP_PX`. It is complete
    if it ends on bare floor and is as long as the thread. Else all other pieces are looked for, and joined where
    nothing but a smooth way below what hides the thread is possible; see `find_order`.

    Args:
        picture: the frame or a part of it.
        needle: in the picture's pixels.
        walk: along the thread from the needle's tail on, shape (m, 2), m = 1 if none is seen [px].
        view: of the dish, in the picture's pixels.
        radius: of the dish [m].
        thread_length: of the whole thread [m].
        scale_known: whether the scale is given, so that it has no error.
        search: whether to look for other pieces, where the walk doesn't show all.
    """
    if len(walk) < 2 or arc_lengths(walk)[-1] < SPACING_PX:
        return ThreadObservation()
    gray = smooth_without_needle(picture.darkest, picture.factor, needle)
    walk = respaced(walk, SPACING_PX)
    below = below_needle(needle, walk)
    thread = appearance_of(picture, gray, walk, ~below)
    line = strand_along(gray, thread, walk, below)
    length = thread_length / view.metres_per_pixel
    begin = first_clear_of(needle, walk)
    gone = gaps_of(line.visible, GAP_PX, begin)
    parts = parts_without(line, gone)
    in_dish = _Dish(view, thread, scale_known)
    plain = strengths(gray, walk, thread, two_sided=True) > max(FAINTEST, MIN_SHARE * thread.strength)
    gapless = not gone.any() and not gaps_of(plain | below, OBJECT_GAP_PX, begin).any()
    if gapless and _is_whole(line, length):  # Nothing is left of the thread to look for.
        ends_bare = is_bare_beyond(picture, gray, thread, parts[0], needle)
        end = PieceEnd.FREE if ends_bare else PieceEnd.UNKNOWN
        whole = in_dish.piece(line, PieceEnd.TAIL, end, (0.0, 0.0), 1.0)
        return ThreadObservation((whole,), complete=ends_bare, hidden=(_outline(needle, view),))
    if not search:
        first = in_dish.piece(parts[0], PieceEnd.TAIL, PieceEnd.UNKNOWN, (0.0, 0.0), 1.0)
        return ThreadObservation((first,), hidden=(_outline(needle, view),))
    wall = Wall(view.centre_px, radius / view.metres_per_pixel)
    hiding = find_hiding(picture, needle, wall, view.metres_per_pixel)
    on_floor = np.array([hiding.area_at(point) == 0 for point in line.points])
    line = Strand(line.points, line.strength, line.visible & on_floor)
    parts = parts_without(
        line, gaps_of(line.visible, GAP_PX, begin) | gaps_of(line.visible | below, OBJECT_GAP_PX, begin)
    )
    begun, shown = parts[0], np.flatnonzero(parts[0].visible)
    if len(shown):
        begun = begun.part(0, max(2, int(shown[-1]) + 1))
    known = [begun.points]
    for part in parts[1:]:  # beyond what the walk only guessed, where it may have gone around twice
        if part.visible.sum() > 1:
            first, last = np.flatnonzero(part.visible)[[0, -1]]
            fresh = fresh_parts(part.points[first : last + 1], known)
            known += [each for each in fresh if len(each) > MIN_LENGTH_PX]
    remaining = length * (1.0 + LENGTH_TOLERANCE) - sum(float(arc_lengths(each)[-1]) for each in known)
    others = known[1:] + find_pieces(picture, gray, thread, hiding, known, remaining)
    strands = _cut_where_met(begun, others)
    strands += [strand_along(gray, thread, respaced(other, SPACING_PX)) for other in others]
    return _joined(picture, gray, thread, needle, hiding, strands, in_dish, length)


def _cut_where_met(strand: Strand, others: list[Points]) -> list[Strand]:
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


@dataclass(frozen=True)
class _Dish:
    """Turns pieces in pixels into those in the dish."""

    view: DishView
    thread: Appearance
    scale_known: bool

    def piece(
        self,
        strand: Strand,
        first: PieceEnd,
        last: PieceEnd,
        arc_length: tuple[float, float],
        confidence: float,
        *,
        direction_known: bool = True,
    ) -> ThreadPiece:
        """Return a piece; `arc_length` in pixels."""
        scale = self.view.metres_per_pixel
        points = self.view.to_dish(strand.points)
        deviation = scale * deviations(self.thread, strand)
        if not self.scale_known:  # A wrong scale shifts what is far from the dish's centre.
            along = tangents_of(points)
            deviation = np.hypot(deviation, SCALE_ERROR * (points[:, 0] * along[:, 1] - points[:, 1] * along[:, 0]))
        low, high = (float(scale * value) for value in arc_length)
        return ThreadPiece(points, deviation, first, last, (low, high), direction_known, confidence)


def _joined(
    picture: Picture,
    gray: Gray,
    thread: Appearance,
    needle: MeasuredNeedle,
    hiding: Hiding,
    strands: list[Strand],
    in_dish: _Dish,
    length: float,
) -> ThreadObservation:
    """Order the pieces, and tell why each of them ends."""
    ends, pieces = [], []
    for number, strand in enumerate(strands):
        first, area = PieceEnd.TAIL, 0
        if number:
            first, area = why_it_ends(picture, gray, thread, strand.turned(), needle, hiding)
        last, last_area = why_it_ends(picture, gray, thread, strand, needle, hiding)
        ends.append([first, last])
        pieces.append(Piece(strand.points, (area, last_area)))
    longest = length * (1.0 + LENGTH_TOLERANCE)
    order = find_order(pieces, hiding, (length * (1.0 - LENGTH_TOLERANCE), longest), in_dish.view.metres_per_pixel)
    _tell_free(ends, order, length)
    result = []
    for placed in (*order.placed, *order.wide):
        strand, (first, last) = strands[placed.index], ends[placed.index]
        if placed.turned:
            strand, first, last = strand.turned(), last, first
        low, high = placed.arc_length
        if placed.index:
            low = max(0.0, low - LENGTH_ERROR * low - END_ERROR_PX)
            high = min(high + LENGTH_ERROR * high + END_ERROR_PX, max(low, longest - pieces[placed.index].length))
        confidence = 1.0 if not placed.index else order.share if placed in order.placed else 0.6
        result.append(in_dish.piece(strand, first, last, (low, high), confidence))
    told = {placed.index for placed in (*order.placed, *order.wide)}
    nowhere = (math.nan, math.nan)
    for number in sorted(set(range(len(strands))) - told)[:24]:
        first, last = ends[number]
        result.append(in_dish.piece(strands[number], first, last, nowhere, 0.3, direction_known=False))
    alone = len(strands) == 1 and ends[0][1] is PieceEnd.FREE and _is_whole(strands[0], length)
    outlines = [in_dish.view.to_dish(outline) for outline in hiding.outlines()]
    return ThreadObservation(tuple(result), alone, tuple(outlines))


def _is_whole(strand: Strand, length: float) -> bool:
    """Say whether a piece is as long as the thread."""
    return bool(abs(arc_lengths(strand.points)[-1] / length - 1.0) < LENGTH_TOLERANCE)


def _tell_free(ends: list[list[PieceEnd]], order: Order, length: float) -> None:
    """Let an end on bare floor count as the thread's only where it is the only one, and the lengths add up."""
    bare = [(number, side) for number, both in enumerate(ends) for side in (0, 1) if both[side] is PieceEnd.FREE]
    low, high = order.length
    adds_up = low < length * (1.0 + LENGTH_TOLERANCE) + END_ERROR_PX
    adds_up &= high > length * (1.0 - LENGTH_TOLERANCE) - END_ERROR_PX
    if order.last is not None and bare == [(order.last[0], 0 if order.last[1] else 1)] and adds_up:
        return
    for number, side in bare:
        ends[number][side] = PieceEnd.UNKNOWN


def _outline(needle: MeasuredNeedle, view: DishView) -> Points:
    """Return the outline of a needle in the dish frame, shape (m, 2) [m]."""
    at, half = np.linspace(0.0, needle.length_px, 9), 0.5 * needle.width_px
    return view.to_dish(np.vstack([needle.arc.at(at, half), needle.arc.at(at[::-1], -half)]))
