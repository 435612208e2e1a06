"""Fits a needle's axis half-way between the two edges of its body, of which a thread may hide one."""

from __future__ import annotations

import numpy as np

from magnetosuture_thread.compiled import compiled

EDGE_PX = 0.25  # that an edge may lie off its fit
REACH_PX = 2.0  # beyond half the width, that belongs to an edge
HALF_WEIGHT = 4.0  # of the width known before, in edges
MIN_EDGES = 6
ROUNDS = 6


@compiled
def fit_edges(along, aside, steel, width, span, scale, half, values, inverse):
    """Fit a parabola half-way between a strip's two edges, robustly: one tells of it where the other is hidden.

        left(t) = d(t) - h,    right(t) = d(t) + h,    d(t) = c_0 + c_1 t + c_2 t^2,    t = (s - at) / scale

    A thread beside the body hides one edge only. Three fits begin, from the rows of one width, from all left edges
    and from all right ones; each then takes whichever edges are near it. The one with the least sum of squared
    residuals, none counted beyond `EDGE_PX`, is kept.

    Args:
        along: lengths of the rows, shape (n,) [px].
        aside: distances of the columns, shape (m,), equally spaced; that of 0 lies within the body [px].
        steel: share of steel, shape (n, m).
        width: sum of it over each row, shape (n,) [px].
        span: first and last length to take, least and greatest width of a row of one width, and `at`; a wider row
            still has two edges, of which one may count.
        scale: of t [px].
        half: half of the body's width, about [px].
        values: filled with c and h, shape (4,).
        inverse: filled with the inverse of the normal matrix, shape (4, 4).

    Returns:
        Rows of one width, edges taken, edges kept, mean square of the kept edges' residuals [px^2].
    """
    edge, basis = np.empty(2 * len(along)), np.empty((2 * len(along), 4))
    even = np.zeros(2 * len(along), np.bool_)
    rows, count = _take_edges(along, aside, steel, width, span, scale, half, edge, basis, even)
    edge, basis = edge[:count], basis[:count]
    best, kept_edges, mean_square = np.inf, 0, 0.0
    guess, own, residual = np.empty(4), np.empty((4, 4)), np.empty(count)
    for start in range(3):
        kept = np.zeros(count, np.bool_)
        for index in range(count):
            kept[index] = even[index] if start == 0 else index % 2 == start - 1
        good = _fit_from(edge, basis, half, kept, guess, own, residual)
        if good < MIN_EDGES:
            continue
        missed, total = 0.0, 0.0
        for index in range(count):
            square = residual[index] * residual[index]
            missed += min(square, EDGE_PX * EDGE_PX)
            total += square if kept[index] else 0.0
        if missed < best:
            best, kept_edges, mean_square = missed, good, total / good
            values[:] = guess
            inverse[:] = own
    return rows, count, kept_edges, mean_square


@compiled
def _take_edges(along, aside, steel, width, span, scale, half, edge, basis, even):
    """Fill in each row's left and right edge, their rows of the system, and whether the row is of one width.

    Returns:
        Rows of one width, and edges.
    """
    low, high, minimum, max_shift, at = span
    step = aside[1] - aside[0]
    rows, count = 0, 0
    for row in range(len(along)):
        if not (low < along[row] < high and width[row] > minimum):
            continue
        left, right = 0.0, 0.0
        for column in range(len(aside)):
            if abs(aside[column]) < half + REACH_PX:
                part = min(max(0.5 + aside[column] / step, 0.0), 1.0)  # of a column that is right of the middle
                left += (1.0 - part) * step * steel[row, column]
                right += part * step * steel[row, column]
        t = (along[row] - at) / scale
        rows += width[row] < max_shift
        for side in range(2):
            edge[count], even[count] = right if side else -left, width[row] < max_shift
            basis[count, 0], basis[count, 1], basis[count, 2], basis[count, 3] = 1.0, t, t * t, 2.0 * side - 1.0
            count += 1
    return rows, count


@compiled
def _fit_from(edge, basis, half, kept, guess, own, residual):
    """Fit to the kept edges, keep those near the fit instead, and so on; return how many are kept."""
    good = int(kept.sum())
    for _ in range(ROUNDS):
        if good < MIN_EDGES:
            break
        normal, right = np.zeros((4, 4)), np.zeros(4)
        normal[3, 3], right[3] = HALF_WEIGHT, HALF_WEIGHT * half
        for index in range(len(edge)):
            if kept[index]:
                for i in range(4):
                    right[i] += basis[index, i] * edge[index]
                    for j in range(4):
                        normal[i, j] += basis[index, i] * basis[index, j]
        own[:] = np.linalg.inv(normal)
        guess[:] = own @ right
        residual[:] = edge - basis @ guess
        spread = 1.4826 * np.median(np.abs(residual)[kept])
        bound = min(max(EDGE_PX, 3.0 * spread), 3.0 * EDGE_PX)
        good = 0
        for index in range(len(edge)):
            kept[index] = abs(residual[index]) < bound
            good += kept[index]
    return good
