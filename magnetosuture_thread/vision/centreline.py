"""Follows the thread's centreline: a walk along its dark ridge that starts at the needle's tail.

Crossings of a walk with other strands, and the way it takes there: the smoothest of all pairings of the strands.

A thread's tangent and its curvature turn at random along it, by variances t and c for each length. A walk out of the
crossing gives the direction and the curvature of each arm where it begins, with their covariance. With the length g of
the curve from one arm to another, the angles a and b that a thread makes with its chord at both, and its curvatures k
and k', a strand that goes on from one to the other has the errors and their covariance

    e = (a g + k g^2 / 2,  b - a - k g,  k' - k),    S = F S_1 F^T + S_2 + Q(g)
    F = [[1, g, g^2 / 2], [0, 1, g], [0, 0, 1]]
    Q = c [[g^5 / 20, g^4 / 8, g^3 / 6], [., g^3 / 3, g^2 / 2], [., ., g]] + t [[g^3 / 3, g^2 / 2, 0], [., g, 0], 0]

and costs (n + 3) / 2 log(1 + e^T S^-1 e / n) + 1/2 log |2 pi S|: near e = 0 that is the bending energy of the smoothest
curve between the two, seen through the errors of what is measured. Bare floor along the joining curve, and a difference
in strength of the two arms, cost more. A pairing costs the sum of its pairs and of its arms that end; all pairings are
tried, and each counts by exp(-cost).

Source: [Mumford1994], and all pairings as in [Choi2023]. Deviation: the curvature turns at random too, so that arms
that are bent alike belong together, and costs are probabilities, so that a confidence follows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.vision.arc import MeasuredNeedle
from magnetosuture_thread.vision.images import (
    RIM_PX,
    Gray,
    Layer,
    Picture,
    SceneMask,
    glare_mask,
    greatest_near,
    median,
    middle,
    nearest,
    runs,
    sampled,
    within,
)
from magnetosuture_thread.vision.template import BLOOM_PX, BLUR_PX, STEEPNESS, TAPER, THIN
from magnetosuture_thread.vision.walk import (
    STEP_PX,
    STRONGEST,
    Ridge,
    black_hat,
    follow,
    path_buffer,
    refine,
    walk_on,
    worth,
)

RADIUS_PX, RING = 7.0, 48  # around a path's vertices, that belongs to a crossing; places on it that are looked at
REACH = round(RADIUS_PX / STEP_PX)  # vertices
SHOWN = 0.45  # of the usual strength, at least, where a strand leaves it
ON_ARM_PX, ALONG = 4.0, 0.3  # from an arm's beginning, where a path goes along it if their cosine is greater
TURNING, CURVATURE_RATE = 0.01, 1e-4  # 1 / px, 1 / px^3; variances of tangent and curvature for each length

WALL_PX = 4.0  # before which the walk ends


@dataclass(frozen=True)
class Arm:
    """A strand that leaves a crossing.

    Attributes:
        path: the walk along it, away from the crossing; see `walk_on`.
        angle: of its tangent where it begins [rad].
        curvature: there [1/px].
        covariance: of the offset, the angle and the curvature there, shape (3, 3).
        strength: of the ridge, median.
    """

    path: NDArray[np.float64]
    angle: float
    curvature: float
    covariance: NDArray[np.float64]
    strength: float

    @property
    def start(self) -> Points:
        """Return where it begins, shape (2,) [px]."""
        return np.asarray(self.path[0, :2])

    def covers(self, point: Points) -> bool:
        """Say whether a point lies on it."""
        return bool(((self.path[:, :2] - point) ** 2).sum(axis=1).min() < 2.5**2)


def resolve_crossings(
    ridge: Ridge, max_length: float, path: NDArray[np.float64], count: int
) -> tuple[int, list[tuple[int, float]]]:
    """Take the most probable way wherever other strands meet a path, and walk on from there.

    Strands meet where more than two of them cross a ring around the path's vertices. Where three arms meet, and soon
    after that three again, two strands are merged in between: both places are one crossing.

    Args:
        ridge: that is followed.
        max_length: of the path [px].
        path: see `walk_on`; changed where another way is taken.
        count: vertices that there are.

    Returns:
        The number of vertices, and of each crossing the vertex where the path enters it and how probable the way is
        that was taken, 0 to 1.
    """
    crossings: list[tuple[int, float]] = []
    begin = 1
    for _ in range(16):
        places = _meetings(ridge, path[:count], begin)
        if not places:
            break
        low, high = places.pop(0)
        arms = find_arms(ridge, path[low - 1 : high])
        if len(arms) == 3 and places and places[0][0] - high <= 24:
            after, end = places[0]
            if len(find_arms(ridge, path[after - 1 : end])) == 3:
                high, arms = end, find_arms(ridge, path[low - 1 : end])
        begin = high + REACH
        first, beyond = max(0, low - 2 * REACH), min(count, high + 2 * REACH)
        entry = arm_of(arms, path[first : low + 1], leaving=False)
        if len(arms) < 3 or entry < 0:
            continue
        # Bending energies mean little beyond small turns and where an arm is missing. The walk knows the inside better:
        # it isn't overruled, only doubted.
        turn = (path[high - 1, 5] - path[low - 1, 5]) * float(np.mean([abs(arm.curvature) for arm in arms]))
        overrules = turn < 1.5 and len(arms) % 2 == 0
        taken = arm_of(arms, path[high - 1 : beyond], leaving=True)
        chances = continuations(ridge, (float(path[low, 5]), max_length), arms, entry)
        best = int(np.argmax(chances))
        if best in (entry, taken) or not overrules:
            # Best as entry: the thread ends here, or nothing that is seen goes on from it.
            ends = best == entry and taken < 0 and count <= high + 2 * REACH
            taken = entry if ends else taken
            crossings.append((low, float(chances[taken]) if taken >= 0 else 0.0))
            continue
        away = np.hypot(*(path[first : low + 1, :2] - arms[entry].start).T)
        count, begin = _turn(path, first + int(np.argmin(away)) + 1, arms[entry], arms[best])
        crossings.append((low, float(chances[best])))
        begin += REACH
        longer = np.flatnonzero(path[:count, 5] > max_length)
        if len(longer):
            count = max(2, int(longer[0]))
            break
        count = walk_on(ridge, max_length, path, count)
    return count, [each for each in crossings if each[0] < count]


def _meetings(ridge: Ridge, path: NDArray[np.float64], begin: int) -> list[tuple[int, int]]:
    """Return first vertex and the one after the last of each place from a vertex on where strands meet a path."""
    meets = np.zeros(max(0, len(path) - begin), np.bool_)
    if not len(meets):
        return []
    strands_meet(ridge, path[begin:], meets)
    for first, last in runs(~meets):
        if first > 0 and last < len(meets) and last - first <= 3:  # vertices without another strand within a crossing
            meets[first:last] = True
    return [(begin + first, begin + last) for first, last in runs(meets)]


@compiled
def strands_meet(ridge, path, meets):
    """Fill in at which vertices of a path more than two strands cross a ring around them, of which nothing is hidden.

    Args:
        ridge: see `Ridge`.
        path: shape (m, 7), see `walk_on`.
        meets: filled, shape (m,).
    """
    hidden = ridge.hidden
    rows, columns = hidden.shape
    values, ways = np.empty(RING), np.empty((RING, 2))
    for place in range(RING):
        ways[place, 0] = RADIUS_PX * math.cos(2.0 * math.pi * place / RING)
        ways[place, 1] = RADIUS_PX * math.sin(2.0 * math.pi * place / RING)
    for index in range(len(path)):
        meets[index] = False
        is_covered = False
        for place in range(RING):
            u, v = path[index, 0] + ways[place, 0], path[index, 1] + ways[place, 1]
            column, row = min(max(int(u + 0.5), 0), columns - 1), min(max(int(v + 0.5), 0), rows - 1)
            if hidden[row, column] != 0:
                is_covered = True
                break
            values[place] = within(ridge.strength, u, v) - ridge.noise
        if is_covered:
            continue
        bound, peaks = max(SHOWN * path[index, 4], ridge.faintest), 0
        for place in range(RING):
            value = values[place]
            if value <= bound:
                continue
            before = value > values[place - 1] and value > values[place - 2]
            after = value >= values[(place + 1) % RING] and value >= values[(place + 2) % RING]
            peaks += before and after
        meets[index] = peaks > 2


def _turn(path: NDArray[np.float64], at: int, entry: Arm, out: Arm) -> tuple[int, int]:
    """Lead a path from a vertex on from one arm to another; return how many vertices it has, and where that begins."""
    curve = joining_curve(entry, out)[1:]
    rows = np.vstack([np.zeros((len(curve), 7)), out.path[1:]])[: len(path) - at]
    curve = curve[: len(rows)]
    along = np.gradient(np.vstack([path[at - 1, :2], curve]), axis=0)[1:]
    rows[: len(curve), :2], rows[: len(curve), 2] = curve, np.arctan2(along[:, 1], along[:, 0])
    rows[: len(curve), 3], rows[: len(curve), 4], rows[: len(curve), 6] = out.curvature, path[at - 1, 4], 1.0
    count = at + len(rows)
    path[at:count] = rows
    path[at - 1 : count, 5] = path[at - 1, 5] + arc_lengths(path[at - 1 : count, :2])
    return count, at + len(curve)


def find_arms(ridge: Ridge, part: NDArray[np.float64]) -> list[Arm]:
    """Walk out of a crossing on every side.

    Args:
        ridge: that is followed.
        part: the vertices of a path that belong to the crossing; see `walk_on`.
    """
    edge, usual = _edge_around(part[:, :2]), float(median(part[:, 4]))
    values = sampled(ridge.strength, edge) - ridge.noise
    values = (values + np.roll(values, 1) + np.roll(values, -1)) / 3.0
    turns = 2.0 * np.pi * np.arange(72) / 72
    ways = np.column_stack([np.cos(turns), np.sin(turns)])
    arms: list[Arm] = []
    for peak in sorted(_peaks(values, max(SHOWN * usual, ridge.faintest)), key=lambda index: -values[index]):
        start = edge[peak]
        outward = start - part[np.argmin(((part[:, :2] - start) ** 2).sum(axis=1)), :2]
        places = start + np.array([-3.0, 0.0, 2.0, 4.0, 6.0, 8.0, 10.0])[:, None, None] * ways
        score = np.minimum(sampled(ridge.strength, places) - ridge.noise, STRONGEST * usual).mean(axis=0)
        score[ways @ outward < 0.0] = -np.inf
        arm = _arm(ridge, start, float(turns[np.argmax(score)]), usual)
        if arm is None:
            continue
        away = np.sqrt(((arm.path[:7, None, :2] - part[:, :2]) ** 2).sum(axis=2).min(axis=1))
        # One that leads back into the crossing does not leave it.
        if away[-1] < away[0] or any(other.covers(arm.start) for other in arms):
            continue
        arms = [other for other in arms if not arm.covers(other.start)] + [arm]
    return sorted(arms, key=lambda arm: -arm.strength)[:8]


def _edge_around(points: Points) -> Points:
    """Return the outline of all that lies within `RADIUS_PX` of a polyline, a pixel between vertices, shape (m, 2)."""
    origin = np.floor(points.min(axis=0)) - RADIUS_PX - 2.0
    columns, rows = np.ceil(points.max(axis=0) - origin + RADIUS_PX + 3.0).astype(int)
    area = np.zeros((rows, columns), np.uint8)
    at = np.round((points - origin) * 16.0).astype(np.int32)
    cv2.polylines(area, [at], False, 1, round(2.0 * RADIUS_PX), cv2.LINE_8, 4)
    outlines, _ = cv2.findContours(area, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.asarray(max(outlines, key=len)[:, 0] + origin)


def _peaks(values: NDArray[np.floating], bound: float) -> list[int]:
    """Return the peaks above a bound along a closed line, of those without a dip between them the highest."""
    dip = 0.8  # of the weaker of two peaks, at most, between them
    found: list[int] = []
    first, top, low = int(np.argmin(values)), -1, math.inf
    for index in (np.arange(len(values) + 1) + first) % len(values):
        value = float(values[index])
        if top >= 0 and value < dip * values[top]:
            found.append(top)
            top, low = -1, value
        elif top >= 0:
            top = int(index) if value > values[top] else top
        else:
            low = min(low, value)
            top = int(index) if value > bound and low < dip * value else -1
    return found


def _arm(ridge: Ridge, start: Points, angle: float, usual: float) -> Arm | None:
    """Walk along an arm, and measure it where it begins; None if it is too short."""
    length = 28.0  # px, over which an arm is measured
    path = path_buffer(length)
    path[0, :5] = start[0], start[1], angle, 0.0, usual
    count = walk_on(ridge, length, path, 1)
    if count <= 4:
        return None
    path = path[1:count]  # The first vertex isn't in the ridge's middle.
    path[:, 5] -= path[0, 5]
    steps = np.diff(path[:, :2], axis=0)
    angles = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    at = 0.5 * (path[1:, 5] + path[:-1, 5])
    # Generalised least squares: the farther away, the less a direction tells of the beginning.
    near, apart = np.minimum.outer(at, at), np.abs(np.subtract.outer(at, at))
    # A vertex is off by 0.4 px across, and the direction between two by 0.15 rad.
    noise = TURNING * near + CURVATURE_RATE * near**2 * (near / 3.0 + apart / 2.0) + 0.15**2 * np.eye(len(at))
    design = np.column_stack([np.ones_like(at), at])
    weights = np.linalg.solve(noise, design)
    covariance = np.zeros((3, 3))
    covariance[0, 0], covariance[1:, 1:] = 0.4**2, np.linalg.inv(design.T @ weights)
    begun, curvature = covariance[1:, 1:] @ weights.T @ angles
    return Arm(path, float(begun), float(curvature), covariance, float(median(path[:, 4])))


def arm_of(arms: list[Arm], part: NDArray[np.float64], *, leaving: bool) -> int:
    """Return the number of the arm along which a part of a path leaves a crossing, or comes to it; -1 for none."""
    best, nearest = -1, ON_ARM_PX
    for number, arm in enumerate(arms):
        away = np.hypot(*(part[:, :2] - arm.start).T)
        at = int(np.argmin(away))
        if away[at] < nearest and math.cos(part[at, 2] - arm.angle) * (1.0 if leaving else -1.0) > ALONG:
            best, nearest = number, float(away[at])
    return best


def joining_curve(one: Arm, other: Arm) -> Points:
    """Return the cubic that leads from one arm to another, in steps, shape (m, 2)."""
    chord = float(np.hypot(*(other.start - one.start)))
    leaving, arriving = (np.array([math.cos(arm.angle), math.sin(arm.angle)]) for arm in (one, other))
    return cubic(one.start, other.start, -chord * leaving, chord * arriving, max(3, round(chord / STEP_PX) + 1))


def cubic(start: Points, end: Points, leaving: Points, arriving: Points, count: int) -> Points:
    """Return points of the cubic from one point to another with given tangents, shape (count, 2)."""
    t = np.linspace(0.0, 1.0, count)[:, None]
    from_start = (1.0 + 2.0 * t) * (1.0 - t) ** 2 * start + t * (1.0 - t) ** 2 * leaving
    return np.asarray(from_start + t * t * (3.0 - 2.0 * t) * end + t * t * (t - 1.0) * arriving)


def _cost(ridge: Ridge, one: Arm, other: Arm) -> float:
    """Return what it costs that two arms are one strand; see the module's equation."""
    across = other.start - one.start
    curve, chord = joining_curve(one, other), math.atan2(across[1], across[0])
    g = float(arc_lengths(curve)[-1])
    a, b = math.remainder(one.angle + math.pi - chord, math.tau), math.remainder(other.angle - chord, math.tau)
    if g < 1.0 or max(abs(a), abs(b)) > 2.0:  # rad from the chord
        return math.inf
    k = -one.curvature
    error = np.array([a * g + 0.5 * k * g * g, b - a - k * g, other.curvature - k])
    carry = np.array([[1.0, g, 0.5 * g * g], [0.0, 1.0, g], [0.0, 0.0, 1.0]]) * (1.0, 1.0, -1.0)  # against its path
    wander = CURVATURE_RATE * np.array(
        [[g**5 / 20.0, g**4 / 8.0, g**3 / 6.0], [g**4 / 8.0, g**3 / 3.0, g**2 / 2.0], [g**3 / 6.0, g**2 / 2.0, g]]
    )
    wander[:2, :2] += TURNING * np.array([[g**3 / 3.0, g**2 / 2.0], [g**2 / 2.0, g]])
    spread = carry @ one.covariance @ carry.T + other.covariance + wander
    distance = float(error @ np.linalg.solve(spread, error))
    freedom = 4.0  # degrees of freedom of Student's distribution: some threads bend far more than most
    bend = 0.5 * (freedom + 3.0) * math.log1p(distance / freedom)
    bend += 0.5 * float(np.log(np.linalg.det(2.0 * np.pi * spread)))
    stronger = max(one.strength, other.strength)
    shown = (sampled(ridge.strength, curve[1:-1]) - ridge.noise) / (0.5 * SHOWN * (one.strength + other.strength))
    bare = g / (len(curve) - 1) * float(np.maximum(0.0, 1.0 - shown).sum())
    differs = (one.strength - other.strength) / (0.3 * stronger)  # by which strengths of one strand differ
    return bend + 0.5 * bare + 0.5 * differs**2


def _beyond(
    ridge: Ridge, max_length: float, arms: list[Arm], entry: int
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Walk along all arms but the one by which a strand comes.

    Returns:
        Which arms are one strand outside of the crossing, which would be a ring if they were one inside too, shape
        (n, n), and how long each is [px], shape (n,).
    """
    closed, lengths = np.zeros((len(arms), len(arms)), np.bool_), np.zeros(len(arms))
    for number, arm in enumerate(arms):
        if number == entry:
            continue
        path = path_buffer(max_length)
        path[: len(arm.path)] = arm.path
        count = walk_on(ridge, max_length, path, len(arm.path))
        lengths[number] = path[count - 1, 5]
        later, back = path[len(arm.path) // 2 : count], count
        for other in set(range(len(arms))) - {number}:
            near = np.hypot(*(later[:, :2] - arms[other].start).T) < ON_ARM_PX
            near &= np.cos(later[:, 2] - arms[other].angle) < -ALONG
            if near.any() and np.argmax(near) < back:
                back, reached = int(np.argmax(near)), other
        if back < count:
            closed[number, reached] = closed[reached, number] = True
    return closed, lengths


def pairings(arms: tuple[int, ...]) -> Iterator[tuple[tuple[int, int], ...]]:
    """Give all ways to pair some arms; one that is paired with itself ends."""
    if not arms:
        yield ()
        return
    for other in arms:
        for rest in pairings(tuple(arm for arm in arms[1:] if arm != other)):
            yield ((arms[0], other), *rest)


def continuations(ridge: Ridge, lengths: tuple[float, float], arms: list[Arm], entry: int) -> NDArray[np.float64]:
    """Return how probable it is that a strand goes on along each arm, shape (n,).

    Args:
        ridge: that is followed.
        lengths: of the strand up to here, and of the whole thread at most [px].
        arms: n strands that leave a crossing.
        entry: number of the arm by which the strand comes; its own probability is that the strand ends.
    """
    count = len(arms)
    # That of an arm that ends, in any state.
    costs = np.full((count, count), 12.0 + 0.5 * math.log(2.0 * RADIUS_PX * 2.0 * math.pi * 0.2))
    for one, other in combinations(range(count), 2):
        cost = 0.5 * (_cost(ridge, arms[one], arms[other]) + _cost(ridge, arms[other], arms[one]))
        costs[one, other] = costs[other, one] = cost
    closed, beyond = _beyond(ridge, lengths[1], arms, entry)
    costs[closed] = np.inf
    # A thread that ends before 85 % of its length costs more, in full before 65 %.
    early = 4.0 * np.clip((0.85 - (lengths[0] + beyond) / lengths[1]) / 0.2, 0.0, 1.0)
    early[entry] = 0.0
    costs[entry] += early
    costs[:, entry] += early
    return chances_of(costs, entry)


def chances_of(costs: NDArray[np.float64], entry: int) -> NDArray[np.float64]:
    """Return how probable it is that a strand goes on along each arm, by all pairings of the arms, shape (n,).

    Args:
        costs: of each pair, and in the diagonal of an arm that ends, shape (n, n).
        entry: number of the arm by which the strand comes; its own probability is that the strand ends.
    """
    every = list(pairings(tuple(range(len(costs)))))
    totals = np.array([sum(costs[pair] for pair in pairing) for pairing in every])
    weights = np.exp(totals.min() - totals)
    chances = np.zeros(len(costs))
    for pairing, weight in zip(every, weights, strict=True):
        one, other = next(pair for pair in pairing if entry in pair)
        chances[other if one == entry else one] += weight
    return np.asarray(chances / chances.sum())


def find_centreline(picture: Picture, gray: Gray, needle: MeasuredNeedle, max_length: float) -> Points:
    """Follow the thread from the needle's tail to its end.

    The ridge strength is the black-hat transform of the darkest colour without the needle: how much darker a pixel is
    than the brightest background within a few pixels. The walk leaves the tail along the arc that shows most of the
    thread, below the needle where it must, and goes by steps along arcs that look some way ahead, a change of curvature
    having a price: so it goes straight over gaps. At crossings the smoothest of all pairings of the strands that meet
    decides. Where the needle or the lamp's reflection hides the thread, nothing counts for or against a way. Where that
    shows little, a thread wider than the transform's window is looked for at half the size.

    Args:
        picture: the frame or a part of it.
        gray: its darkest colour without the needle.
        needle: the needle, in the picture's pixels.
        max_length: the walk stops at this length [px].

    Returns:
        Vertices from the tail on, up to the first crossing where it is in doubt how the thread goes on, shape (m, 2)
        [px]; m = 1 if no thread is visible.
    """
    wall = picture.wall
    hidden = glare_mask(picture)
    # At the tail the mask begins 1.5 px inside of the needle, so that the walk can leave.
    box, covered = needle.area(hidden.shape, 1.5, needle.length_px + 3.0, needle.width_px + 3.0)
    hidden[box][covered] = 255
    inside = wall.inside(picture.shape, RIM_PX)
    # What is measured beside the wall takes its ground from both sides, and must not go on into the rim.
    gray = np.asarray(cv2.copyTo(gray, inside, picture.darkest.floor.copy()), dtype=np.uint8)
    dish = (*wall.centre, wall.radius - WALL_PX)
    tail, direction = needle.tail_px, needle.direction_px
    start = np.array([tail[0], tail[1], math.atan2(direction[1], direction[0])])

    def walked(*, wide: bool) -> tuple[Ridge, NDArray[np.float64], int, float]:
        """Return a ridge, the path along it, its vertices and how much thread they show."""
        ridge = black_hat(gray, hidden, inside, dish, wide=wide)
        _clear_shade(ridge, picture, needle)
        path = path_buffer(max_length)
        # Hidden by the needle and what is next to it.
        count = follow(ridge, start, max_length, needle.length_px + 12.0, path)
        return ridge, path, count, worth(path, count)

    ridge, path, count, shown = walked(wide=False)
    if shown < 0.5 * max_length and (other := walked(wide=True))[-1] > shown + 0.4 * max_length:
        ridge, path, count, _ = other
    count, crossings = resolve_crossings(ridge, max_length, path, count)
    if picture.mask is not None:
        above = cv2.subtract(ridge.strength, ridge.noise)
        count = min(count, count_off_outline(path[:count, :2], above, picture.mask, ridge.faintest))
    points = path[:count, :2].copy()
    refine(ridge, points, path[:count, 6] > 0.0)
    doubtful = [first for first, confidence in crossings if confidence < 0.9]
    return points[: max(2, min(doubtful))] if doubtful else points


def _clear_shade(ridge: Ridge, picture: Picture, needle: MeasuredNeedle) -> None:
    """Take what is no stronger than the needle's shadow out of a ridge beside the needle."""
    # A shadow has 12 % of steel's darkness, and lies within 10 px.
    shade = 0.12 * needle.contrast * middle(picture.darkest.floor[::4, ::4])
    box, beside = needle.area(picture.shape, 10.0, needle.length_px, needle.width_px + 2.0 * 10.0)
    ridge.strength[box][beside & (ridge.strength[box] < shade)] = 0


def count_off_outline(points: Points, ridge: NDArray[np.uint8], mask: SceneMask, faintest: float) -> int:
    """Return how many vertices of a walk show the thread, where it may have gone on along a bare outline.

    A walk ends before it enters a shape. A ridge along an outline is the thread's or the shape's own edge. The last
    vertices along an outline count only as long as their ridge is stronger than that of the same outline away from
    the walk, or that one shows none.

    Args:
        points: vertices of the walk, shape (m, 2) [px].
        ridge: ridge strength in grey levels, uint8.
        mask: of the picture.
        faintest: a strength that is no noise.
    """
    depths = nearest(mask.depth, points)
    inside = depths > mask.tolerance_px
    if inside.any():  # Whatever was followed from here on, it is no thread.
        first = max(1, int(np.argmax(inside)))
        points, depths = points[:first], depths[:first]
    near = np.abs(depths) <= mask.band_px
    run = len(near) if near.all() else int(np.argmin(near[::-1]))
    if run < 5 or not len(mask.rim):  # vertices along an outline
        return len(points)
    rim = mask.rim[:, :2]
    last = mask.rim[np.argmin(((rim - points[-1]) ** 2).sum(axis=1)), 2]
    rim = rim[mask.rim[:, 2] == last]
    apart = ((rim[:, None] - points[None, ::3]) ** 2).sum(axis=2).min(axis=1)
    rows, columns = ridge.shape
    reach = int(mask.band_px) + 1
    bare = (apart > (2.0 * mask.band_px) ** 2) & (rim.min(axis=1) > reach)
    bare &= (rim < (columns - 1 - reach, rows - 1 - reach)).all(axis=1)
    if bare.sum() < 8:
        return len(points)
    usual = middle(greatest_near(ridge, rim[bare], reach))
    if usual < faintest:
        return len(points)
    # The thread ends where the sum of what speaks for it and against it is greatest: single strong pixels count little.
    surplus = np.cumsum(np.minimum(greatest_near(ridge, points[-run:], 1) / (1.3 * usual) - 1.0, 0.5))
    shown = int(np.argmax(surplus)) + 1 if surplus.max() > 0.0 else 0
    return max(1, len(points) - run + shown)


def without_needle(layer: Layer, needle: MeasuredNeedle) -> Gray:
    """Return a layer's pixels in which a needle has the floor's brightness.

        I' = min(I + F c share, F)

    with the floor F, the needle's contrast c, and the share of each pixel that a drawn needle covers.
    """
    half, length = 0.5 * needle.width_px + BLOOM_PX, needle.length_px
    # Up to two deviations of the blur beside the outline, light of the needle is mixed in.
    width = 2.0 * math.ceil(half + 2.0 * BLUR_PX + 1.0)
    (rows, columns), near = needle.area(layer.pixels.shape, 0.0, length, width)
    v, u = np.nonzero(near)
    u, v = u + columns.start, v + rows.start
    s, d = needle.arc.coordinates(np.column_stack([u, v]).astype(float))
    own = half * (1.0 - (1.0 - THIN) * np.clip((s - (1.0 - TAPER) * length) / (TAPER * length), 0.0, 1.0))
    share = (_edge(own - d) - _edge(-own - d)) * _edge(s) * _edge(length - s)
    share[share <= 0.01] = 0.0
    floor, result = layer.floor[v, u], layer.pixels.copy()
    light = result[v, u]
    result[v, u] = np.maximum(light, np.minimum(light + floor * needle.contrast * share, floor).astype(np.uint8))
    return result


def _edge(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how much of a blurred edge is covered at distances inside of it; see `template`."""
    return np.asarray(1.0 / (1.0 + np.exp(-STEEPNESS * x)))
