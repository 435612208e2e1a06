"""Compiled loops over pixels: a point between pixels, a straightened strip, the rim along rays."""

from __future__ import annotations

import math

import numpy as np

from magnetosuture_thread.compiled import compiled


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
def ground_beside(strip, outer, window, ground):
    """Fill in the ground on either side of a strip: medians of its outer columns, a running median along them.

    Args:
        strip: shape (n, m).
        outer: columns on each side.
        window: odd number of rows of the running median.
        ground: filled, shape (n, 2).
    """
    rows, columns = strip.shape
    rough = np.empty((rows, 2))
    for row in range(rows):
        rough[row, 0] = np.median(strip[row, :outer])
        rough[row, 1] = np.median(strip[row, columns - outer :])
    for row in range(rows):
        first, last = max(0, row - window // 2), min(rows, row + window // 2 + 1)
        for side in range(2):
            ground[row, side] = np.median(rough[first:last, side])


@compiled
def fit_middles(along, aside, steel, width, span, scale, values, inverse):
    """Fit a parabola through the middles of a strip's steel, robustly.

        d(t) = c_0 + c_1 t + c_2 t^2,    t = (s - at) / scale

    Args:
        along: lengths of the rows, shape (n,) [px].
        aside: distances of the columns, shape (m,) [px].
        steel: share of steel, shape (n, m).
        width: sum of it over each row, shape (n,) [px].
        span: first and last length to take, least and greatest width, and `at`.
        scale: of t [px].
        values: filled with c, shape (3,).
        inverse: filled with the inverse of the normal matrix, shape (3, 3).

    Returns:
        Rows taken, rows kept, mean square of the kept rows' residuals [px^2].
    """
    low, high, minimum, max_shift, at = span
    middles, t = np.empty(len(along)), np.empty(len(along))
    count = 0
    for row in range(len(along)):
        if low < along[row] < high and minimum < width[row] < max_shift:
            total, moment = 0.0, 0.0
            for column in range(len(aside)):
                total += steel[row, column]
                moment += steel[row, column] * aside[column]
            middles[count], t[count] = moment / max(total, 1e-9), (along[row] - at) / scale
            count += 1
    kept, good = np.ones(count, np.bool_), count
    residual = np.empty(count)
    for _ in range(3):
        if good < 6:
            return count, 0, 0.0
        normal, right = np.zeros((3, 3)), np.zeros(3)
        for row in range(count):
            if kept[row]:
                basis = (1.0, t[row], t[row] * t[row])
                for i in range(3):
                    right[i] += basis[i] * middles[row]
                    for j in range(3):
                        normal[i, j] += basis[i] * basis[j]
        inverse[:] = np.linalg.inv(normal)
        values[:] = inverse @ right
        for row in range(count):
            residual[row] = middles[row] - values[0] - t[row] * (values[1] + t[row] * values[2])
        spread = 1.4826 * np.median(np.abs(residual)[kept])
        good = 0
        for row in range(count):
            kept[row] = abs(residual[row]) < max(0.25, 3.0 * spread)
            good += kept[row]
    total = 0.0
    for row in range(count):
        if kept[row]:
            total += residual[row] * residual[row]
    return count, good, total / max(good, 1)


@compiled
def rim_along_rays(gray, circle, reach, step, band, minimum, contrast, edges, darkest):
    """Find a dish's rim along rays from its centre.

    Args:
        gray: shape (rows, columns), uint8.
        circle: u, v and radius, about [px].
        reach: how far inside and outside of the radius to look [px].
        step: between samples [px].
        band: how far beyond its inner edge the rim is darkest [px].
        minimum: and `contrast`: the rim is darker than the floor by this in grey levels, and by that share.
        contrast: see `least`.
        edges: filled with where the light falls half-way to the rim's dark, shape (rays, 2).
        darkest: filled with the rim's darkest points, shape (rays, 2).

    Returns:
        How many edges were found, and how many darkest points.
    """
    u, v, radius = circle
    rays, count = len(edges), int(2.0 * reach / step)
    profile = np.empty(count)
    ahead = int(band / step) + 1
    edge_count, dark_count = 0, 0
    inner = max(3, count // 8)
    for ray in range(rays):
        angle = 2.0 * math.pi * ray / rays
        x, y = math.cos(angle), math.sin(angle)
        for index in range(count):
            r = radius - reach + index * step
            profile[index] = within(gray, u + r * x, v + r * y)
        inside = np.median(profile[:inner])
        dark = profile.min()
        if inside - dark < max(minimum, contrast * inside):
            continue
        half, index = 0.5 * (inside + dark), 0
        while profile[index] >= half:
            index += 1
        if index == 0:
            continue
        part = (profile[index - 1] - half) / (profile[index - 1] - profile[index])
        r = radius - reach + (index - 1 + part) * step
        edges[edge_count, 0], edges[edge_count, 1] = u + r * x, v + r * y
        edge_count += 1
        end = min(index + ahead, count - 1)
        lowest = index
        for other in range(index, end + 1):
            if profile[other] < profile[lowest]:
                lowest = other
        if 0 < lowest < end:
            left, low, right = profile[lowest - 1], profile[lowest], profile[lowest + 1]
            bend = left - 2.0 * low + right
            # Beyond its darkest ring a rim is brighter again; a plain edge has no such ring.
            if bend > 0.0 and profile[lowest : end + 1].max() > low + 0.5 * minimum:
                r = radius - reach + (lowest + 0.5 * (left - right) / bend) * step
                darkest[dark_count, 0], darkest[dark_count, 1] = u + r * x, v + r * y
                dark_count += 1
    return edge_count, dark_count
