"""Which way a thread goes on where it crosses itself: the one that shows most of the thread."""

from __future__ import annotations

import math

import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.vision.thread.walk import START_PX, leave, walk_on

MAX_FORKS = 200
ROUNDS = 4
MIN_GAIN_PX = 8.0  # that another way must show more of the thread
SUFFICIENT_SHARE = 0.9  # of the longest walk: so much thread seen needs no other way
TWICE_PX, TWICE_STEPS = 1.6, 6  # a vertex this near to one that lies so many steps back sees the same thread
UNSTEADY = 12.0  # px for each 1 / px of change in curvature


@compiled
def worth(path, strong, count):
    """Return how much thread a path has seen, none of it twice [px], less its unsteadiness."""
    value = 0.0
    for index in range(1, count):
        step = path[index, 5] - path[index - 1, 5]
        fresh = strong[index]
        if fresh:
            for other in range(0, index - TWICE_STEPS):
                u, v = path[index, 0] - path[other, 0], path[index, 1] - path[other, 1]
                if u * u + v * v < TWICE_PX**2:
                    fresh = False
                    break
        if fresh:
            value += step
        value -= UNSTEADY * abs(path[index, 3] - path[index - 1, 3])
    return value


@compiled
def follow(ridge, hidden, factor, noise, faintest, start, dish, max_length, path, strong):
    """Walk along the ridge from the tail to its end; where much less of the thread is seen than there is, try forks.

    Args:
        ridge: ridge strength in grey levels, uint8.
        hidden: where nothing can be seen, not 0 there, `factor` times smaller.
        factor: see `hidden`.
        noise: the ridge's strength where nothing is.
        faintest: a strength above noise that is no noise.
        start: the tail (u, v) and the needle's direction there [px, px, rad].
        dish: centre and the farthest the walk may go from it [px].
        max_length: of the walk, a little longer than the thread [px].
        path: filled; see `walk_on`.
        strong: filled; see `walk_on`.

    Returns:
        The number of vertices.
    """
    path[0, 0], path[0, 1], strong[0] = start[0], start[1], False
    path[0, 2:] = 0.0
    angle, bend, strength = leave(ridge, noise, faintest, start[0], start[1], start[2])
    if strength < 1.2 * faintest:
        return 1
    middle = angle + 0.5 * bend * START_PX
    path[1, 0], path[1, 1] = start[0] + START_PX * math.cos(middle), start[1] + START_PX * math.sin(middle)
    path[1, 2], path[1, 3] = angle + bend * START_PX, bend
    path[1, 4], path[1, 5] = max(strength, faintest), START_PX
    strong[1] = True
    forks = np.empty((MAX_FORKS, 3))
    count, fork_count = walk_on(ridge, hidden, factor, noise, faintest, dish, max_length, path, strong, 2, 9.0, forks)
    value, enough = worth(path, strong, count), SUFFICIENT_SHARE * max_length
    if value > enough or fork_count == 0:
        return count
    other, other_strong, other_forks = np.empty_like(path), np.empty_like(strong), np.empty_like(forks)
    best, best_strong, best_forks = np.empty_like(path), np.empty_like(strong), np.empty_like(forks)
    for _ in range(ROUNDS):
        best_value, best_count, best_fork_count = value + MIN_GAIN_PX, 0, 0
        for index in range(fork_count):
            at = int(forks[index, 0])
            if at >= count or at < 2:
                continue
            # Of forks in a row, towards one and the same other way, the best only.
            poorer = False
            for near in range(max(0, index - 2), min(fork_count, index + 3)):
                if abs(forks[near, 0] - at) < 2.5 and forks[near, 2] > forks[index, 2]:
                    poorer = True
            if poorer:
                continue
            other[:at], other_strong[:at] = path[:at], strong[:at]
            reached, found = walk_on(
                ridge,
                hidden,
                factor,
                noise,
                faintest,
                dish,
                max_length,
                other,
                other_strong,
                at,
                forks[index, 1],
                other_forks,
            )
            tried = worth(other, other_strong, reached)
            if tried > best_value:
                best_value, best_count, best_fork_count = tried, reached, found
                best[:reached], best_strong[:reached] = other[:reached], other_strong[:reached]
                best_forks[:found] = other_forks[:found]
        if best_count == 0:
            break
        value, count, fork_count = best_value, best_count, best_fork_count
        path[:count], strong[:count], forks[:fork_count] = best[:count], best_strong[:count], best_forks[:fork_count]
        if value > enough:
            break
    return count
