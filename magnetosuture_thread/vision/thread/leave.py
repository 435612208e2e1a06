"""Where the thread leaves the tail: arcs that are tried in all directions, below the needle too."""

from __future__ import annotations

import math

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.vision.sampling import sample
from magnetosuture_thread.vision.thread.walk import STEP_PX, is_hidden

WAYS = 90  # directions tried
BENDS = (0.0, 0.04, 0.08, 0.12)  # of them, to both sides [1/px] ...
SHARP_BENDS = (0.17, 0.23, 0.31, 0.42)  # ... and these, after which the thread goes straight on
TURNS = (math.pi, 0.75 * math.pi)  # of a sharp bend
BELOW_WAYS = 181  # directions tried below the needle ...
BELOW = math.radians(75.0)  # ... up to this from its own
BELOW_BENDS = (0.0, 0.005, -0.005)
FORWARD = math.cos(math.radians(28.0))  # ways along the needle are within this angle of it
START_PX = 3.0  # the first sample's distance from the tail
START_STEPS = 8
MIN_ON_RIDGE = START_STEPS - 3  # of these that show the thread
FIRST = 3  # of these, of which one at most may show nothing
STRONGEST = 80.0  # grey levels; more counts no more
HIDDEN_PRICE = 0.01  # of the strength for each hidden pixel on the way
APART_PX = 8.0  # that two ways end from each other


@compiled
def ways_out(ridge, hidden, factor, noise, faintest, tail, max_hidden, simple, ways, single=-1.0):
    """Find the arcs along which a thread may leave the tail.

    Args:
        ridge: ridge strength in grey levels, uint8.
        hidden: where nothing can be seen, not 0 there, `factor` times smaller.
        factor: see `hidden`.
        noise: the ridge's strength where nothing is.
        faintest: a strength above noise that is no noise.
        tail: u, v and the needle's direction there [px, px, rad].
        max_hidden: of a way, at most [px].
        simple: whether sharp bends and ways along the needle are not tried.
        ways: filled with angle, curvature, length up to where it can be seen, strength, score and greatest turn, the
            best first, shape (most, 6).
        single: the strength above noise of a single point on a way that is strong enough in the mean; `faintest` if
            it is below 0.

    Returns:
        How many there are.
    """
    if single < 0.0:
        single = faintest
    count = 0
    ends = [(0.0, 0.0)] * len(ways)
    for index in range(WAYS):
        angle = 2.0 * math.pi * index / WAYS
        if simple and math.cos(angle - tail[2]) > FORWARD:
            continue
        for side in (-1.0, 1.0):
            for bend in BENDS:
                if side * bend == 0.0 and side > 0.0:
                    continue  # tried already
                arc = (angle, side * bend, math.pi)
                count = _try(ridge, hidden, factor, noise, faintest, single, tail, arc, max_hidden, ways, ends, count)
            for bend in SHARP_BENDS:
                for turn in TURNS:
                    if simple:
                        continue
                    arc = (angle, side * bend, turn)
                    count = _try(
                        ridge, hidden, factor, noise, faintest, single, tail, arc, max_hidden, ways, ends, count
                    )
    for index in range(0 if simple else BELOW_WAYS):
        for bend in BELOW_BENDS:
            arc = (tail[2] + BELOW * (2.0 * index / (BELOW_WAYS - 1) - 1.0), bend, math.pi)
            count = _try(ridge, hidden, factor, noise, faintest, single, tail, arc, max_hidden, ways, ends, count)
    return count


@compiled
def _try(ridge, hidden, factor, noise, faintest, single, tail, arc, max_hidden, ways, ends, count):
    """Enter an arc among the best, in their order, unless a better one ends nearby; return how many there are."""
    angle, bend, most = arc
    u, v, s, visible, seen, total, below = tail[0], tail[1], 0.0, 0, 0, 0.0, 0.0
    step, turned, first = START_PX, 0.0, 0.0
    x, y, half, cosine, sine = math.cos(angle), math.sin(angle), 0.0, 1.0, 0.0
    while visible < START_STEPS:
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
        if is_hidden(hidden, factor, u, v):
            below += STEP_PX
            if below > max_hidden:
                return count
            continue
        if visible == 0:
            first = s
        value = sample(ridge, u, v) - noise
        total += min(value, STRONGEST)
        visible += 1
        if value > single:
            seen += 1
        elif visible - seen > (START_STEPS - MIN_ON_RIDGE if visible > FIRST else 1):
            return count  # At once if it does not begin at the tail, or where it comes out: that is another thread.
    strength = total / START_STEPS
    score = strength * (1.0 - HIDDEN_PRICE * below) * seen / START_STEPS  # a gap is no way out if there is another
    if strength < faintest or score <= 0.0:
        return count
    place = 0
    while place < count and ways[place, 4] >= score:
        if math.hypot(ends[place][0] - u, ends[place][1] - v) < APART_PX:
            return count
        place += 1
    # A worse one that ends nearby makes room, else the last.
    last = place
    while last < count and math.hypot(ends[last][0] - u, ends[last][1] - v) >= APART_PX:
        last += 1
    if last == count:
        if count < len(ways):
            count += 1
        elif place == count:
            return count
        last = count - 1
    for index in range(last, place, -1):
        ways[index], ends[index] = ways[index - 1], ends[index - 1]
    ways[place, 0], ways[place, 1], ways[place, 2] = angle, bend, first
    ways[place, 3], ways[place, 4], ways[place, 5] = strength, score, most
    ends[place] = (u, v)
    return count


@compiled
def begin_path(ridge, noise, tail, way, faintest, path, strong):
    """Begin a path along a way out, up to where the thread can be seen; see `walk_on`.

    Returns:
        The number of vertices.
    """
    path[0, :] = 0.0
    path[0, 0], path[0, 1], strong[0] = tail[0], tail[1], False
    u, v, s, turned, step, count = tail[0], tail[1], 0.0, 0.0, START_PX, 1
    until = max(way[2], START_PX)
    if abs(way[1]) > 0.1:  # A small bend is laid as a whole: the walk does not turn as sharply.
        until = max(until, way[5] / abs(way[1]))
    while s < until - 1e-9 and count < len(path):
        turn = way[1] * step
        if abs(turned + turn) > way[5]:
            turn = 0.0
        middle = way[0] + turned + 0.5 * turn
        u, v = u + step * math.cos(middle), v + step * math.sin(middle)
        turned += turn
        s += step
        path[count, 0], path[count, 1], path[count, 2], path[count, 3] = u, v, way[0] + turned, turn / step
        path[count, 4], path[count, 5] = max(way[3], faintest), s
        strong[count] = s >= way[2] and sample(ridge, u, v) - noise > faintest
        count += 1
        step = STEP_PX
    return count
