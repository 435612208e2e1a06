"""Compiled loops over the profiles of a thread: its image along lines across it."""

from __future__ import annotations

import math

import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.vision.sampling import within


@compiled
def _normal(points, index):
    """Return the unit normal of a polyline at a vertex, by the two vertices beside it."""
    before, after = max(0, index - 1), min(len(points) - 1, index + 1)
    x, y = points[after, 0] - points[before, 0], points[after, 1] - points[before, 1]
    length = max(math.hypot(x, y), 1e-9)
    return -y / length, x / length


@compiled
def sample_across(image, points, chosen, aside, profiles):
    """Fill in an image at distances aside of some vertices of a polyline, bilinear; see `within`.

    Args:
        image: shape (rows, columns).
        points: of the polyline, shape (m, 2) [px].
        chosen: numbers of the vertices, shape (k,).
        aside: distances, positive to the right of the way along it as v goes down, shape (n,) [px].
        profiles: filled, shape (k, n).
    """
    for row in range(len(chosen)):
        index = chosen[row]
        x, y = _normal(points, index)
        for place in range(len(aside)):
            u, v = points[index, 0] + aside[place] * x, points[index, 1] + aside[place] * y
            profiles[row, place] = within(image, u, v)


@compiled
def usual_profile(profiles, aside, beside, usual):
    """Fill in the median of profiles, each less the median of what lies farther aside than a distance."""
    count = len(profiles)
    off = np.empty_like(profiles)
    far = np.abs(aside) > beside
    for row in range(count):
        off[row] = profiles[row] - np.median(profiles[row][far])
    for place in range(len(aside)):
        usual[place] = np.median(off[:, place])


@compiled
def integrate_across(pixels, points, chosen, half, step, pale, values):
    """Fill in the integral across of the share that a thread takes of the floor's light, or adds to it [px].

    Args:
        pixels: shape (rows, columns), uint8.
        points: of a polyline, shape (m, 2) [px].
        chosen: numbers of vertices, shape (k,).
        half: distance up to which is integrated [px].
        step: between samples [px].
        pale: whether the thread is brighter than the floor.
        values: filled, shape (k,).
    """
    count = int(2.0 * half / step + 1e-9) + 1
    profile = np.empty(count)
    for row in range(len(chosen)):
        index = chosen[row]
        x, y = _normal(points, index)
        total = 0.0
        for place in range(count):
            aside = place * step - half
            profile[place] = within(pixels, points[index, 0] + aside * x, points[index, 1] + aside * y)
            total += profile[place]
        ground = max(0.25 * (profile[0] + profile[1] + profile[count - 2] + profile[count - 1]), 1.0)
        share = count - total / ground
        values[row] = step * (-share if pale else share)


@compiled
def middle_strengths(gray, points, reach, pale, two_sided, values):
    """Fill in how much darker, or brighter, the middle of a line is than what is a distance beside it.

    Args:
        gray: shape (rows, columns), uint8.
        points: of the line, shape (m, 2) [px].
        reach: the distance [px].
        pale: whether brighter counts.
        two_sided: whether the side counts that differs less.
        values: filled, shape (m,) [grey levels].
    """
    sign = -1.0 if pale else 1.0
    for index in range(len(points)):
        x, y = _normal(points, index)
        u, v = points[index, 0], points[index, 1]
        one = sign * within(gray, u - reach * x, v - reach * y)
        other = sign * within(gray, u + reach * x, v + reach * y)
        darkest = np.inf
        for place in range(-2, 3):
            aside = 0.5 * place
            darkest = min(darkest, sign * within(gray, u + aside * x, v + aside * y))
        values[index] = (min(one, other) if two_sided else max(one, other)) - darkest
