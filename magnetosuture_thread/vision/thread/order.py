"""In which order a thread runs through its pieces: below what hides it, as smoothly as it can, no longer than it is.

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

from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.vision.thread.hiding import Hiding
from magnetosuture_thread.vision.thread.pieces import end_direction

DIRECTION_ERROR = 0.12  # rad; of an end's direction
TURNING = 60.0  # rad^2 / m; variance of a thread's tangent for each length
MAX_PRICE = 12.0  # of one gap
SURE = 4.0  # by which the price of every other order must be higher
LEFT_OUT = 12.0  # price of a piece that is in no order
MAX_ORDERED = 6  # pieces; only the longest are tried in all orders


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
    count = min(len(pieces), MAX_ORDERED)
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
    price = sum(gap.price for gap in used) + LEFT_OUT * (count - len(chain))
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
    spread = turning * chord / 3.0 * np.array([[1.0, -0.5], [-0.5, 1.0]]) + DIRECTION_ERROR**2 * np.eye(2)
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
