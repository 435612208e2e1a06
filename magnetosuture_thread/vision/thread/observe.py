"""What a frame shows of the thread: its pieces, which of their ends are real, and what hides the rest."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.vision.images import Picture, Wall
from magnetosuture_thread.vision.needle.body import MeasuredNeedle
from magnetosuture_thread.vision.needle.erase import without_needle
from magnetosuture_thread.vision.thread.appearance import (
    BLUR_PX,
    FAINTEST,
    SEEN_SHARE,
    Appearance,
    across,
    appearance_of,
    deviations,
    resampled,
    runs,
    sampled,
    strengths,
    tangents_of,
)
from magnetosuture_thread.vision.thread.hiding import NEEDLE_PX, Hiding, find_hiding
from magnetosuture_thread.vision.thread.order import Order, Piece, find_order, outward
from magnetosuture_thread.vision.thread.pieces import MIN_LENGTH_PX, find_pieces, fresh_parts

LENGTH_TOLERANCE = 0.03  # of the thread's length, that a whole thread may be seen shorter or longer by
LENGTH_ERROR = 0.01  # of an arc length: by noise along the walk
END_ERROR_PX = 4.0  # of an arc length, by the places where pieces begin and end
SPACING_PX = 2.0  # of a piece's points
GAP_PX, OBJECT_GAP_PX = 13.0, 6.0  # a piece has no gap longer than this, and below an object none longer than that
MEETS_PX = 6.0  # from another piece's end, where the way through a crossing isn't known
NEAR_PX = 7.0  # from an end up to which something hides the thread that goes on there
AHEAD_PX, AHEAD = (3.0, 5.0, 7.0, 9.0, 11.0), math.radians(50.0)  # beyond an end, where floor must be seen
BARE_STEP = 0.03  # of the floor's brightness, that bare floor beyond an end may differ from that beside it
GOES_ON = 0.5  # of its strength, with which a thread would go on beyond an end
SURE_STRENGTH = 2.0  # of the faintest that is seen, that a thread must have where it is seen to end
SCALE_ERROR = 0.001  # see `look`
MAX_UNKNOWN = 24  # pieces of unknown place that are published
WIDE, UNSURE = 0.6, 0.3  # confidence of a piece whose order is open, and of one whose direction is, too


@dataclass(frozen=True)
class _Strand:
    """A piece with what is measured along it: strength [grey levels], and where it is seen."""

    points: Points
    strength: NDArray[np.float64]
    seen: NDArray[np.bool_]

    def turned(self) -> _Strand:
        """Return it from its other end."""
        return _Strand(self.points[::-1], self.strength[::-1], self.seen[::-1])

    def part(self, first: int, last: int) -> _Strand:
        """Return the vertices from one to before another."""
        return _Strand(self.points[first:last], self.strength[first:last], self.seen[first:last])


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
    gray = cv2.GaussianBlur(without_needle(picture.darkest, picture.factor, needle), (5, 5), BLUR_PX)
    walk = resampled(walk, SPACING_PX)
    below = _below_needle(needle, walk)
    thread = appearance_of(picture, gray, walk, ~below)
    line = _strand(gray, thread, walk, below)
    length = thread_length / view.metres_per_pixel
    begin = _way_out(needle, walk)
    gone = _gone(line.seen, GAP_PX, begin)
    parts = _parts(line, gone)
    in_dish = _Dish(view, thread, scale_known)
    ends_bare = _is_bare(picture, gray, thread, parts[0], needle)
    plain = strengths(gray, walk, thread, two_sided=True) > max(FAINTEST, SEEN_SHARE * thread.strength)
    gapless = not gone.any() and not _gone(plain | below, OBJECT_GAP_PX, begin).any()
    if gapless and ends_bare and _is_whole(line, length):
        whole = in_dish.piece(line, PieceEnd.TAIL, PieceEnd.FREE, (0.0, 0.0), 1.0)
        return ThreadObservation((whole,), complete=True, hidden=(_outline(needle, view),))
    if not search:
        first = in_dish.piece(parts[0], PieceEnd.TAIL, PieceEnd.UNKNOWN, (0.0, 0.0), 1.0)
        return ThreadObservation((first,), hidden=(_outline(needle, view),))
    wall = Wall(view.centre_px, radius / view.metres_per_pixel)
    hiding = find_hiding(picture, needle, wall, view.metres_per_pixel)
    on_floor = np.array([hiding.area_at(point) == 0 for point in line.points])
    line = _Strand(line.points, line.strength, line.seen & on_floor)
    parts = _parts(line, _gone(line.seen, GAP_PX, begin) | _gone(line.seen | below, OBJECT_GAP_PX, begin))
    begun = _trimmed(parts[0])
    known = [begun.points]
    for part in parts[1:]:  # beyond what the walk only guessed, where it may have gone around twice
        if part.seen.sum() > 1:
            first, last = np.flatnonzero(part.seen)[[0, -1]]
            fresh = fresh_parts(part.points[first : last + 1], known)
            known += [each for each in fresh if len(each) > MIN_LENGTH_PX]
    others = known[1:] + find_pieces(picture, gray, thread, hiding, known, length)
    strands = _cut(begun, others)
    strands += [_strand(gray, thread, resampled(other, SPACING_PX)) for other in others]
    return _joined(picture, gray, thread, needle, hiding, strands, in_dish, length)


@dataclass(frozen=True)
class _Dish:
    """Turns pieces in pixels into those in the dish."""

    view: DishView
    thread: Appearance
    scale_known: bool

    def piece(
        self,
        strand: _Strand,
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
        deviation = scale * deviations(self.thread, strand.strength, strand.seen, strand.points)
        if not self.scale_known:  # A wrong scale shifts what is far from the dish's centre.
            along = tangents_of(points)
            deviation = np.hypot(deviation, SCALE_ERROR * (points[:, 0] * along[:, 1] - points[:, 1] * along[:, 0]))
        low, high = (float(scale * value) for value in arc_length)
        return ThreadPiece(points, deviation, first, last, (low, high), direction_known, confidence)


def _joined(
    picture: Picture,
    gray: NDArray[np.uint8],
    thread: Appearance,
    needle: MeasuredNeedle,
    hiding: Hiding,
    strands: list[_Strand],
    in_dish: _Dish,
    length: float,
) -> ThreadObservation:
    """Order the pieces, and tell why each of them ends."""
    ends, pieces = [], []
    for number, strand in enumerate(strands):
        first, area = PieceEnd.TAIL, 0
        if number:
            first, area = _end(picture, gray, thread, strand.turned(), needle, hiding)
        last, last_area = _end(picture, gray, thread, strand, needle, hiding)
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
        confidence = 1.0 if not placed.index else order.share if placed in order.placed else WIDE
        result.append(in_dish.piece(strand, first, last, (low, high), confidence))
    told = {placed.index for placed in (*order.placed, *order.wide)}
    nowhere = (math.nan, math.nan)
    for number in sorted(set(range(len(strands))) - told)[:MAX_UNKNOWN]:
        first, last = ends[number]
        result.append(in_dish.piece(strands[number], first, last, nowhere, UNSURE, direction_known=False))
    alone = len(strands) == 1 and ends[0][1] is PieceEnd.FREE and _is_whole(strands[0], length)
    outlines = [in_dish.view.to_dish(outline) for outline in hiding.outlines()]
    return ThreadObservation(tuple(result), alone, tuple(outlines))


def _is_whole(strand: _Strand, length: float) -> bool:
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


def _end(
    picture: Picture,
    gray: NDArray[np.uint8],
    thread: Appearance,
    strand: _Strand,
    needle: MeasuredNeedle,
    hiding: Hiding,
) -> tuple[PieceEnd, int]:
    """Tell why a piece ends at its last point, and the number of the area that it runs into, 0 for none."""
    point, way = strand.points[-1], outward(strand.points)
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
    return (PieceEnd.FREE if _is_bare(picture, gray, thread, strand, needle) else PieceEnd.UNKNOWN), 0


def _is_bare(
    picture: Picture, gray: NDArray[np.uint8], thread: Appearance, strand: _Strand, needle: MeasuredNeedle
) -> bool:
    """Say whether there is nothing but floor beyond a piece's last point, like that beside it, where it is strong."""
    if len(strand.points) < 4:
        return False
    usual = float(np.median(strand.strength[-6:]))
    if usual < max(SURE_STRENGTH * FAINTEST, 2.0 * SURE_STRENGTH * thread.noise):
        return False
    point, way = strand.points[-1], outward(strand.points)
    angle = math.atan2(way[1], way[0])
    turns = np.linspace(-AHEAD, AHEAD, 9)
    reach = np.array(AHEAD_PX)
    ahead = point + reach[:, None, None] * np.stack([np.cos(angle + turns), np.sin(angle + turns)], axis=-1)[None]
    rows, columns = gray.shape
    if ahead.min() < 2.0 or (ahead > np.array([columns, rows]) - 3.0).any():
        return False
    if _below_needle(needle, ahead.reshape(-1, 2)).any():
        return False
    aside = thread.beside_px + np.array([0.5, 1.5, 2.5])
    beside = across(strand.points, np.concatenate([-aside, aside]))[-6:]
    for layer in (picture.darkest, picture.brightest):
        pixels = gray if layer is picture.darkest else layer.pixels
        floor = float(np.median(sampled(pixels, beside)))
        beyond = sampled(pixels, ahead)
        if np.abs(np.median(beyond, axis=1) / max(floor, 1.0) - 1.0).max() > BARE_STEP:
            return False
        if layer is picture.darkest:
            off = beyond[1:] - floor if thread.pale else floor - beyond[1:]
            if float(off.max()) > max(GOES_ON * usual, FAINTEST + 3.0 * thread.noise):
                return False
    return True


def _strand(
    gray: NDArray[np.uint8], thread: Appearance, points: Points, below: NDArray[np.bool_] | None = None
) -> _Strand:
    """Return a line with where the thread is seen on it."""
    strength = strengths(gray, points, thread)
    seen = strength > max(FAINTEST, SEEN_SHARE * thread.strength)
    return _Strand(points, strength, seen if below is None else seen & ~below)


def _gone(seen: NDArray[np.bool_], max_gap: float, begin: int) -> NDArray[np.bool_]:
    """Return where a walk isn't seen for more than a length, in gaps that begin at a vertex or later."""
    gone = np.zeros_like(seen)
    for first, last in runs(~seen):
        gone[first:last] = first >= begin and last < len(seen) and (last - first) * SPACING_PX > max_gap
    return gone


def _way_out(needle: MeasuredNeedle, walk: Points) -> int:
    """Return the first vertex of a walk that lies clear of the needle."""
    along, aside = needle.arc.coordinates(walk)
    near = (along > -NEEDLE_PX) & (along < needle.length_px + NEEDLE_PX)
    near &= np.abs(aside) < 0.5 * needle.width_px + 2.0 * NEEDLE_PX
    return len(near) if near.all() else max(1, int(np.argmin(near)))


def _parts(line: _Strand, gone: NDArray[np.bool_]) -> list[_Strand]:
    """Return what is left of a walk, the part that leaves the needle first."""
    return [line.part(first, last) for first, last in runs(~gone) if last - first > 1]


def _cut(strand: _Strand, others: list[Points]) -> list[_Strand]:
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


def _trimmed(strand: _Strand) -> _Strand:
    """Return the piece that leaves the needle without its end where nothing can be seen."""
    shown = np.flatnonzero(strand.seen)
    return strand.part(0, max(2, int(shown[-1]) + 1)) if len(shown) else strand


def _below_needle(needle: MeasuredNeedle, points: Points) -> NDArray[np.bool_]:
    """Return which points the needle hides, with its blurred edge."""
    along, aside = needle.arc.coordinates(points)
    return np.asarray(
        (along > 1.0) & (along < needle.length_px + NEEDLE_PX) & (np.abs(aside) < 0.5 * needle.width_px + 1.0)
    )


def _outline(needle: MeasuredNeedle, view: DishView) -> Points:
    """Return the outline of a needle in the dish frame, shape (m, 2) [m]."""
    at, half = np.linspace(0.0, needle.length_px, 9), 0.5 * needle.width_px
    return view.to_dish(np.vstack([needle.arc.at(at, half), needle.arc.at(at[::-1], -half)]))
