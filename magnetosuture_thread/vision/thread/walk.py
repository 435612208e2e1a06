"""The walk along a dark ridge, in compiled code: hundreds of steps, each along the best of many arcs.

Where the thread crosses itself, the walk goes on the way that shows most of the thread.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.vision.images import sample

STEP_PX = 2.0
GAP_PX = 13.0  # the walk goes on over a gap of this length
HIDDEN_GAP = 0.25  # as much a hidden pixel counts as a gap
WEAK = 0.3  # of the ridge's usual strength: below, there is no thread
STRONGEST = 1.25  # of the usual strength: a stronger ridge counts no more
UNKNOWN = 0.45  # of the usual strength, as which a hidden pixel counts
AHEAD = 9  # steps looked ahead
NEAR_POINTS = 5  # of these that count in full; the others by FAR
FAR_WEIGHT = 0.6
BENDS = 31  # curvatures tried at each step ...
SHARPEST = 0.21  # ... up to this [1/px], closer around the present one's
BEND_COST = 1.1  # of the usual strength, for a change of curvature by 1 / px, along the way looked ahead
SMOOTHING = 0.05  # weight of the newest strength in the usual one
WAYS = 90  # directions tried at the tail
START_BENDS = (-0.08, -0.04, 0.0, 0.04, 0.08)
START_PX = 3.0  # the first sample's distance from the tail
START_STEPS = 8
FOLD = math.cos(math.radians(28.0))  # nearer to the needle's own direction the thread doesn't leave
ASIDE_PX = 0.5
APART = 0.05  # curvatures of two ways at a fork differ by [1/px]
FORK = 0.75  # of the usual strength, at least, along the other way
FORCED = 4  # steps that a walk is held to the other way
MAX_FORKS = 200
FORK_ROUNDS = 4
MIN_GAIN_PX = 8.0  # that another way must show more of the thread
SUFFICIENT_SHARE = 0.9  # of the longest walk: so much thread seen needs no other way
TWICE_PX, TWICE_STEPS = 1.6, 6  # a vertex this near to one that lies so many steps back sees the same thread
UNSTEADY = 12.0  # px for each 1 / px of change in curvature


class Ridge(NamedTuple):
    """The dark ridges of an image, as compiled functions read them.

    Attributes:
        strength: in grey levels, shape (rows, columns), uint8.
        hidden: where nothing can be seen, not 0 there, `factor` times smaller, uint8.
        factor: see `hidden`.
        noise: the strength where nothing is.
        faintest: a strength above noise that is no noise.
    """

    strength: np.ndarray
    hidden: np.ndarray
    factor: int
    noise: float
    faintest: float


@compiled
def is_hidden(ridge, u, v):
    """Return whether a point is hidden."""
    c, r = int(u + 0.5) // ridge.factor, int(v + 0.5) // ridge.factor
    rows, columns = ridge.hidden.shape
    return 0 <= c < columns and 0 <= r < rows and ridge.hidden[r, c] != 0


@compiled
def leave_tail(ridge, u, v, heading):
    """Find the arc along which the thread leaves the tail.

    Returns:
        Its angle, its curvature, and its mean strength in grey levels; 0 if there is none.
    """
    best, best_angle, best_bend = 0.0, 0.0, 0.0
    for way in range(WAYS):
        angle = 2.0 * math.pi * way / WAYS
        if math.cos(angle - heading) > FOLD:
            continue
        for bend in START_BENDS:
            total, seen = 0.0, 0
            for step in range(START_STEPS):
                s = START_PX + STEP_PX * step
                middle = angle + 0.5 * bend * s
                value = sample(ridge.strength, u + s * math.cos(middle), v + s * math.sin(middle)) - ridge.noise
                total += min(value, 80.0)
                if value > ridge.faintest:
                    seen += 1
            if seen >= START_STEPS - 3 and total / START_STEPS > best:
                best, best_angle, best_bend = total / START_STEPS, angle, bend
    return best_angle, best_bend, best


@compiled
def score_arcs(ridge, usual, state, bends, scores):
    """Fill in the strength of the ridge along each of many arcs ahead, as a share of the usual, less its price."""
    u, v, angle, bend = state
    for index in range(len(bends)):
        tried = bends[index]
        # The arc as chords: each is the last one turned by the same angle.
        x, y = u, v
        first = angle + 0.5 * tried * STEP_PX
        across, down = STEP_PX * math.cos(first), STEP_PX * math.sin(first)
        cosine, sine = math.cos(tried * STEP_PX), math.sin(tried * STEP_PX)
        score, weight = 0.0, 0.0
        for step in range(AHEAD):
            x, y = x + across, y + down
            across, down = across * cosine - down * sine, across * sine + down * cosine
            value = min((sample(ridge.strength, x, y) - ridge.noise) / usual, STRONGEST)
            if value < UNKNOWN and is_hidden(ridge, x, y):
                value = UNKNOWN
            share = 1.0 if step < NEAR_POINTS else FAR_WEIGHT
            score += share * value
            weight += share
        scores[index] = score / weight - BEND_COST * abs(tried - bend) - 0.15 * abs(tried)


@compiled
def find_best_arcs(ridge, usual, state, bends, scores):
    """Return the curvature of the arc ahead that follows the ridge best, and of another, with its score.

    The other's score is -1 if there is none: it must be the best of its neighbours, apart from the first, and
    lie on a ridge by itself.
    """
    bend = state[3]
    for index in range(BENDS):
        part = 2.0 * index / (BENDS - 1) - 1.0  # closer together near the present one
        bends[index] = min(SHARPEST, max(-SHARPEST, bend + 1.6 * SHARPEST * part * abs(part)))
    score_arcs(ridge, usual, state, bends, scores)
    first = scores.argmax()
    second, score = first, -1.0
    for index in range(1, BENDS - 1):
        apart = abs(bends[index] - bends[first])
        if apart > APART and scores[index] > scores[index - 1] and scores[index] >= scores[index + 1]:
            plain = scores[index] + BEND_COST * abs(bends[index] - bend)
            if plain > FORK and plain > score:
                second, score = index, plain
    return bends[first], bends[second], score


@compiled
def find_ridge_middle(strength, noise, u, v, angle, max_shift):
    """Return how far aside the ridge's middle lies, at most `max_shift`, and the strength there."""
    x, y = -math.sin(angle), math.cos(angle)
    peak, total, moment = 0.0, 0.0, 0.0
    for index in range(-4, 5):
        peak = max(peak, sample(strength, u + index * ASIDE_PX * x, v + index * ASIDE_PX * y))
    for index in range(-4, 5):
        aside = index * ASIDE_PX
        weight = max(0.0, sample(strength, u + aside * x, v + aside * y) - noise - 0.3 * (peak - noise))
        total += weight
        moment += weight * aside
    shift = 0.0 if total <= 0.0 else min(max_shift, max(-max_shift, moment / total))
    return shift, sample(strength, u + shift * x, v + shift * y) - noise


@compiled
def walk_on(ridge, dish, max_length, path, count, bend_first, forks):
    """Walk along the ridge from a path's last vertex to the ridge's end.

    Args:
        ridge: to walk along.
        dish: centre and the farthest the walk may go from it [px].
        max_length: of the walk [px].
        path: u, v, angle, bend, usual strength and length at each vertex, and 1 where it shows the thread, else 0,
            shape (max count, 7); filled in.
        count: vertices that there are.
        bend_first: curvature to begin with; beyond 1 the best.
        forks: filled with where there was another way: index, curvature, score; shape (most forks, 3).

    Returns:
        The number of vertices, and of forks.
    """
    u, v, angle, bend, usual, length, _ = path[count - 1]
    bends, scores = np.empty(BENDS), np.empty(BENDS)
    gap, last, fork_count, forced = 0.0, count, 0, FORCED if bend_first < 1.0 else 0
    while length < max_length and gap < GAP_PX and count < len(path):
        if forced > 0:
            bend_ahead, forced = bend_first, forced - 1
        else:
            bend_ahead, other, score = find_best_arcs(ridge, usual, (u, v, angle, bend), bends, scores)
            if score > 0.0 and fork_count < len(forks):
                forks[fork_count] = (float(count), other, score)
                fork_count += 1
        if gap > 0.0:
            bend_ahead = 0.5 * (bend_ahead + bend)
        middle = angle + 0.5 * bend_ahead * STEP_PX
        x, y = u + STEP_PX * math.cos(middle), v + STEP_PX * math.sin(middle)
        turned = angle + bend_ahead * STEP_PX
        shift, strength = find_ridge_middle(ridge.strength, ridge.noise, x, y, turned, 0.7)
        seen = strength > max(WEAK * usual, ridge.faintest)
        if seen:
            if forced == 0:
                x, y = x - shift * math.sin(turned), y + shift * math.cos(turned)
                turned += 0.25 * shift / STEP_PX
            usual = max(ridge.faintest, (1.0 - SMOOTHING) * usual + SMOOTHING * min(strength, STRONGEST * usual))
            gap = 0.0
        else:
            gap += STEP_PX * (HIDDEN_GAP if is_hidden(ridge, x, y) else 1.0)
        if math.hypot(x - dish[0], y - dish[1]) > dish[2]:
            break
        bend += 0.5 * (bend_ahead - bend)
        length += math.hypot(x - u, y - v)
        u, v, angle = x, y, turned
        path[count] = (u, v, angle, bend, usual, length, 1.0 if seen else 0.0)
        count += 1
        if seen:
            last = count
    return last, fork_count


@compiled
def refine(strength, points, shown):
    """Centre the vertices once more, now that their neighbours on both sides are known, and even them out."""
    count = len(points)
    if count < 4:
        return
    shifts = np.zeros(count)
    normals = np.zeros((count, 2))
    for index in range(1, count):
        before, after = max(0, index - 2), min(count - 1, index + 2)
        x, y = points[after, 0] - points[before, 0], points[after, 1] - points[before, 1]
        length = max(1e-9, math.hypot(x, y))
        normals[index] = (-y / length, x / length)
        if shown[index]:
            u, v = points[index]
            shifts[index], _ = find_ridge_middle(strength, 0.0, u, v, math.atan2(y, x), 1.0)
    for index in range(1, count):
        before, after = index - 1, min(count - 1, index + 1)
        even = 0.5 * shifts[index] + 0.25 * (shifts[before] + shifts[after])
        points[index] += even * normals[index]


@compiled
def measure_shown_length(path, count):
    """Return how much thread a path shows, none of it twice [px], less its unsteadiness."""
    value = 0.0
    for index in range(1, count):
        fresh = path[index, 6] > 0.0
        for other in range(0, index - TWICE_STEPS):
            if not fresh:
                break
            u, v = path[index, 0] - path[other, 0], path[index, 1] - path[other, 1]
            fresh = u * u + v * v >= TWICE_PX**2
        if fresh:
            value += path[index, 5] - path[index - 1, 5]
        value -= UNSTEADY * abs(path[index, 3] - path[index - 1, 3])
    return value


@compiled
def follow_ridge(ridge, start, dish, max_length):
    """Walk along the ridge from the tail to its end; try forks where much of the thread is missing.

    Args:
        ridge: to walk along.
        start: the tail (u, v) and the needle's direction there [px, px, rad].
        dish: centre and the farthest the walk may go from it [px].
        max_length: of the walk, a little longer than the thread [px].

    Returns:
        The path; see `walk_on`.
    """
    path = np.zeros((int(max_length) + 16, 7))  # steps are longer than a pixel
    u, v, heading = start
    path[0, :2] = (u, v)
    angle, bend, strength = leave_tail(ridge, u, v, heading)
    if strength < 1.2 * ridge.faintest:
        return path[:1]
    middle = angle + 0.5 * bend * START_PX
    u, v = u + START_PX * math.cos(middle), v + START_PX * math.sin(middle)
    path[1] = (u, v, angle + bend * START_PX, bend, max(strength, ridge.faintest), START_PX, 1.0)
    forks, other_forks, best_forks = np.empty((MAX_FORKS, 3)), np.empty((MAX_FORKS, 3)), np.empty((MAX_FORKS, 3))
    count, fork_count = walk_on(ridge, dish, max_length, path, 2, 9.0, forks)
    value, sufficient = measure_shown_length(path, count), SUFFICIENT_SHARE * max_length
    other, best = np.empty_like(path), np.empty_like(path)
    for _ in range(FORK_ROUNDS):
        if value > sufficient:
            break
        best_value, best_count, best_fork_count = value + MIN_GAIN_PX, 0, 0
        for index in range(fork_count):
            at = int(forks[index, 0])
            if at >= count or at < 2:
                continue
            # Of forks in a row, towards one and the same other way, the best only.
            near = forks[max(0, index - 2) : min(fork_count, index + 3)]
            if ((np.abs(near[:, 0] - at) < 2.5) & (near[:, 2] > forks[index, 2])).any():
                continue
            other[:at] = path[:at]
            reached, found = walk_on(ridge, dish, max_length, other, at, forks[index, 1], other_forks)
            tried = measure_shown_length(other, reached)
            if tried > best_value:
                best_value, best_count, best_fork_count = tried, reached, found
                best[:reached], best_forks[:found] = other[:reached], other_forks[:found]
        if best_count == 0:
            break
        value, count, fork_count = best_value, best_count, best_fork_count
        path[:count], forks[:fork_count] = best[:count], best_forks[:fork_count]
    return path[:count]
