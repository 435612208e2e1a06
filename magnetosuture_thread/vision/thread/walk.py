"""The walk along a dark ridge, in compiled code: hundreds of steps, each along the best of many arcs."""

from __future__ import annotations

import math

import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.vision.sampling import sample

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
SHARPEST = 0.21  # ... up to this over the root of the stiffness [1/px], closer around the present one's
BEND_COST = 1.1  # of the usual strength, for a change of curvature by 1 / px, along the way looked ahead
NOISE_COST = 2.0  # so much higher is that price where the thread is as faint as noise
SMOOTHING = 0.05  # weight of the newest strength in the usual one
ASIDE_PX, ACROSS = 0.5, 9  # between samples across a ridge, and how many
APART = 0.05  # curvatures of two ways at a fork differ by [1/px]
FORK = 0.75  # of the usual strength, at least, along the other way; a stiff thread's other ways look fainter
STIFF_FORK = 0.5
FORCED = 4  # steps that a walk is held to the other way


@compiled
def is_hidden(hidden, factor, u, v):
    """Say whether a point is hidden."""
    scale = 1.0 / factor  # Dividing whole numbers for each point would take longer than all else.
    x, y = (u + 0.5) * scale, (v + 0.5) * scale
    c, r = int(x), int(y)
    if x < 0.0 or y < 0.0 or c >= hidden.shape[1] or r >= hidden.shape[0]:
        return False
    return hidden[r, c] != 0


@compiled
def arc_scores(ridge, hidden, factor, noise, usual, bend_cost, state, bends, scores):
    """Fill in the strength of the ridge along each of many arcs ahead, as a share of the usual, less its price."""
    u, v, angle, bend = state
    ahead, beside = STEP_PX * math.cos(angle), STEP_PX * math.sin(angle)
    for index in range(len(bends)):
        tried = bends[index]
        # The arc as chords: each is the last one turned by the same angle, the first by half of it.
        x, y = u, v
        half, half_sine = math.cos(0.5 * tried * STEP_PX), math.sin(0.5 * tried * STEP_PX)
        across, down = ahead * half - beside * half_sine, beside * half + ahead * half_sine
        cosine, sine = 1.0 - 2.0 * half_sine * half_sine, 2.0 * half * half_sine
        score, weight = 0.0, 0.0
        for step in range(AHEAD):
            x, y = x + across, y + down
            across, down = across * cosine - down * sine, across * sine + down * cosine
            value = min((sample(ridge, x, y) - noise) / usual, STRONGEST)
            if value < UNKNOWN and is_hidden(hidden, factor, x, y):
                value = UNKNOWN
            share = 1.0 if step < NEAR_POINTS else FAR_WEIGHT
            score += share * value
            weight += share
        scores[index] = score / weight - bend_cost * abs(tried - bend) - 0.15 * abs(tried)


@compiled
def best_arcs(ridge, hidden, factor, noise, faintest, usual, stiffness, state, bends, scores):
    """Return the curvature of the arc ahead that follows the ridge best, and of another, with its score.

    The other's score is -1 if there is none: it must be the best of its neighbours, apart from the first, and
    lie on a ridge by itself.
    """
    bend = state[3]
    bend_cost = stiffness * BEND_COST * (1.0 + NOISE_COST * (faintest / usual) ** 2)
    sharpest = SHARPEST / math.sqrt(stiffness)
    for index in range(BENDS):
        part = 2.0 * index / (BENDS - 1) - 1.0  # closer together near the present one
        bends[index] = min(sharpest, max(-sharpest, bend + 1.6 * sharpest * part * abs(part)))
    arc_scores(ridge, hidden, factor, noise, usual, bend_cost, state, bends, scores)
    first = scores.argmax()
    second, score = first, -1.0
    for index in range(1, BENDS - 1):
        apart = abs(bends[index] - bends[first])
        if apart > APART and scores[index] > scores[index - 1] and scores[index] >= scores[index + 1]:
            plain = scores[index] + bend_cost * abs(bends[index] - bend)
            if plain > (STIFF_FORK if stiffness > 1.0 else FORK) and plain > score:
                second, score = index, plain
    return bends[first], bends[second], score


@compiled
def centred(ridge, noise, u, v, angle, max_shift):
    """Return how far aside the ridge's middle lies, at most `most`, and the strength there."""
    x, y = -math.sin(angle), math.cos(angle)
    peak = 0.0
    for index in range(-(ACROSS // 2), ACROSS // 2 + 1):
        peak = max(peak, sample(ridge, u + index * ASIDE_PX * x, v + index * ASIDE_PX * y))
    total, moment = 0.0, 0.0
    for index in range(-(ACROSS // 2), ACROSS // 2 + 1):
        aside = index * ASIDE_PX
        weight = sample(ridge, u + aside * x, v + aside * y) - noise - 0.3 * (peak - noise)
        if weight > 0.0:
            total += weight
            moment += weight * aside
    shift = 0.0 if total <= 0.0 else min(max_shift, max(-max_shift, moment / total))
    return shift, sample(ridge, u + shift * x, v + shift * y) - noise


@compiled
def walk_on(
    ridge, hidden, factor, noise, faintest, stiffness, dish, max_length, path, strong, count, bend_first, forks
):
    """Walk along the ridge from a path's last vertex to the ridge's end.

    Args:
        ridge: ridge strength in grey levels, uint8.
        hidden: where nothing can be seen, not 0 there, `factor` times smaller.
        factor: see `hidden`.
        noise: the ridge's strength where nothing is.
        faintest: a strength above noise that is no noise.
        stiffness: of the thread; so much higher is the price of a change of curvature.
        dish: centre and the farthest the walk may go from it [px].
        max_length: of the walk [px].
        path: u, v, angle, bend, usual strength and length at each vertex, shape (most, 6); filled in.
        strong: whether the thread is seen at each, shape (most,); filled in.
        count: vertices that there are.
        bend_first: curvature to begin with; beyond 1 the best.
        forks: filled with where there was another way: index, curvature, score; shape (most forks, 3).

    Returns:
        The number of vertices, and of forks.
    """
    u, v, angle, bend, usual, length = path[count - 1]
    bends, scores = np.empty(BENDS), np.empty(BENDS)
    gap, last, fork_count, forced = 0.0, count, 0, 0
    if bend_first < 1.0:
        forced = FORCED
    while length < max_length and gap < GAP_PX and count < len(path):
        if forced > 0:
            bend_ahead, forced = bend_first, forced - 1
        else:
            bend_ahead, other, score = best_arcs(
                ridge, hidden, factor, noise, faintest, usual, stiffness, (u, v, angle, bend), bends, scores
            )
            if score > 0.0 and fork_count < len(forks):
                forks[fork_count, 0], forks[fork_count, 1], forks[fork_count, 2] = count, other, score
                fork_count += 1
        if gap > 0.0:
            bend_ahead = 0.5 * (bend_ahead + bend)
        middle = angle + 0.5 * bend_ahead * STEP_PX
        x, y = u + STEP_PX * math.cos(middle), v + STEP_PX * math.sin(middle)
        turned = angle + bend_ahead * STEP_PX
        shift, strength = centred(ridge, noise, x, y, turned, 0.7)
        seen = strength > max(WEAK * usual, faintest)
        if seen:
            if forced == 0:
                x, y = x - shift * math.sin(turned), y + shift * math.cos(turned)
                turned += 0.25 * shift / STEP_PX
            usual = max(faintest, (1.0 - SMOOTHING) * usual + SMOOTHING * min(strength, STRONGEST * usual))
            gap = 0.0
        else:
            gap += STEP_PX * (HIDDEN_GAP if is_hidden(hidden, factor, x, y) else 1.0)
        away = math.hypot(x - dish[0], y - dish[1])
        if away > dish[2] and away >= math.hypot(u - dish[0], v - dish[1]):  # a tail at the wall is beyond it
            break
        bend += 0.5 * (bend_ahead - bend)
        length += math.hypot(x - u, y - v)
        u, v, angle = x, y, turned
        path[count, 0], path[count, 1], path[count, 2] = u, v, angle
        path[count, 3], path[count, 4], path[count, 5] = bend, usual, length
        strong[count] = seen
        count += 1
        if seen:
            last = count
    return last, fork_count


@compiled
def refine(ridge, noise, points, strong, half):
    """Centre the vertices once more, now that their neighbours on both sides are known, and even them out.

    The ridge across the thread is a mean over `half` vertices to both sides: of a faint thread each alone is noise.
    """
    count = len(points)
    if count < 4:
        return
    normals, profiles = np.zeros((count, 2)), np.zeros((count, ACROSS))
    for index in range(1, count):
        before, after = max(0, index - 2), min(count - 1, index + 2)
        x, y = points[after, 0] - points[before, 0], points[after, 1] - points[before, 1]
        length = max(1e-9, math.hypot(x, y))
        normals[index, 0], normals[index, 1] = -y / length, x / length
        for place in range(ACROSS):
            aside = (place - ACROSS // 2) * ASIDE_PX
            u, v = points[index, 0] + aside * normals[index, 0], points[index, 1] + aside * normals[index, 1]
            profiles[index, place] = sample(ridge, u, v) - noise
    shifts, mean = np.zeros(count), np.zeros(ACROSS)
    for index in range(1, count):
        if not strong[index]:
            continue
        mean[:] = 0.0
        for other in range(max(1, index - half), min(count, index + half + 1)):
            mean += profiles[other] * (half + 1 - abs(other - index))
        bound, total, moment = 0.3 * max(0.0, mean.max()), 0.0, 0.0
        for place in range(ACROSS):
            if mean[place] > bound:
                total += mean[place] - bound
                moment += (mean[place] - bound) * (place - ACROSS // 2) * ASIDE_PX
        if total > 0.0:
            shifts[index] = min(1.0, max(-1.0, moment / total))
    for index in range(1, count):
        before, after = index - 1, min(count - 1, index + 1)
        even = 0.5 * shifts[index] + 0.25 * (shifts[before] + shifts[after])
        points[index, 0] += even * normals[index, 0]
        points[index, 1] += even * normals[index, 1]
