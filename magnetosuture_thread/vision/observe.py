"""What a frame shows of the thread: its pieces, their order, which of their ends are real, and what hides the rest.

A piece's end may be joined to another's only below one and the same hiding area. With the chord g from one end to the
other and the angles a and b that the thread makes with it there, a thread whose tangent turns at random by a variance
s^2 for each length joins them at the price

    c = 1/2 (a, b) C^-1 (a, b)^T,    C = s^2 g / 3 [[1, -1/2], [-1/2, 1]] + d^2 [[1, 0], [0, 1]]

with the error d of measured directions: with d = 0 that is the least bending energy of a beam between the two ends,
(4 / g) (a^2 + a b + b^2), over 2 s^2. All pairings of the ends below an area are tried, as those of the strands at a
crossing; an end is joined to another only if that is nearly certain.

Source: [Mumford1994]. Deviation: small angles, and not normalised, so that only pairings of the same ends compare.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.vision.appearance import (
    FAINTEST,
    GAP_PX,
    OBJECT_GAP_PX,
    SPACING_PX,
    WALL_PX,
    Appearance,
    Hiding,
    Strand,
    appearance_of,
    below_needle,
    deviations,
    find_hiding,
    first_clear_of,
    gaps_of,
    looks_alike,
    parts_without,
    respaced,
    strand_along,
    tangents_of,
)
from magnetosuture_thread.vision.arc import MeasuredNeedle
from magnetosuture_thread.vision.centreline import chances_of, cubic
from magnetosuture_thread.vision.images import Gray, Picture, median, middle, runs, sampled
from magnetosuture_thread.vision.walk import Ridge, path_buffer, walk_on

MIN_SEED_PX, MIN_LENGTH_PX = 6, 12.0  # of a ridge from which a walk begins, and of a piece
AHEAD_PX = (3.0, 5.0, 7.0, 9.0, 11.0)  # beyond an end, where floor must be visible
BESIDE_POINTS = 6  # last vertices of a piece, beside which its floor is measured
LENGTH_TOLERANCE = 0.03  # of the thread's length, that a whole thread may be seen shorter or longer by
LENGTH_ERROR = 0.01  # of an arc length: by noise along the walk
END_ERROR_PX = 4.0  # of an arc length, by the places where pieces begin and end
MAX_PRICE = 12.0  # of one gap; half of it for each end that is joined to none


def observe(
    picture: Picture,
    gray: Gray,
    needle: MeasuredNeedle,
    walk: Points,
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
        gray: its darkest colour without the needle, smoothed.
        needle: in the picture's pixels.
        walk: along the thread from the needle's tail on, shape (m, 2), m = 1 if none is seen [px].
        thread_length: of the whole thread [m].
        scale_known: whether the scale is given, so that it has no error.
        search: whether to look for other pieces, where the walk doesn't show all.
    """
    if len(walk) < 2 or arc_lengths(walk)[-1] < SPACING_PX:
        return ThreadObservation()
    walk = respaced(walk, SPACING_PX)
    below = below_needle(needle, walk)
    thread = appearance_of(picture, gray, walk, ~below)
    seen = _Seen(picture, gray, needle, thread, scale_known)
    line, plain = strand_along(gray, thread, walk)
    line = replace(line, visible=line.visible & ~below)
    length = thread_length / picture.view.metres_per_pixel
    begin = first_clear_of(needle, walk)
    gone = gaps_of(line.visible, GAP_PX, begin)
    parts = parts_without(line, gone)
    gapless = not gone.any() and not gaps_of(plain | below, OBJECT_GAP_PX, begin).any()
    if gapless and _is_whole(line.points, length):  # Nothing is left of the thread to look for.
        ends_bare = is_bare_beyond(seen, parts[0])
        end = PieceEnd.FREE if ends_bare else PieceEnd.UNKNOWN
        whole = seen.piece(line, (PieceEnd.TAIL, end), (0.0, 0.0))
        return ThreadObservation((whole,), complete=ends_bare, hidden=(_outline(needle, picture.view),))
    if not search:
        first = seen.piece(parts[0], (PieceEnd.TAIL, PieceEnd.UNKNOWN), (0.0, 0.0))
        return ThreadObservation((first,), hidden=(_outline(needle, picture.view),))
    hiding = find_hiding(picture, needle)
    on_floor = np.array([hiding.area_at(point) == 0 for point in line.points])
    line = replace(line, visible=line.visible & on_floor)
    gone = gaps_of(line.visible, GAP_PX, begin) | gaps_of(line.visible | below, OBJECT_GAP_PX, begin)
    parts = parts_without(line, gone)
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
    others = known[1:] + find_pieces(seen, hiding, known, remaining)
    strands = [begun]
    strands += [strand_along(gray, thread, respaced(other, SPACING_PX))[0] for other in others]
    ends, areas = [], []
    for number, strand in enumerate(strands):
        first_end, first_area = why_it_ends(seen, strand.turned(), hiding) if number else (PieceEnd.TAIL, 0)
        last_end, last_area = why_it_ends(seen, strand, hiding)
        ends.append([first_end, last_end])
        areas.append((first_area, last_area))
    return _joined(seen, strands, ends, areas, hiding, length)


@dataclass(frozen=True)
class _Seen:
    """A picture with its needle and how its thread looks.

    Attributes:
        picture: the frame or a part of it.
        gray: its darkest colour without the needle, smoothed.
        needle: in the picture's pixels.
        thread: how the piece looks that leaves the needle.
        scale_known: whether the scale is given, so that it has no error.
    """

    picture: Picture
    gray: Gray
    needle: MeasuredNeedle
    thread: Appearance
    scale_known: bool

    def piece(
        self, strand: Strand, ends: tuple[PieceEnd, PieceEnd], arc_length: tuple[float, float], confidence: float = 1.0
    ) -> ThreadPiece:
        """Return a piece in the dish; `arc_length` in pixels, NaN where nothing tells it, nor the direction."""
        view = self.picture.view
        points = view.to_dish(strand.points)
        deviation = view.metres_per_pixel * deviations(self.thread, strand)
        if not self.scale_known:  # A wrong scale shifts what is far from the dish's centre.
            along = tangents_of(points)
            deviation = np.hypot(deviation, 0.001 * (points[:, 0] * along[:, 1] - points[:, 1] * along[:, 0]))
        low, high = (float(view.metres_per_pixel * value) for value in arc_length)
        return ThreadPiece(points, deviation, *ends, (low, high), not math.isnan(low), confidence)


def _joined(
    seen: _Seen,
    strands: list[Strand],
    ends: list[list[PieceEnd]],
    areas: list[tuple[int, int]],
    hiding: Hiding,
    length: float,
) -> ThreadObservation:
    """Order the pieces.

    Args:
        seen: the picture.
        strands: the one that leaves the needle first.
        ends: why each of them begins and ends; an end on bare floor stays free only if it is the thread's.
        areas: number of the hiding area that each end runs into, 0 for none.
        hiding: these areas.
        length: of the thread [px].
    """
    longest = length * (1.0 + LENGTH_TOLERANCE)
    lines = [strand.points for strand in strands]
    shortest = length * (1.0 - LENGTH_TOLERANCE)
    order = find_order(lines, areas, hiding, (shortest, longest), seen.picture.view.metres_per_pixel)
    # The only end on bare floor is the thread's where it is the last in the order, and the lengths add up.
    bare = [(number, side) for number, both in enumerate(ends) for side in (0, 1) if both[side] is PieceEnd.FREE]
    last = order[-1]
    low, high = (arc + float(arc_lengths(lines[last.index])[-1]) for arc in last.arc_length)
    adds_up = low < longest + END_ERROR_PX and high > shortest - END_ERROR_PX
    if not adds_up or bare != [(last.index, 0 if last.turned else 1)]:
        for number, side in bare:
            ends[number][side] = PieceEnd.UNKNOWN
    result = []
    for placed in order:
        strand, (first_end, last_end) = strands[placed.index], ends[placed.index]
        if placed.turned:
            strand, first_end, last_end = strand.turned(), last_end, first_end
        low, high = placed.arc_length
        if placed.index:
            low = max(0.0, low - LENGTH_ERROR * low - END_ERROR_PX)
            high = min(high + LENGTH_ERROR * high + END_ERROR_PX, max(low, longest - arc_lengths(strand.points)[-1]))
        result.append(seen.piece(strand, (first_end, last_end), (low, high), placed.chance))
    unplaced = [number for number in range(len(strands)) if all(number != placed.index for placed in order)]
    for number in unplaced[:24]:  # more are texture
        result.append(seen.piece(strands[number], (ends[number][0], ends[number][1]), (math.nan, math.nan), 0.3))
    alone = len(strands) == 1 and ends[0][1] is PieceEnd.FREE and _is_whole(lines[0], length)
    return ThreadObservation(tuple(result), alone, tuple(seen.picture.view.to_dish(each) for each in hiding.outlines()))


def _is_whole(line: Points, length: float) -> bool:
    """Say whether a piece is as long as the thread."""
    return bool(abs(arc_lengths(line)[-1] / length - 1.0) < LENGTH_TOLERANCE)


def _outline(needle: MeasuredNeedle, view: DishView) -> Points:
    """Return the outline of a needle in the dish frame, shape (m, 2) [m]."""
    at, half = needle.length_px / 8.0 * np.arange(9.0), 0.5 * needle.width_px
    return view.to_dish(np.vstack([needle.arc.at(at, half), needle.arc.at(at[::-1], -half)]))


@dataclass(frozen=True)
class Placed:
    """A piece in the order of the thread.

    Attributes:
        index: of the piece.
        turned: whether the thread runs from its last point to its first.
        arc_length: least and greatest of the point that comes first [px].
        chance: that it lies there, 0 to 1.
    """

    index: int
    turned: bool
    arc_length: tuple[float, float]
    chance: float = 1.0


def find_order(
    lines: list[Points],
    areas: list[tuple[int, int]],
    hiding: Hiding,
    length: tuple[float, float],
    metres_per_pixel: float,
) -> list[Placed]:
    """Find where the thread surely runs from its first piece on.

    Args:
        lines: the pieces: the one that leaves the needle first, with its first point at the tail, each of shape (m, 2)
            [px].
        areas: number of the hiding area that both ends of each piece run into, 0 for none.
        hiding: these areas, where the thread can't be seen.
        length: least and greatest of the whole thread [px].
        metres_per_pixel: of the picture [m].

    Returns:
        The pieces in their order.
    """
    lengths, longest = [float(arc_lengths(line)[-1]) for line in lines], length[1]
    placed, end = [Placed(0, False, (0.0, 0.0))], (0, 1)
    way = [lengths[0]]  # lengths of pieces and gaps along the thread, in turn
    while area := areas[end[0]][end[1]]:
        below = [(number, side) for number, both in enumerate(areas) for side in (0, 1) if both[side] == area]
        others = sorted((each for each in below if each != end), key=lambda each: -lengths[each[0]])
        ends = [end, *others][:8]  # of which all pairings can be tried
        costs = np.full((len(ends), len(ends)), math.inf)
        np.fill_diagonal(costs, 0.5 * MAX_PRICE)
        straight_and_curved: dict[int, tuple[float, float]] = {}  # lengths of the ways from the end [px]
        for one, other in combinations(range(len(ends)), 2):
            (before, first_side), (after, last_side) = ends[one], ends[other]
            leaving = lines[before] if first_side else lines[before][::-1]
            arriving = lines[after][::-1] if last_side else lines[after]
            # A thread's tangent turns along it by a variance of 60 rad^2 / m.
            gap = _gap(leaving, arriving, hiding, 60.0 * metres_per_pixel) if before != after else None
            if gap is not None and lengths[before] + gap[1] + lengths[after] <= longest:
                if one == 0:
                    straight_and_curved[other] = gap[1:]
                costs[one, other] = costs[other, one] = gap[0]
        chances = chances_of(costs, 0)
        best = int(chances.argmax())
        index, side = ends[best]
        if best == 0 or chances[best] < 0.98 or any(index == each.index for each in placed):
            break
        (chord, curved), last = straight_and_curved[best], placed[-1]
        if sum(way) + chord + lengths[index] > longest:
            break
        low, high = (arc + lengths[last.index] for arc in last.arc_length)
        # A half circle is the longest way below what hides it.
        arc = (low + chord, high + 0.5 * math.pi * curved)
        placed.append(Placed(index, side == 1, arc, last.chance * float(chances[best])))
        way += [chord, lengths[index]]
        end = (index, 1 - side)
    last = placed[-1]
    if not areas[end[0]][end[1]] and last.arc_length[1] + lengths[last.index] < length[0]:
        return placed[:1]  # It ends in sight and is too short: a piece between two of these is left out.
    rest = np.cumsum(way[::-1])[::-1][::2]  # from the beginning of each piece on, at least
    for index, later in enumerate(rest):
        low, high = placed[index].arc_length
        placed[index] = replace(placed[index], arc_length=(low, max(low, min(high, longest - float(later)))))
    return placed


def _gap(before: Points, after: Points, hiding: Hiding, turning: float) -> tuple[float, float, float] | None:
    """Return the way from a piece's end to the beginning of another; None where it is not hidden, or too bent.

    It is told by its price, the straight distance, and the length of its curve [px].
    """
    start, end = before[-1], after[0]
    leaving, arriving = end_direction(before), -end_direction(after[::-1])
    chord = float(np.hypot(*(end - start)))
    along = (end - start) / max(chord, 1e-9)
    angles = np.array([_angle(along, leaving), _angle(along, arriving)])
    # A measured direction is off by 0.12 rad.
    spread = turning * chord / 3.0 * np.array([[1.0, -0.5], [-0.5, 1.0]]) + 0.12**2 * np.eye(2)
    price = 0.5 * float(angles @ np.linalg.solve(spread, angles))
    if price > MAX_PRICE:
        return None
    curve = cubic(start, end, leaving * chord, arriving * chord, 17)
    length = float(arc_lengths(curve)[-1])
    bare = sum(hiding.area_at(point) == 0 for point in curve[1:-1]) * length / len(curve)
    return (price, chord, length) if bare <= 10.0 else None  # px of it may lie on bare floor


def _angle(from_: Points, to: Points) -> float:
    return math.atan2(from_[0] * to[1] - from_[1] * to[0], float(from_ @ to))


@cache
def _off_line() -> NDArray[np.float64]:
    """Return the matrix that takes light at the vertices and ahead to what it is off a straight line fitted to it."""
    line = np.vander(np.concatenate([SPACING_PX * np.arange(1 - BESIDE_POINTS, 1), AHEAD_PX]), 2)
    return np.asarray(np.eye(len(line)) - line @ np.linalg.pinv(line))


def two_sided_ridge(gray: Gray, thread: Appearance, hiding: Hiding) -> Gray:
    """Return how much darker each pixel is than the floor on both sides of it.

        R(p) = max_k min(I(p + d n_k), I(p - d n_k)) - I(p)

    with d a little more than half of the thread's width and n_k unit vectors all around, so that an edge, bright on
    one side only, is none. It is 0 where something hides the floor.
    """
    reach = thread.beside_px
    edge = math.ceil(reach) + 1
    padded = cv2.copyMakeBorder(gray, edge, edge, edge, edge, cv2.BORDER_REPLICATE)
    rows, columns = gray.shape
    best = np.zeros_like(gray)
    for index in range(8):
        angle = math.pi * index / 8
        u, v = round(reach * math.cos(angle)), round(reach * math.sin(angle))
        one = padded[edge + v : edge + v + rows, edge + u : edge + u + columns]
        other = padded[edge - v : edge - v + rows, edge - u : edge - u + columns]
        best = cv2.max(best, cv2.subtract(cv2.min(one, other), gray))
    best[hiding.solid > 0] = 0
    return np.ascontiguousarray(best)


def find_pieces(seen: _Seen, hiding: Hiding, known: list[Points], max_length: float) -> list[Points]:
    """Find all other pieces of a thread.

    Args:
        seen: the picture.
        hiding: areas where nothing can be seen.
        known: pieces that are known, each of shape (m, 2) [px].
        max_length: of all these pieces: what is left of the thread, so that anything longer is none of it [px].

    Returns:
        Pieces in the picture's pixels, the longest first, each of shape (m, 2), m >= 2 [px].
    """
    thread = seen.thread
    if max_length < MIN_LENGTH_PX or thread.strength < 2.0 * FAINTEST:  # The floor's texture looks like a faint thread.
        return []
    ridge = two_sided_ridge(seen.gray, thread, hiding)
    ridge[~hiding.inside] = 0
    inside = hiding.inside[::5, ::5]
    noise = middle(ridge[::5, ::5][inside]) if inside.any() else 0.0
    faintest = max(FAINTEST, 4.0 * noise)
    fresh = (ridge > max(noise + faintest, 0.45 * thread.strength)).astype(np.uint8)
    for line in known:
        _clear(fresh, line, thread.beside_px)
    found: list[Points] = []
    dish = *hiding.wall.centre, hiding.wall.radius - WALL_PX
    walked = Ridge(ridge, np.zeros_like(ridge), noise, faintest, dish)
    for _ in range(24):
        seed = _seed(fresh, ridge)
        if seed is None:
            break
        line = _traced(walked, seed, max(thread.strength, faintest), max_length + MIN_LENGTH_PX)
        _clear(fresh, line, thread.beside_px)
        cv2.circle(fresh, (round(seed[0]), round(seed[1])), MIN_SEED_PX, 0, -1)
        for part in fresh_parts(line, known + found):
            long = MIN_LENGTH_PX <= arc_lengths(part)[-1] <= max_length
            if long and looks_alike(seen.picture, thread, part, 0.35):
                found.append(part)
    return sorted(found, key=lambda line: -arc_lengths(line)[-1])


def _seed(fresh: NDArray[np.uint8], ridge: Gray) -> tuple[float, float, float] | None:
    """Return place and direction of the largest ridge that no walk has begun at yet: u, v, angle."""
    outlines, _ = cv2.findContours(fresh, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    boxes = [cv2.boundingRect(outline) for outline in outlines]
    extents = [math.hypot(width, height) for _, _, width, height in boxes]
    if not extents or max(extents) < MIN_SEED_PX:
        return None
    largest = int(np.argmax(extents))
    left, top, width, height = boxes[largest]
    own = np.zeros((height, width), np.uint8)
    cv2.drawContours(own, outlines, largest, 1, -1, cv2.LINE_8, offset=(-left, -top))
    box = slice(top, top + height), slice(left, left + width)
    own &= fresh[box]
    v, u = np.unravel_index(int(np.argmax(np.where(own, ridge[box], 0))), own.shape)
    at_v, at_u = np.nonzero(own)
    near = np.hypot(at_u - u, at_v - v) < 7.0
    spread = np.cov(np.stack([at_u[near], at_v[near]])) if near.sum() > 2 else np.eye(2)
    along = np.linalg.eigh(spread)[1][:, 1]
    return float(u + left), float(v + top), math.atan2(along[1], along[0])


def _traced(ridge: Ridge, seed: tuple[float, float, float], strength: float, max_length: float) -> Points:
    """Walk from a place along a ridge to both of its ends."""
    halves = []
    for turn in (math.pi, 0.0):
        path = path_buffer(max_length)
        path[0, :5] = seed[0], seed[1], seed[2] + turn, 0.0, strength
        count = walk_on(ridge, max_length, path, 1)
        halves.append(path[:count, :2].copy())
    line = np.vstack([halves[0][::-1], halves[1][1:]])
    return line if len(line) > 1 else np.vstack([line, line + 1e-3])


def _clear(fresh: NDArray[np.uint8], line: Points, reach: float) -> None:
    """Take what lies along a line out of where walks may begin."""
    at = np.round(line * 16.0).astype(np.int32)
    cv2.polylines(fresh, [at], False, 0, 2 * math.ceil(reach) + 1, cv2.LINE_8, 4)


def fresh_parts(line: Points, known: list[Points]) -> list[Points]:
    """Return the parts of a line that run along no known one, nor along itself; they may cross them."""
    line = respaced(line, 1.0)
    others = np.vstack([line, *(respaced(other, 1.0) for other in known)])
    # Within 2.5 px it shows the same thread, unless it only crosses it.
    near = np.linalg.norm(line[:, None] - others, axis=2) < 2.5
    most = 10  # px along another line, that a line runs near it where it only crosses it
    near[:, : len(line)] &= np.tri(len(line), k=-most - 1, dtype=np.bool_)  # its own from long before
    twice = near.any(axis=1)
    for first, last in runs(twice):
        if last - first < most and first > 0 and last < len(twice):
            twice[first:last] = False
    return [line[first:last] for first, last in runs(~twice) if last - first > 1]


def end_direction(points: Points) -> Points:
    """Return the unit direction in which a polyline leaves at its last point, shape (2,)."""
    at = arc_lengths(points)
    first = int(np.searchsorted(at, at[-1] - 8.0))
    near = points[min(first, len(points) - 2) :]
    if len(near) > 3:  # A parabola's tangent at its end: a bent thread turns on the way.
        s = arc_lengths(near)
        powers = np.vander(s - s[-1], 3)
        direction = np.linalg.solve(powers.T @ powers, powers.T @ near)[1]
    else:
        direction = near[-1] - near[0]
    return np.asarray(direction / max(float(np.hypot(*direction)), 1e-9))


def why_it_ends(seen: _Seen, strand: Strand, hiding: Hiding) -> tuple[PieceEnd, int]:
    """Tell why a piece ends at its last point, and the number of the area that it runs into, 0 for none."""
    point, way = strand.points[-1], end_direction(strand.points)
    aside = np.array([-way[1], way[0]])
    rows, columns = seen.gray.shape
    for ahead in np.arange(0.0, 7.0 + 0.5):  # px
        for beside in (0.0, -1.5, 1.5):
            at = point + ahead * way + beside * aside
            area = hiding.area_at(at)
            if area > 0:
                return PieceEnd.COVERED, area
            if not (1.0 <= at[0] < columns - 2 and 1.0 <= at[1] < rows - 2):
                return PieceEnd.FRAME, 0
            if area < 0:
                return PieceEnd.UNKNOWN, 0
    return (PieceEnd.FREE if is_bare_beyond(seen, strand) else PieceEnd.UNKNOWN), 0


def is_bare_beyond(seen: _Seen, strand: Strand) -> bool:
    """Say whether there is nothing but floor beyond a piece's last point, like that beside it, where it is strong."""
    if len(strand.points) < BESIDE_POINTS:
        return False
    gray, thread, usual = seen.gray, seen.thread, float(median(strand.strength[-BESIDE_POINTS:]))
    if usual < max(2.0 * FAINTEST, 4.0 * thread.noise):
        return False
    point, way = strand.points[-1], end_direction(strand.points)
    angle = math.atan2(way[1], way[0])
    turns, reach = angle + math.radians(50.0) * np.arange(-1.0, 1.1, 0.25), np.array(AHEAD_PX)
    ahead = point + reach[:, None, None] * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    rows, columns = gray.shape
    if ahead.min() < 2.0 or (ahead > np.array([columns, rows]) - 3.0).any():
        return False
    if below_needle(seen.needle, ahead.reshape(-1, 2)).any():
        return False
    aside = thread.beside_px + np.array([0.5, 1.5, 2.5])
    last = strand.points[-BESIDE_POINTS - 1 :]  # with one more, for the direction at the first
    normals = (tangents_of(last)[:, ::-1] * (-1.0, 1.0))[-BESIDE_POINTS:]
    beside = last[-BESIDE_POINTS:, None] + np.concatenate([-aside, aside])[:, None] * normals[:, None]
    floor, beyond = float(median(sampled(gray, beside).ravel())), sampled(gray, ahead)
    if floor - float(beyond[1:].min()) > max(0.5 * usual, FAINTEST + 3.0 * thread.noise):  # It goes on.
        return False
    light = np.vstack([median(np.atleast_3d(sampled(seen.picture.image, at)), axis=1) for at in (beside, ahead)])
    light /= np.maximum(median(light[: len(beside)], axis=0), 1.0)
    mean = light.mean(axis=1)
    step = np.abs(_off_line() @ mean).max()
    even = step < 0.025 and np.abs(mean - 1.0).max() < 0.06
    # Colours may change apart by 3 %, on average over the farthest rings.
    return bool(even and np.ptp(light[-3:].mean(axis=0)) < 0.03)
