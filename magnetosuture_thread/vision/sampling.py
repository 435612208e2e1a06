"""Compiled loops over pixels: medians, a point between pixels, a straightened strip."""

from __future__ import annotations

import math

import numpy as np

from magnetosuture_thread.compiled import compiled

NEXT = np.uint64(1)  # Indices without a sign save compiled code the check for negative ones, which count from the end.


def middle(values: np.ndarray) -> float:
    """Return the median of values of any shape, the upper one of two; numpy's own takes ten times as long."""
    half = values.size // 2
    return float(np.partition(values, half, axis=None)[half])


@compiled
def sample(image, u, v):
    """Return an image at a point, bilinear; 0 outside."""
    column, row = int(np.floor(u)), int(np.floor(v))
    if column < 0 or row < 0 or column >= image.shape[1] - 1 or row >= image.shape[0] - 1:
        return 0.0
    x, y = u - column, v - row
    upper = image[row, column] * (1.0 - x) + image[row, column + 1] * x
    lower = image[row + 1, column] * (1.0 - x) + image[row + 1, column + 1] * x
    return upper * (1.0 - y) + lower * y


@compiled
def within(image, u, v):
    """Return an image at a point, bilinear; outside, at the nearest point of its border."""
    u = min(max(u, 0.0), image.shape[1] - 1.001)
    v = min(max(v, 0.0), image.shape[0] - 1.001)
    return sample(image, u, v)


@compiled
def distances(top, left, centre, result):
    """Fill in how far pixels are from a point; the first one is in the row `top` and the column `left` [px]."""
    for row in range(result.shape[0]):
        v = top + row - centre[1]
        for column in range(result.shape[1]):
            u = left + column - centre[0]
            result[row, column] = math.sqrt(u * u + v * v)


@compiled
def sample_inside(image, factor, top, left, centre, radius, result):
    """Fill in an image that is shrunk by a factor, where pixels beyond a radius take what is on it, towards the centre.

    Args:
        image: shape (rows, columns), uint8.
        factor: how much smaller it is.
        top: row of the first pixel of the result in the image that is not shrunk [px].
        left: column of it [px].
        centre: u and v [px].
        radius: [px]
        result: filled, uint8.
    """
    shift, inverse = 0.5 * (factor - 1), 1.0 / factor
    inside = radius * radius if radius > 0.0 else -1.0
    for row in range(result.shape[0]):
        v = top + row - centre[1]
        for column in range(result.shape[1]):
            u = left + column - centre[0]
            square, share = u * u + v * v, 1.0
            if square > inside:
                share = min(1.0, radius / max(math.sqrt(square), 1.0))
            at_u, at_v = share * u + centre[0] - shift, share * v + centre[1] - shift
            result[row, column] = int(within(image, at_u * inverse, at_v * inverse) + 0.5)


@compiled
def straighten(gray, start, along, aside, strip):
    """Fill a strip with the image along an arc; see `Arc.at`.

    Args:
        gray: shape (rows, columns), uint8.
        start: u, v, angle and curvature of the arc [px, px, rad, 1/px].
        along: lengths along the arc, shape (n,) [px].
        aside: distances aside of it, shape (m,) [px].
        strip: filled, shape (n, m).
    """
    u, v, angle, curvature = start
    for row in range(len(along)):
        s = along[row]
        half = 0.5 * curvature * s
        chord = s if abs(half) < 1e-9 else s * math.sin(half) / half
        x, y = u + chord * math.cos(angle + half), v + chord * math.sin(angle + half)
        across, down = -math.sin(angle + 2.0 * half), math.cos(angle + 2.0 * half)
        for column in range(len(aside)):
            strip[row, column] = within(gray, x + aside[column] * across, y + aside[column] * down)


@compiled
def straighten_both(one, other, start, first, aside, strip, other_strip):
    """Fill two strips with two images along an arc at steps of a pixel, as `straighten` does.

    The arc's direction is turned on from row to row, and both images are sampled at once: half the time.

    Args:
        one: shape (rows, columns).
        other: of the same shape.
        start: u, v, angle and curvature of the arc [px, px, rad, 1/px].
        first: length along the arc of the first row [px].
        aside: distances aside of it, shape (m,) [px].
        strip: filled, shape (n, m).
        other_strip: filled, of the same shape.
    """
    u, v, angle, curvature = start
    rows, columns = one.shape
    last_u, last_v = columns - 1.001, rows - 1.001
    half = 0.5 * curvature * first
    chord = first if abs(half) < 1e-9 else first * math.sin(half) / half
    x, y = u + chord * math.cos(angle + half), v + chord * math.sin(angle + half)
    ahead, down = math.cos(angle + 2.0 * half), math.sin(angle + 2.0 * half)
    half = 0.5 * curvature
    cosine, sine = math.cos(half), math.sin(half)
    chord = 1.0 if abs(half) < 1e-9 else sine / half
    for index in range(len(strip)):
        for place in range(len(aside)):
            at_u = min(max(x - aside[place] * down, 0.0), last_u)
            at_v = min(max(y + aside[place] * ahead, 0.0), last_v)
            column, row = np.uint64(int(at_u)), np.uint64(int(at_v))
            right, below = at_u - column, at_v - row
            left, above = 1.0 - right, 1.0 - below
            upper = left * one[row, column] + right * one[row, column + NEXT]
            lower = left * one[row + NEXT, column] + right * one[row + NEXT, column + NEXT]
            strip[index, place] = above * upper + below * lower
            upper = left * other[row, column] + right * other[row, column + NEXT]
            lower = left * other[row + NEXT, column] + right * other[row + NEXT, column + NEXT]
            other_strip[index, place] = above * upper + below * lower
        # A chord of an arc is turned by half of the arc's turn, what follows it by the other half.
        ahead, down = ahead * cosine - down * sine, down * cosine + ahead * sine
        x, y = x + chord * ahead, y + chord * down
        ahead, down = ahead * cosine - down * sine, down * cosine + ahead * sine
