"""Compiled fits of a circle and of a nearly circular rim to points, some of which lie elsewhere."""

from __future__ import annotations

import numpy as np

from magnetosuture_thread.compiled import compiled

MIN_POINTS = 20  # that a circle is fitted to
ROUNDS = 4  # of the fit of a rim
MIN_RESIDUAL_PX = 0.3  # up to which a point always counts


@compiled
def fit_circle(points, agreement, circle):
    """Fit a circle by least squares, leaving out what is far from it.

        minimise  sum (x^2 + y^2 - 2 u x - 2 v y - c)^2,    r^2 = c + u^2 + v^2

    three times, over the points within 8, 3 and 1 times an agreement of the last circle.

    Args:
        points: shape (m, 2) [px].
        agreement: how far a point may be from the circle [px].
        circle: filled with u, v and r, shape (3,) [px].

    Returns:
        How many points agree; 0 if too few do.
    """
    kept = np.ones(len(points), np.bool_)
    system, right = np.empty((3, 3)), np.empty(3)
    count = len(points)
    for tolerance in (8.0 * agreement, 3.0 * agreement, agreement):
        if count < MIN_POINTS:
            return 0
        # Around the mean, where the normal equations are well conditioned.
        mean_u = mean_v = 0.0
        for index in range(len(points)):
            if kept[index]:
                mean_u += points[index, 0] / count
                mean_v += points[index, 1] / count
        system[:], right[:] = 0.0, 0.0
        for index in range(len(points)):
            if not kept[index]:
                continue
            x, y = points[index, 0] - mean_u, points[index, 1] - mean_v
            z = x * x + y * y
            system[0, 0] += 4.0 * x * x
            system[0, 1] += 4.0 * x * y
            system[1, 1] += 4.0 * y * y
            right[0] += 2.0 * x * z
            right[1] += 2.0 * y * z
            right[2] += z
        system[1, 0], system[2, 2] = system[0, 1], count  # the sums of x and y are 0
        u, v, rest = np.linalg.solve(system, right)
        radius = np.sqrt(max(rest + u * u + v * v, 0.0))
        u, v = u + mean_u, v + mean_v
        count = 0
        for index in range(len(points)):
            away = np.hypot(points[index, 0] - u, points[index, 1] - v)
            kept[index] = abs(away - radius) < tolerance
            count += kept[index]
    circle[0], circle[1], circle[2] = u, v, radius
    return count


@compiled
def fit_rim(points, centre, min_points, rim):
    """Fit harmonics to a rim about a centre, leaving out what is far from it.

        r(t) = c_0 + c_1 cos t + c_2 sin t + c_3 cos 2t + c_4 sin 2t

    by least squares, over the points within three standard deviations of the last fit.

    Args:
        points: on the rim, shape (m, 2) [px].
        centre: u and v [px].
        min_points: that have to agree.
        rim: filled with c, shape (5,) [px].

    Returns:
        How many points agree, 0 if too few do, and the root mean square of their residuals [px].
    """
    total = len(points)
    basis, away, residual = np.empty((total, 5)), np.empty(total), np.empty(total)
    for index in range(total):
        x, y = points[index, 0] - centre[0], points[index, 1] - centre[1]
        away[index] = np.hypot(x, y)
        cosine, sine = x / max(away[index], 1e-9), y / max(away[index], 1e-9)
        basis[index, 0], basis[index, 1], basis[index, 2] = 1.0, cosine, sine
        basis[index, 3], basis[index, 4] = cosine * cosine - sine * sine, 2.0 * sine * cosine
    kept, count = np.ones(total, np.bool_), total
    system, right = np.empty((5, 5)), np.empty(5)
    for _ in range(ROUNDS):
        if count < min_points:
            return 0, 0.0
        system[:], right[:] = 0.0, 0.0
        for index in range(total):
            if kept[index]:
                for i in range(5):
                    right[i] += basis[index, i] * away[index]
                    for j in range(5):
                        system[i, j] += basis[index, i] * basis[index, j]
        rim[:] = np.linalg.solve(system, right)
        for index in range(total):
            fitted = 0.0
            for i in range(5):
                fitted += basis[index, i] * rim[i]
            residual[index] = abs(away[index] - fitted)
        bound = max(MIN_RESIDUAL_PX, 3.0 * 1.4826 * np.median(residual))
        square, count = 0.0, 0
        for index in range(total):
            kept[index] = residual[index] < bound
            if kept[index]:
                square += residual[index] ** 2
                count += 1
    return count, np.sqrt(square / max(count, 1))
