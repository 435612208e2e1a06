"""The walk along a dark ridge, in compiled code.

A walk leaves the needle's tail along the best of many arcs, and goes on by steps, each along the best of many arcs that
look some steps ahead. Of the ways out that look like a thread the one is taken along which the walk shows most of it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from magnetosuture_thread.geometry.compiled import compiled, compiled_inline, compiled_inner, compiled_uncounted
from magnetosuture_thread.vision.images import middle, sample

STEP_PX = 2.0  # of the walk
AHEAD, SHARES = 9, 5.0 + 4.0 * 0.6  # steps looked ahead, of which five count in full, and what all count
BENDS, SHARPEST = 31, 0.21  # curvatures tried at each step, up to this [1/px]
STRONGEST = 1.25  # of the usual strength; above, it counts no more
ACROSS, ASIDE_PX = 9, 0.5  # samples across a ridge, and the distance between them
WAYS_AHEAD = 8  # steps of an arc out of the tail, of which at least five must show the thread


Circle = tuple[float, float, float]  # u, v and radius [px]


class Ridge(NamedTuple):
    """How much darker each pixel is than what is near it.

    Attributes:
        strength: shape (rows, columns), uint8 [grey levels].
        hidden: where nothing can be seen, not 0 there, of the same shape, uint8.
        noise: strength where nothing is.
        faintest: a strength above noise that is no noise.
        dish: centre and the farthest that a walk may go from it [px].
    """

    strength: np.ndarray
    hidden: np.ndarray
    noise: float
    faintest: float
    dish: Circle


def black_hat(gray: np.ndarray, hidden: np.ndarray, inside: np.ndarray, dish: Circle, *, wide: bool) -> Ridge:
    """Return how much darker an image is than the brightest background within a few pixels.

    An edge has no black-hat, so that shadows, covers and the rim are no thread.

    Args:
        gray: shape (rows, columns), uint8.
        hidden: where nothing can be seen, not 0 there, of the same shape, uint8.
        inside: the dish, whose noise is measured, not 0 there, of the same shape, uint8.
        dish: see `Ridge`.
        wide: whether to look at half the size, for what is wider than a few pixels.
    """
    size = gray.shape[1::-1]
    if wide:
        gray = cv2.resize(gray, (size[0] // 2, size[1] // 2), interpolation=cv2.INTER_AREA)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    strength = cv2.morphologyEx(smoothed(gray), cv2.MORPH_BLACKHAT, kernel)
    if wide:  # A plateau has no middle: smoothed, it has.
        strength = cv2.resize(cv2.GaussianBlur(strength, (0, 0), 1.5), size, interpolation=cv2.INTER_LINEAR)
    some = strength[::5, ::5][inside[::5, ::5] > 0]
    noise = middle(some) if some.size else 0.0
    return Ridge(strength, hidden, noise, max(3.0, 3.0 * noise), dish)


def path_buffer(max_length: float) -> np.ndarray:
    """Return room for a path of a length [px]; see `walk_on`. Steps are longer than a pixel."""
    return np.zeros((int(max_length) + 16, 7))


def smoothed(gray: np.ndarray) -> np.ndarray:
    """Return an image smoothed as wide as the thinnest thread looks."""
    return np.asarray(cv2.GaussianBlur(gray, (5, 5), 0.7))


@compiled_inline
def is_hidden(ridge, u, v):
    """Say whether a point of a ridge is hidden."""
    c, r = int(u + 0.5), int(v + 0.5)
    if c < 0 or r < 0 or c >= ridge.hidden.shape[1] or r >= ridge.hidden.shape[0]:
        return False
    return ridge.hidden[r, c] != 0


@compiled_inner
def best_arc(ridge, usual, state):
    """Return the curvature of the arc ahead that follows the ridge best.

    An arc's score is the strength of the ridge along it, as a share of the usual, less the price of its bend.
    """
    strength, noise = ridge.strength, ridge.noise
    u, v, angle, bend = state
    ahead, beside = STEP_PX * math.cos(angle), STEP_PX * math.sin(angle)
    bend_cost = 1.1 * (1.0 + 2.0 * (ridge.faintest / usual) ** 2)  # for 1 / px; higher where the thread is faint
    best, best_score = bend, -np.inf
    for index in range(BENDS):
        # From the present one on to both sides in turn, closer together near it.
        part = ((index + 1) // 2) * (2 * (index % 2) - 1) * 2.0 / (BENDS - 1)
        tried = min(SHARPEST, max(-SHARPEST, bend + 1.6 * SHARPEST * part * abs(part)))
        price = bend_cost * abs(tried - bend) + 0.15 * abs(tried)
        if STRONGEST - price < best_score:
            continue
        # The arc as chords: each is the last one turned by the same angle, the first by half of it.
        x, y = u, v
        half_sine = math.sin(0.5 * tried * STEP_PX)
        half = math.sqrt(1.0 - half_sine * half_sine)  # in half of the time of a cosine
        across, down = ahead * half - beside * half_sine, beside * half + ahead * half_sine
        cosine, sine = 1.0 - 2.0 * half_sine * half_sine, 2.0 * half * half_sine
        score, left = 0.0, SHARES
        for step in range(AHEAD):
            if (score + STRONGEST * left) / SHARES - price < best_score:
                break  # Whatever is ahead, it is not the best.
            x, y = x + across, y + down
            across, down = across * cosine - down * sine, across * sine + down * cosine
            value = min((sample(strength, x, y) - noise) / usual, STRONGEST)
            if value < 0.45 and is_hidden(ridge, x, y):
                value = 0.45  # as a hidden pixel counts
            share = 1.0 if step < 5 else 0.6
            score += share * value
            left -= share
        score = score / SHARES - price
        if score > best_score:
            best, best_score = tried, score
    return best


@compiled_inner
def centred(ridge, u, v, angle, max_shift):
    """Return how far aside the ridge's middle lies, at most `max_shift`, and the strength there."""
    strength, noise = ridge.strength, ridge.noise
    x, y = -math.sin(angle), math.cos(angle)
    peak = 0.0
    for index in range(-(ACROSS // 2), ACROSS // 2 + 1):
        peak = max(peak, sample(strength, u + index * ASIDE_PX * x, v + index * ASIDE_PX * y))
    total, moment = 0.0, 0.0
    for index in range(-(ACROSS // 2), ACROSS // 2 + 1):
        aside = index * ASIDE_PX
        weight = sample(strength, u + aside * x, v + aside * y) - noise - 0.3 * (peak - noise)
        if weight > 0.0:
            total += weight
            moment += weight * aside
    shift = 0.0 if total <= 0.0 else min(max_shift, max(-max_shift, moment / total))
    return shift, sample(strength, u + shift * x, v + shift * y) - noise


@compiled_uncounted
def walk_on(ridge, max_length, path, count):
    """Walk along a ridge from a path's last vertex to the ridge's end.

    Args:
        ridge: see `Ridge`.
        max_length: of the walk [px].
        path: u, v, angle, bend, usual strength, length, and 1 where the thread is visible, at each vertex, shape
            (most, 7); filled in.
        count: vertices that there are.

    Returns:
        The number of vertices.
    """
    dish, faintest = ridge.dish, ridge.faintest
    u, v, angle = path[count - 1, 0], path[count - 1, 1], path[count - 1, 2]
    bend, usual, length = path[count - 1, 3], path[count - 1, 4], path[count - 1, 5]
    gap, last = 0.0, count
    while length < max_length and gap < 13.0 and count < len(path):  # px; a gap is crossed
        bend_ahead = best_arc(ridge, usual, (u, v, angle, bend))
        if gap > 0.0:
            bend_ahead = 0.5 * (bend_ahead + bend)
        halfway = angle + 0.5 * bend_ahead * STEP_PX
        x, y = u + STEP_PX * math.cos(halfway), v + STEP_PX * math.sin(halfway)
        turned = angle + bend_ahead * STEP_PX
        shift, strength = centred(ridge, x, y, turned, 0.7)
        seen = strength > max(0.3 * usual, faintest)  # of the usual strength
        if seen:
            x, y = x - shift * math.sin(turned), y + shift * math.cos(turned)
            turned += 0.25 * shift / STEP_PX
            usual = max(faintest, 0.95 * usual + 0.05 * min(strength, STRONGEST * usual))
            gap = 0.0
        else:
            gap += STEP_PX * (0.25 if is_hidden(ridge, x, y) else 1.0)
        away = math.hypot(x - dish[0], y - dish[1])
        if away > dish[2] and away >= math.hypot(u - dish[0], v - dish[1]):  # a tail at the wall is beyond it
            break
        bend += 0.5 * (bend_ahead - bend)
        length += math.hypot(x - u, y - v)
        u, v, angle = x, y, turned
        path[count, 0], path[count, 1], path[count, 2] = u, v, angle
        path[count, 3], path[count, 4], path[count, 5] = bend, usual, length
        path[count, 6] = 1.0 if seen else 0.0
        count += 1
        if seen:
            last = count
    return last


@compiled
def refine(ridge, points, strong):
    """Centre the vertices once more, now that their neighbours on both sides are known, and even them out."""
    count = len(points)
    if count < 4:
        return
    angles, shifts = np.zeros(count), np.zeros(count)
    for index in range(1, count):
        before, after = max(0, index - 2), min(count - 1, index + 2)
        angles[index] = math.atan2(points[after, 1] - points[before, 1], points[after, 0] - points[before, 0])
        if strong[index]:
            shifts[index], _ = centred(ridge, points[index, 0], points[index, 1], angles[index], 1.0)
    for index in range(1, count):
        even = 0.5 * shifts[index] + 0.25 * (shifts[index - 1] + shifts[min(count - 1, index + 1)])
        points[index, 0] -= even * math.sin(angles[index])
        points[index, 1] += even * math.cos(angles[index])


@compiled_inner
def ways_out(ridge, tail, max_hidden, ways):
    """Find the arcs along which a thread may leave the tail.

    Args:
        ridge: see `Ridge`.
        tail: u, v and the needle's direction there [px, px, rad].
        max_hidden: of a way, at most [px].
        ways: filled with angle, curvature, length up to where it can be seen, strength, score, greatest turn, and the
            place where it ends, u and v, the best first, shape (most, 8).

    Returns:
        How many there are.
    """
    count = 0
    for index in range(90):
        angle = 2.0 * math.pi * index / 90
        for side in (-1.0, 1.0):
            for bend in (0.0, 0.04, 0.08, 0.12):
                if side * bend == 0.0 and side > 0.0:
                    continue  # tried already
                count = _try(ridge, tail, (angle, side * bend, math.pi), max_hidden, ways, count)
            for bend in (0.17, 0.23, 0.31, 0.42):  # after a sharp bend the thread goes straight on
                for turn in (math.pi, 0.75 * math.pi):
                    count = _try(ridge, tail, (angle, side * bend, turn), max_hidden, ways, count)
    for index in range(181):  # below the needle
        for bend in (0.0, 0.005, -0.005):
            arc = (tail[2] + math.radians(75.0) * (2.0 * index / 180 - 1.0), bend, math.pi)
            count = _try(ridge, tail, arc, max_hidden, ways, count)
    return count


@compiled_inner
def _try(ridge, tail, arc, max_hidden, ways, count):
    """Enter an arc among the best, in their order, unless a better one ends nearby; return how many there are."""
    angle, bend, most = arc
    faintest = ridge.faintest
    u, v, s, visible, seen, total, below = tail[0], tail[1], 0.0, 0, 0, 0.0, 0.0
    step, turned, first = 3.0, 0.0, 0.0
    x, y, half, cosine, sine = math.cos(angle), math.sin(angle), 0.0, 1.0, 0.0
    while visible < WAYS_AHEAD:
        turn = bend * step
        if abs(turned + turn) > most:
            turn = 0.0
        if half != 0.5 * turn:
            half = 0.5 * turn
            cosine, sine = math.cos(half), math.sin(half)
        # The chord is turned by half of the step's turn, what follows it by the other half.
        x, y = x * cosine - y * sine, x * sine + y * cosine
        u, v = u + step * x, v + step * y
        x, y = x * cosine - y * sine, x * sine + y * cosine
        turned += turn
        s += step
        step = STEP_PX
        if is_hidden(ridge, u, v):
            below += STEP_PX
            if below > max_hidden:
                return count
            continue
        if visible == 0:
            first = s
        value = sample(ridge.strength, u, v) - ridge.noise
        total += min(value, 80.0)
        visible += 1
        if value > faintest:
            seen += 1
        elif visible - seen > (3 if visible > 3 else 1):
            return count  # At once if it does not begin at the tail, or where it comes out: that is another thread.
    strength = total / WAYS_AHEAD
    score = strength * (1.0 - 0.01 * below) * seen / WAYS_AHEAD  # a gap is no way out if there is another
    if strength < faintest or score <= 0.0:
        return count
    place = 0
    while place < count and ways[place, 4] >= score:
        if math.hypot(ways[place, 6] - u, ways[place, 7] - v) < 8.0:
            return count
        place += 1
    # A worse one that ends nearby makes room, else the last.
    last = place
    while last < count and math.hypot(ways[last, 6] - u, ways[last, 7] - v) >= 8.0:
        last += 1
    if last == count:
        if count < len(ways):
            count += 1
        elif place == count:
            return count
        last = count - 1
    for index in range(last, place, -1):
        for column in range(ways.shape[1]):
            ways[index, column] = ways[index - 1, column]
    ways[place, 0], ways[place, 1], ways[place, 2] = angle, bend, first
    ways[place, 3], ways[place, 4], ways[place, 5] = strength, score, most
    ways[place, 6], ways[place, 7] = u, v
    return count


@compiled_inner
def begin_path(ridge, tail, way, path):
    """Begin a path along a way out, up to where the thread can be seen; see `walk_on`.

    Returns:
        The number of vertices.
    """
    path[0, 0], path[0, 1], path[0, 2] = tail[0], tail[1], 0.0
    path[0, 3], path[0, 4], path[0, 5], path[0, 6] = 0.0, 0.0, 0.0, 0.0
    u, v, s, turned, step, count = tail[0], tail[1], 0.0, 0.0, 3.0, 1
    until = max(way[2], 3.0)
    if abs(way[1]) > 0.1:  # A small bend is laid as a whole: the walk does not turn as sharply.
        until = max(until, way[5] / abs(way[1]))
    while s < until - 1e-9 and count < len(path):
        turn = way[1] * step
        if abs(turned + turn) > way[5]:
            turn = 0.0
        halfway = way[0] + turned + 0.5 * turn
        u, v = u + step * math.cos(halfway), v + step * math.sin(halfway)
        turned += turn
        s += step
        path[count, 0], path[count, 1], path[count, 2], path[count, 3] = u, v, way[0] + turned, turn / step
        path[count, 4], path[count, 5] = max(way[3], ridge.faintest), s
        visible = s >= way[2] and sample(ridge.strength, u, v) - ridge.noise > ridge.faintest
        path[count, 6] = 1.0 if visible else 0.0
        count += 1
        step = STEP_PX
    return count


@compiled_uncounted
def worth(path, count):
    """Return how much thread a path shows, none of it twice [px], less its unsteadiness."""
    value = 0.0
    for index in range(1, count):
        step = path[index, 5] - path[index - 1, 5]
        fresh = path[index, 6] > 0.0
        if fresh:
            for other in range(0, index - 6):
                u, v = path[index, 0] - path[other, 0], path[index, 1] - path[other, 1]
                if u * u + v * v < 1.6**2:
                    fresh = False
                    break
        if fresh:
            value += step
        value -= 12.0 * abs(path[index, 3] - path[index - 1, 3])
    return value


@compiled
def follow(ridge, start, max_length, max_hidden, path):
    """Walk along the ridge from the tail to its end, along the way out that shows most of the thread.

    Args:
        ridge: see `Ridge`.
        start: the tail (u, v) and the needle's direction there [px, px, rad].
        max_length: of the walk, a little longer than the thread [px].
        max_hidden: of the thread below the needle, at most [px].
        path: filled; see `walk_on`.

    Returns:
        The number of vertices.
    """
    ways = np.empty((5, 8))
    found = ways_out(ridge, start, max_hidden, ways)
    path[0, 0], path[0, 1], path[0, 2] = start[0], start[1], 0.0
    path[0, 3], path[0, 4], path[0, 5], path[0, 6] = 0.0, 0.0, 0.0, 0.0
    best, best_value, enough = 1, 0.0, 0.9 * max_length  # so much thread needs no other way
    other = np.empty_like(path)
    for index in range(found):
        count = walk_on(ridge, max_length, other, begin_path(ridge, start, ways[index], other))
        value = worth(other, count)
        if value > 1.25 * best_value + (8.0 if index > 0 else 0.0):  # px; the first begins strongest
            best, best_value = count, value
            for vertex in range(count):
                for column in range(path.shape[1]):
                    path[vertex, column] = other[vertex, column]
        if best_value > enough:
            break
    return best
