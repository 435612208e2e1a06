"""Strands that meet at a crossing, and which of them are one: the smoothest of all pairings.

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

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.vision.thread.appearance import sampled
from magnetosuture_thread.vision.thread.ridge import Ridge
from magnetosuture_thread.vision.thread.walk import STEP_PX, STRONGEST, walk_on

RADIUS_PX = 7.0  # around a path's vertices, that belongs to a crossing
SHOWN = 0.45  # of the usual strength, at least, where a strand leaves it
DIP = 0.8  # of the weaker of two peaks, at most, between them
MAX_ARMS = 8
ARM_PX, MIN_ARM = 28.0, 4  # length over which an arm is measured, and vertices that it has at least
LEAVING = 7  # vertices, after which an arm is farther from the crossing than at first
SAME_PX = 2.5  # from an arm, where another that begins is the same
ON_ARM_PX = 4.0  # from an arm's beginning, where a path goes along it ...
ALONG = 0.3  # ... if the cosine of the angle between them is greater
WAYS = 72  # directions tried at an arm's beginning
ALONG_PX = (-3.0, 0.0, 2.0, 4.0, 6.0, 8.0, 10.0)
TURNING, CURVATURE_RATE = 0.01, 1e-4  # 1 / px, 1 / px^3; variances of tangent and curvature for each length
POSITION_ERROR, ANGLE_ERROR = 0.4, 0.15  # px, rad; of a walk's vertex across, and of the direction between two
STRENGTH_ERROR = 0.3  # of the stronger, by which strengths of one strand differ
FREEDOM = 4.0  # degrees of freedom of Student's distribution: some threads bend far more than most
MAX_TURN = 2.0  # rad; from the chord, by which a strand leaves an arm
BARE_COST = 0.5  # for each pixel of a joining curve that shows nothing
END_COST = 12.0  # of an arm that ends, besides what its state costs among all states
SHORT_COST = 4.0  # of a way on which the thread ends early ...
WHOLE, EARLY = 0.85, 0.2  # ... before this share of its greatest length, in full where it lacks so much more
ANY_STATE = math.log(2.0 * RADIUS_PX * 2.0 * math.pi * 0.2)  # of states in all directions, bent up to 0.1 / px


@dataclass(frozen=True)
class Arm:
    """A strand that leaves a crossing.

    Attributes:
        path: the walk along it, away from the crossing; see `walk_on`.
        strong: see there.
        angle: of its tangent where it begins [rad].
        curvature: there [1/px].
        covariance: of the offset, the angle and the curvature there, shape (3, 3).
        strength: of the ridge, median.
    """

    path: NDArray[np.float64]
    strong: NDArray[np.bool_]
    angle: float
    curvature: float
    covariance: NDArray[np.float64]
    strength: float

    @property
    def start(self) -> Points:
        """Return where it begins, shape (2,) [px]."""
        return np.asarray(self.path[0, :2])


def walk_along(
    ridge: Ridge,
    dish: tuple[float, float, float],
    max_length: float,
    path: NDArray[np.float64],
    strong: NDArray[np.bool_],
    count: int,
) -> int:
    """Walk on along a ridge without forks; see `walk_on`."""
    noise, faintest = float(ridge.noise), float(ridge.faintest)
    hidden, stiffness, none = ridge.hidden, ridge.stiffness, np.empty((0, 3))
    return int(
        walk_on(
            ridge.strength,
            hidden,
            ridge.factor,
            noise,
            faintest,
            stiffness,
            dish,
            max_length,
            path,
            strong,
            count,
            9.0,
            none,
        )[0]
    )


def find_arms(ridge: Ridge, dish: tuple[float, float, float], part: NDArray[np.float64]) -> list[Arm]:
    """Walk out of a crossing on every side.

    Args:
        ridge: that is followed.
        dish: see `walk_on`.
        part: the vertices of a path that belong to the crossing; see `walk_on`.
    """
    edge, usual = _edge_around(part[:, :2]), float(np.median(part[:, 4]))
    values = sampled(ridge.strength, edge) - ridge.noise
    values = (values + np.roll(values, 1) + np.roll(values, -1)) / 3.0
    turns = 2.0 * np.pi * np.arange(WAYS) / WAYS
    ways = np.column_stack([np.cos(turns), np.sin(turns)])
    arms: list[Arm] = []
    for peak in sorted(_peaks(values, max(SHOWN * usual, ridge.faintest)), key=lambda index: -values[index]):
        start = edge[peak]
        outward = start - part[np.argmin(((part[:, :2] - start) ** 2).sum(axis=1)), :2]
        along = sampled(ridge.strength, start + np.array(ALONG_PX)[:, None, None] * ways) - ridge.noise
        score = np.minimum(along, STRONGEST * usual).mean(axis=0)
        score[ways @ outward < 0.0] = -np.inf
        arm = _arm(ridge, dish, start, float(turns[np.argmax(score)]), usual)
        if arm is None or _stays(arm, part[:, :2]) or any(_lies_on(arm.start, other) for other in arms):
            continue
        arms = [other for other in arms if not _lies_on(other.start, arm)] + [arm]
    return sorted(arms, key=lambda arm: -arm.strength)[:MAX_ARMS]


def _stays(arm: Arm, points: Points) -> bool:
    """Say whether an arm leads back into the crossing instead of away from it."""
    away = np.sqrt(((arm.path[:LEAVING, None, :2] - points) ** 2).sum(axis=2).min(axis=1))
    return bool(away[-1] < away[0])


def _edge_around(points: Points) -> Points:
    """Return the outline of all that lies within `RADIUS_PX` of a polyline, a pixel between vertices, shape (m, 2)."""
    origin = np.floor(points.min(axis=0)) - RADIUS_PX - 2.0
    columns, rows = np.ceil(points.max(axis=0) - origin + RADIUS_PX + 3.0).astype(int)
    area = np.zeros((rows, columns), np.uint8)
    at = np.round((points - origin) * 16.0).astype(np.int32)
    cv2.polylines(area, [at], False, 1, round(2.0 * RADIUS_PX), cv2.LINE_8, 4)
    outlines, _ = cv2.findContours(area, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.asarray(max(outlines, key=len)[:, 0] + origin)


def _peaks(values: NDArray[np.float32], bound: float) -> list[int]:
    """Return the peaks above a bound along a closed line, of those without a dip between them the highest."""
    found: list[int] = []
    first, top, low = int(np.argmin(values)), -1, math.inf
    for index in (np.arange(len(values) + 1) + first) % len(values):
        value = float(values[index])
        if top >= 0 and value < DIP * values[top]:
            found.append(top)
            top, low = -1, value
        elif top >= 0:
            top = int(index) if value > values[top] else top
        else:
            low = min(low, value)
            top = int(index) if value > bound and low < DIP * value else -1
    return found


def _lies_on(point: Points, arm: Arm) -> bool:
    return bool(((arm.path[:, :2] - point) ** 2).sum(axis=1).min() < SAME_PX**2)


def _arm(ridge: Ridge, dish: tuple[float, float, float], start: Points, angle: float, usual: float) -> Arm | None:
    """Walk along an arm, and measure it where it begins; None if it is too short."""
    path, strong = np.zeros((int(ARM_PX / STEP_PX) + 3, 6)), np.ones(int(ARM_PX / STEP_PX) + 3, np.bool_)
    path[0, :5] = start[0], start[1], angle, 0.0, usual
    count = walk_along(ridge, dish, ARM_PX, path, strong, 1)
    if count <= MIN_ARM:
        return None
    path, strong = path[1:count], strong[1:count]  # The first vertex isn't in the ridge's middle.
    path[:, 5] -= path[0, 5]
    steps = np.diff(path[:, :2], axis=0)
    angles = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    at = 0.5 * (path[1:, 5] + path[:-1, 5])
    # Generalised least squares: the farther away, the less a direction tells of the beginning.
    near, apart = np.minimum.outer(at, at), np.abs(np.subtract.outer(at, at))
    noise = TURNING * near + CURVATURE_RATE * near**2 * (near / 3.0 + apart / 2.0) + ANGLE_ERROR**2 * np.eye(len(at))
    design = np.column_stack([np.ones_like(at), at])
    weights = np.linalg.solve(noise, design)
    covariance = np.zeros((3, 3))
    covariance[0, 0], covariance[1:, 1:] = POSITION_ERROR**2, np.linalg.inv(design.T @ weights)
    begun, curvature = covariance[1:, 1:] @ weights.T @ angles
    return Arm(path, strong, float(begun), float(curvature), covariance, float(np.median(path[:, 4])))


def arm_of(arms: list[Arm], part: NDArray[np.float64], *, leaving: bool) -> int:
    """Return the number of the arm along which a part of a path leaves a crossing, or comes to it; -1 for none."""
    best, nearest = -1, ON_ARM_PX
    for number, arm in enumerate(arms):
        away = np.hypot(*(part[:, :2] - arm.start).T)
        at = int(np.argmin(away))
        if away[at] < nearest and math.cos(part[at, 2] - arm.angle) * (1.0 if leaving else -1.0) > ALONG:
            best, nearest = number, float(away[at])
    return best


def without_walked(arms: list[Arm], entry: int, walked: Points) -> tuple[list[Arm], int]:
    """Return the arms along which a path has not come or gone before, and the number of its entry among them."""
    fresh = [
        number == entry or not len(walked) or _median_distance(arm.path[:, :2], walked) > SAME_PX
        for number, arm in enumerate(arms)
    ]
    return [arm for arm, kept in zip(arms, fresh, strict=True) if kept], sum(fresh[:entry])


def _median_distance(points: Points, line: Points) -> float:
    return float(np.median(np.sqrt(((points[:, None] - line[None]) ** 2).sum(axis=2).min(axis=1))))


def joining_curve(one: Arm, other: Arm) -> Points:
    """Return the cubic that leads from one arm to another, in steps, shape (m, 2)."""
    chord = float(np.hypot(*(other.start - one.start)))
    t = np.linspace(0.0, 1.0, max(3, round(chord / STEP_PX) + 1))[:, None]
    leaving = -chord * np.array([math.cos(one.angle), math.sin(one.angle)])
    arriving = chord * np.array([math.cos(other.angle), math.sin(other.angle)])
    return np.asarray(
        (1.0 + 2.0 * t) * (1.0 - t) ** 2 * one.start
        + t * (1.0 - t) ** 2 * leaving
        + t * t * (3.0 - 2.0 * t) * other.start
        - t * t * (1.0 - t) * arriving
    )


def _cost(ridge: Ridge, one: Arm, other: Arm) -> float:
    """Return what it costs that two arms are one strand; see the module's equation."""
    across = other.start - one.start
    curve, chord = joining_curve(one, other), math.atan2(across[1], across[0])
    g = float(arc_lengths(curve)[-1])
    a, b = _wrapped(one.angle + math.pi - chord), _wrapped(other.angle - chord)
    if g < 1.0 or max(abs(a), abs(b)) > MAX_TURN:
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
    bend = 0.5 * (FREEDOM + 3.0) * math.log1p(distance / FREEDOM)
    bend += 0.5 * float(np.log(np.linalg.det(2.0 * np.pi * spread)))
    stronger = max(one.strength, other.strength)
    shown = (sampled(ridge.strength, curve[1:-1]) - ridge.noise) / (0.5 * SHOWN * (one.strength + other.strength))
    bare = g / (len(curve) - 1) * float(np.maximum(0.0, 1.0 - shown).sum())
    differs = (one.strength - other.strength) / (STRENGTH_ERROR * stronger)
    return bend + BARE_COST * bare + 0.5 * differs**2


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def _beyond(
    ridge: Ridge, dish: tuple[float, float, float], max_length: float, arms: list[Arm], entry: int
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
        path, strong = np.zeros((int(max_length) + 16, 6)), np.ones(int(max_length) + 16, np.bool_)
        path[: len(arm.path)] = arm.path
        count = walk_along(ridge, dish, max_length, path, strong, len(arm.path))
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


def continuations(
    ridge: Ridge,
    dish: tuple[float, float, float],
    lengths: tuple[float, float],
    arms: list[Arm],
    entry: int,
) -> NDArray[np.float64]:
    """Return how probable it is that a strand goes on along each arm, shape (n,).

    Args:
        ridge: that is followed.
        dish: see `walk_on`.
        lengths: of the strand up to here, and of the whole thread at most [px].
        arms: n strands that leave a crossing.
        entry: number of the arm by which the strand comes; its own probability is that the strand ends.
    """
    count = len(arms)
    costs = np.full((count, count), END_COST + 0.5 * ANY_STATE)
    for one in range(count):
        for other in range(one + 1, count):
            cost = 0.5 * (_cost(ridge, arms[one], arms[other]) + _cost(ridge, arms[other], arms[one]))
            costs[one, other] = costs[other, one] = cost
    closed, beyond = _beyond(ridge, dish, lengths[1], arms, entry)
    costs[closed] = np.inf
    early = SHORT_COST * np.clip((WHOLE - (lengths[0] + beyond) / lengths[1]) / EARLY, 0.0, 1.0)
    early[entry] = 0.0
    costs[entry] += early
    costs[:, entry] += early
    every = list(pairings(tuple(range(count))))
    totals = np.array([sum(costs[pair] for pair in pairing) for pairing in every])
    weights = np.exp(totals.min() - totals)
    chances = np.zeros(count)
    for pairing, weight in zip(every, weights, strict=True):
        one, other = next(pair for pair in pairing if entry in pair)
        chances[other if one == entry else one] += weight
    return np.asarray(chances / chances.sum())
