"""Which way a thread leaves, and goes on where it crosses itself: the one that shows most of the thread."""

from __future__ import annotations

import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.vision.thread.leave import begin_path, ways_out
from magnetosuture_thread.vision.thread.walk import walk_on

MAX_FORKS = 200
ROUNDS = 4
MAX_WAYS = 5  # out of the needle, that are followed
WAY_GAIN = 1.25  # of what a way with a stronger beginning shows, that another must show
MIN_GAIN_PX = 8.0  # that another way must show more of the thread
SUFFICIENT_SHARE = 0.9  # of the longest walk: so much thread seen needs no other way
TWICE_PX, TWICE_STEPS = 1.6, 6  # a vertex this near to one that lies so many steps back sees the same thread
UNSTEADY = 12.0  # px for each 1 / px of change in curvature
WHOLE_SHARE = 0.975  # of the greatest length, beyond which a walk is longer than the thread


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
def worth_of_whole(path, strong, count, max_length, overrun):
    """Return `worth`, less a price for each pixel that a path is longer than the thread."""
    return worth(path, strong, count) - overrun * max(0.0, path[count - 1, 5] - WHOLE_SHARE * max_length)


@compiled
def follow(
    ridge,
    hidden,
    factor,
    noise,
    faintest,
    single,
    stiffness,
    overrun,
    start,
    dish,
    max_length,
    max_hidden,
    simple,
    path,
    strong,
):
    """Walk along the ridge from the tail to its end, along the way out that shows most of the thread.

    Args:
        ridge: ridge strength in grey levels, uint8.
        hidden: where nothing can be seen, not 0 there, `factor` times smaller.
        factor: see `hidden`.
        noise: the ridge's strength where nothing is.
        faintest: a strength above noise that is no noise.
        single: see `ways_out`.
        stiffness: see `walk_on`.
        overrun: price of a pixel beyond the thread's length; see `worth_of_whole`.
        start: the tail (u, v) and the needle's direction there [px, px, rad].
        dish: centre and the farthest the walk may go from it [px].
        max_length: of the walk, a little longer than the thread [px].
        max_hidden: of the thread below the needle, at most [px].
        simple: see `ways_out`.
        path: filled; see `walk_on`.
        strong: filled; see `walk_on`.

    Returns:
        The number of vertices, and how much thread they show [px]; see `worth`.
    """
    ways = np.empty((MAX_WAYS, 6))
    found = ways_out(ridge, hidden, factor, noise, faintest, start, max_hidden, simple, ways, single)
    path[0, :2], strong[0] = start[:2], False
    best, best_value, enough = 1, 0.0, SUFFICIENT_SHARE * max_length
    other, other_strong = np.empty_like(path), np.empty_like(strong)
    for index in range(found):
        count = begin_path(ridge, noise, start, ways[index], faintest, other, other_strong)
        count, value = _follow(
            ridge,
            hidden,
            factor,
            noise,
            faintest,
            stiffness,
            overrun,
            dish,
            max_length,
            other,
            other_strong,
            count,
            enough,
        )
        if value > WAY_GAIN * best_value + (MIN_GAIN_PX if index > 0 else 0.0):
            best, best_value = count, value
            path[:count], strong[:count] = other[:count], other_strong[:count]
        if best_value > enough:
            break
    return best, best_value


@compiled
def _follow(ridge, hidden, factor, noise, faintest, stiffness, overrun, dish, max_length, path, strong, begun, enough):
    """Walk on from a path's last vertex; where much less of the thread is seen than there is, or more, try forks.

    Returns:
        The number of vertices, and their worth.
    """
    forks = np.empty((MAX_FORKS, 3))
    count, fork_count = walk_on(
        ridge, hidden, factor, noise, faintest, stiffness, dish, max_length, path, strong, begun, 9.0, forks
    )
    value = worth_of_whole(path, strong, count, max_length, overrun)
    if value > enough or fork_count == 0:
        return count, value
    other, other_strong, other_forks = np.empty_like(path), np.empty_like(strong), np.empty_like(forks)
    best, best_strong, best_forks = np.empty_like(path), np.empty_like(strong), np.empty_like(forks)
    for _ in range(ROUNDS):
        best_value, best_count, best_fork_count = value + MIN_GAIN_PX, 0, 0
        for index in range(fork_count):
            at = int(forks[index, 0])
            if at >= count or at < begun:
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
                stiffness,
                dish,
                max_length,
                other,
                other_strong,
                at,
                forks[index, 1],
                other_forks,
            )
            tried = worth_of_whole(other, other_strong, reached, max_length, overrun)
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
    return count, value
