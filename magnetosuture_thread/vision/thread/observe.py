"""What a frame shows of the thread: its pieces, their order, which of their ends are real, and what hides the rest.

A piece's end may be joined to another's only below one and the same hiding area. With the chord g from one end to the
other and the angles a and b that the thread makes with it there, a thread whose tangent turns at random by a variance
s^2 for each length joins them at the price

    c = 1/2 (a, b) C^-1 (a, b)^T,    C = s^2 g / 3 [[1, -1/2], [-1/2, 1]] + d^2 [[1, 0], [0, 1]]

with the error d of measured directions: with d = 0 that is the least bending energy of a beam between the two ends,
(4 / g) (a^2 + a b + b^2), over 2 s^2. All orders and directions of the pieces are tried. An order is taken only if all
others cost more by `SURE`: where two are nearly as good, none is.

Source: [Mumford1994]. Deviation: small angles, and not normalised, so that only orders of the same pieces compare.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.vision.images import Picture, Wall
from magnetosuture_thread.vision.needle.arc import MeasuredNeedle
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
from magnetosuture_thread.vision.thread.pieces import (
    MIN_LENGTH_PX,
    end_direction,
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
TURNING = 60.0  # rad^2 / m; variance of a thread's tangent for each length
MAX_PRICE = 12.0  # of one gap
SURE = 4.0  # by which the price of every other order must be higher


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


@dataclass(frozen=True)
class Piece:
    """A piece before it is told where in the thread it lies.

    Attributes:
        points: along it, shape (m, 2) [px].
        areas: number of the hiding area that each end runs into, 0 for none.
    """

    points: Points
    areas: tuple[int, int]

    @property
    def length(self) -> float:
        """Return its length [px]."""
        return float(arc_lengths(self.points)[-1])

    def turned(self) -> Piece:
        """Return the piece from its other end."""
        return Piece(self.points[::-1], (self.areas[1], self.areas[0]))


@dataclass(frozen=True)
class Placed:
    """A piece in the order of the thread.

    Attributes:
        index: of the piece.
        turned: whether the thread runs from its last point to its first.
        arc_length: least and greatest of the point that comes first [px].
    """

    index: int
    turned: bool
    arc_length: tuple[float, float]


@dataclass(frozen=True)
class Order:
    """Where the thread runs surely.

    Attributes:
        placed: pieces from the needle on.
        share: how likely this order is among those that were tried, 0 to 1.
        wide: pieces that may lie in different places beyond these, but in one direction, with all of these places.
        last: the piece that is the last one for sure, with its direction; None if that isn't known.
        length: least and greatest length of the thread up to the end of the last piece [px].
    """

    placed: tuple[Placed, ...]
    share: float
    wide: tuple[Placed, ...]
    last: tuple[int, bool] | None
    length: tuple[float, float]


@dataclass(frozen=True)
class _Gap:
    """A way from one piece's end to the beginning of another."""

    price: float
    chord: float
    length: float
    curve: Points


Step = tuple[int, bool]  # index of a piece, and whether it is turned


def find_order(pieces: list[Piece], hiding: Hiding, length: tuple[float, float], metres_per_pixel: float) -> Order:
    """Find the order in which the thread runs through its pieces.

    Args:
        pieces: the one that leaves the needle first, with its first point at the tail; then the longest first.
        hiding: areas where the thread can't be seen.
        length: least and greatest of the whole thread [px].
        metres_per_pixel: of the picture [m].

    Returns:
        The pieces that every order that is nearly the best begins with, and what else all of these agree on.
    """
    gaps: dict[tuple[Step, Step], _Gap] = {}
    oriented = {
        (k, turned): piece.turned() if turned else piece for k, piece in enumerate(pieces) for turned in (False, True)
    }
    count = min(len(pieces), 6)  # Only the longest are tried in all orders.
    for before in oriented:
        for after in oriented:
            if before[0] != after[0] and after[0] != 0 and max(before[0], after[0]) < count:
                gap = _gap(oriented[before], oriented[after], hiding, TURNING * metres_per_pixel)
                if gap is not None:
                    gaps[before, after] = gap
    lengths = [piece.length for piece in pieces]
    tried = [
        (price, chain)
        for chain in _chains((0, False), gaps, count)
        if (price := _price(chain, gaps, lengths, count, length, oriented)) < math.inf
    ]
    tried.sort(key=lambda each: each[0])
    best, chain = tried[0] if tried else (0.0, ((0, False),))
    near = [other for price, other in tried if price < best + SURE] or [chain]
    same = 1
    while same < len(chain) and all(len(other) > same and other[same] == chain[same] for other in near):
        same += 1
    total = sum(math.exp(best - price) for price, _ in tried) or 1.0
    share = sum(math.exp(best - price) for price, other in tried if other[:same] == chain[:same]) / total or 1.0
    ways = [_placed(other, gaps, lengths, length[1]) for other in near]
    last = chain[-1] if all(other[-1] == chain[-1] for other in near) else None
    reached = [
        (
            sum(lengths[k] for k, _ in other) + sum(gap.chord for gap in used),
            way[-1].arc_length[1] + lengths[other[-1][0]],
        )
        for other, way in zip(near, ways, strict=True)
        for used in [[gaps[pair] for pair in pairwise(other)]]
    ]
    return Order(
        ways[0][:same],
        share,
        _wide(ways, same),
        last,
        (min(low for low, _ in reached), max(high for _, high in reached)),
    )


def _wide(ways: list[tuple[Placed, ...]], same: int) -> tuple[Placed, ...]:
    """Return the pieces beyond the first ones that lie in one direction in all ways, with all of their places."""
    result = []
    for piece in ways[0][same:]:
        places = [other for way in ways for other in way if (other.index, other.turned) == (piece.index, piece.turned)]
        if len(places) == len(ways):
            low, high = (pick(place.arc_length[k] for place in places) for k, pick in ((0, min), (1, max)))
            result.append(Placed(piece.index, piece.turned, (low, high)))
    return tuple(sorted(result, key=lambda placed: placed.arc_length))


def _chains(first: Step, gaps: dict[tuple[Step, Step], _Gap], count: int) -> Iterator[tuple[Step, ...]]:
    """Give all ways through pieces, each at most once."""
    waiting: list[tuple[Step, ...]] = [(first,)]
    steps = [(index, turned) for index in range(1, count) for turned in (False, True)]
    while waiting:
        chain = waiting.pop()
        yield chain
        used = {index for index, _ in chain}
        waiting += [(*chain, step) for step in steps if step[0] not in used and (chain[-1], step) in gaps]


def _price(
    chain: tuple[Step, ...],
    gaps: dict[tuple[Step, Step], _Gap],
    lengths: list[float],
    count: int,
    length: tuple[float, float],
    oriented: dict[Step, Piece],
) -> float:
    """Return what an order costs; infinite if the thread is too short for it."""
    used = [gaps[pair] for pair in pairwise(chain)]
    seen = sum(lengths[index] for index, _ in chain)
    if seen + sum(gap.chord for gap in used) > length[1]:
        return math.inf
    price = sum(gap.price for gap in used) + MAX_PRICE * (count - len(chain))  # for each piece that is left out
    if used and not oriented[chain[-1]].areas[1]:  # The thread ends in sight: it is known how much is hidden.
        hidden = sum(gap.length for gap in used)
        off = max(length[0] - seen - hidden, seen + hidden - length[1], 0.0)
        price += min(0.5 * (off / (0.15 * hidden + 1.0)) ** 2, MAX_PRICE)
    return price


def _gap(before: Piece, after: Piece, hiding: Hiding, turning: float) -> _Gap | None:
    """Return the way from a piece's end to the beginning of another; None where none is hidden, or too bent."""
    if not before.areas[1] or before.areas[1] != after.areas[0]:
        return None
    start, end = before.points[-1], after.points[0]
    leaving, arriving = end_direction(before.points), -end_direction(after.points[::-1])
    chord = float(np.hypot(*(end - start)))
    along = (end - start) / max(chord, 1e-9)
    angles = np.array([_angle(along, leaving), _angle(along, arriving)])
    # A measured direction is off by 0.12 rad.
    spread = turning * chord / 3.0 * np.array([[1.0, -0.5], [-0.5, 1.0]]) + 0.12**2 * np.eye(2)
    price = 0.5 * float(angles @ np.linalg.solve(spread, angles))
    if price > MAX_PRICE:
        return None
    curve = _curve(start, end, leaving * chord, arriving * chord)
    bare = sum(hiding.area_at(point) == 0 for point in curve[1:-1]) * arc_lengths(curve)[-1] / len(curve)
    if bare > 10.0:  # px of it may lie on bare floor
        return None
    return _Gap(price, chord, float(arc_lengths(curve)[-1]), curve)


def _angle(from_: Points, to: Points) -> float:
    return math.atan2(from_[0] * to[1] - from_[1] * to[0], float(from_ @ to))


def _curve(start: Points, end: Points, leaving: Points, arriving: Points) -> Points:
    """Return the cubic from a point to another with given tangents, shape (17, 2)."""
    t = np.linspace(0.0, 1.0, 17)[:, None]
    return np.asarray(
        (1.0 + 2.0 * t) * (1.0 - t) ** 2 * start
        + t * (1.0 - t) ** 2 * leaving
        + t * t * (3.0 - 2.0 * t) * end
        + t * t * (t - 1.0) * arriving
    )


def _placed(
    chain: tuple[Step, ...], gaps: dict[tuple[Step, Step], _Gap], lengths: list[float], longest: float
) -> tuple[Placed, ...]:
    """Return where along the thread the pieces of an order begin."""
    used = [gaps[pair] for pair in pairwise(chain)]
    result = [Placed(chain[0][0], chain[0][1], (0.0, 0.0))]
    for position, (index, turned) in enumerate(chain[1:], start=1):
        low, high = result[-1].arc_length
        length, gap = lengths[chain[position - 1][0]], used[position - 1]
        later = sum(lengths[step[0]] for step in chain[position:]) + sum(each.chord for each in used[position:])
        low += length + gap.chord
        # A half circle is the longest way below what hides it.
        high = max(low, min(high + length + 0.5 * math.pi * gap.length, longest - later))
        result.append(Placed(index, turned, (low, high)))
    return tuple(result)
