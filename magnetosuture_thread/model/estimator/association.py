"""Association: at which arc length of the thread each measured point lies.

A piece is as long as the stretch of thread that it shows, so that all of its points follow from one number, the arc
length at which it begins: that is given, or searched for along the prior. Each point is then projected onto the
prior next to where its arc length says, in order along the piece.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points

Vector = NDArray[np.float64]

MAX_SKIPPED = 8  # points in a row that may be outliers
PATH_ERROR = 0.005  # of an arc length that is measured along a piece
SEARCH_POINTS = 24  # of a piece, which the search for its beginning compares


@compiled
def path_without_outliers(points: Points, spacing: float, penalty: float, kept: NDArray[np.bool_]) -> None:
    """Mark the points of a piece that lie on its path.

    The path goes through the points in their order. A step costs what it is longer than twice the spacing of the
    points it leads over, a point left out costs `penalty`: a point far aside costs two long ways, one on the path
    nothing.

    Args:
        points: shape (m, 2).
        spacing: of the points, same unit.
        penalty: less than the distance of an outlier.
        kept: written, shape (m,).
    """
    count = len(points)
    cost, before = np.empty(count), np.empty(count, dtype=np.int64)
    best, last = np.inf, 0
    for i in range(count):
        cost[i], before[i] = penalty * i, -1
        for j in range(max(0, i - MAX_SKIPPED), i):
            step = np.hypot(points[i, 0] - points[j, 0], points[i, 1] - points[j, 1])
            value = cost[j] + max(step - 2.0 * spacing * (i - j), 0.0) + penalty * (i - j - 1)
            if value <= cost[i]:
                cost[i], before[i] = value, j
        if cost[i] + penalty * (count - 1 - i) <= best:
            best, last = cost[i] + penalty * (count - 1 - i), i
    kept[:] = False
    while last >= 0:
        kept[last] = True
        last = before[last]


@compiled
def usable_points(
    points: Points, deviation: Vector, largest: float, min_deviation: float, unit: float, max_points: int
) -> tuple[Points, Vector, int]:
    """Return the points of a piece that are finite, at most so many, and how many of all are.

    Args:
        points: shape (m, 2) [m].
        deviation: of each, shape (m,) [m].
        largest: coordinate and deviation [m].
        min_deviation: what is less is taken as this [m].
        unit: D, the unit of what is returned [m].
        max_points: that are returned; of more, so many are taken evenly, with both ends.
    """
    good = np.empty(len(points), dtype=np.int64)
    count = 0
    for p in range(len(points)):
        inside = abs(points[p, 0]) <= largest and abs(points[p, 1]) <= largest
        if inside and 0.0 <= deviation[p] <= largest:
            good[count] = p
            count += 1
    stride = max(1, -(-count // max_points))
    taken = -(-count // stride)
    places, deviations = np.empty((taken, 2)), np.empty(taken)
    for k in range(taken):
        p = good[k * (count - 1) // (taken - 1) if taken > 1 else 0]  # both ends are among them
        places[k, 0], places[k, 1] = points[p, 0] / unit, points[p, 1] / unit
        deviations[k] = max(deviation[p], min_deviation) / unit
    return places, deviations, count


@compiled
def clean_path(
    points: Points, deviation: Vector, detour: float, step: float, correlation: float
) -> tuple[Points, Vector, Vector, Vector]:
    """Return the points of a piece that lie on its path, their deviations, arc lengths and shares of information.

    Args:
        points: shape (m, 2).
        deviation: of each, shape (m,), same unit.
        detour: deviations that noise may lengthen the path by at a point.
        step: deviations, over which the path's length is measured.
        correlation: length over which points err alike; those closer share one point's information.
    """
    count = len(points)
    spacing = np.empty(count - 1)
    for k in range(count - 1):
        spacing[k] = np.hypot(points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1])
    kept = np.ones(count, dtype=np.bool_)
    usual = np.median(spacing)
    if spacing.max() > 2.0 * usual:  # else the path through all points costs nothing
        path_without_outliers(points, usual, detour * np.median(deviation), kept)
    if not kept.all():
        points, deviation = points[kept], deviation[kept]
        count = len(points)
    arcs, share = np.zeros(count), np.ones(count)
    path_lengths(points, step * np.median(deviation), arcs)
    for k in range(count):
        own = 0.5 * (arcs[min(k + 1, count - 1)] - arcs[max(k - 1, 0)])
        own *= 2.0 if k in (0, count - 1) else 1.0
        share[k] = min(1.0, own / correlation)
    return points, deviation, arcs, share


@compiled
def read_piece(
    points: Points,
    deviation: Vector,
    largest: float,
    min_deviation: float,
    unit: float,
    max_points: int,
    detour: float,
    step: float,
    correlation: float,
) -> tuple[Points, Vector, Vector, Vector, float, int]:
    """Return `clean_path` of the `usable_points` of a piece, with variances for deviations.

    Besides the mean of the deviations, and how many points are finite; with fewer than two of them nothing is cleaned.
    The arguments are those of the two functions.
    """
    places, deviations, count = usable_points(points, deviation, largest, min_deviation, unit, max_points)
    arcs, share = np.zeros(len(places)), np.ones(len(places))
    if count >= 2:
        places, deviations, arcs, share = clean_path(places, deviations, detour, step, correlation)
    return places, deviations**2, arcs, share, deviations.mean() if len(deviations) else 0.0, count


@compiled
def mean_square_at(nodes: Points, points: Points, arcs: Vector, start: float, cap: float) -> float:
    """Return the mean squared distance of points from the thread at their arc lengths, each at most `cap`.

    Args:
        nodes: of the thread, shape (n + 1, 2) [D].
        points: shape (m, 2) [D].
        arcs: of the points from the first, shape (m,) [D].
        start: arc length of the first [D].
        cap: [D^2]
    """
    total, last = 0.0, len(nodes) - 1
    for p in range(len(points)):
        at = min(max(start + arcs[p], 0.0), float(last))
        i = min(int(at), last - 1)
        part = at - i
        dx = (1.0 - part) * nodes[i, 0] + part * nodes[i + 1, 0] - points[p, 0]
        dy = (1.0 - part) * nodes[i, 1] + part * nodes[i + 1, 1] - points[p, 1]
        total += min(dx * dx + dy * dy, cap)
    return total / len(points)


@compiled
def search_start(
    nodes: Points, points: Points, arcs: Vector, low: float, high: float, cap: float
) -> tuple[float, float]:
    """Return the arc length at which a piece best begins, between two bounds, and its mean squared distance there.

    Args:
        nodes: see `mean_square_at`, as are the others.
        points: shape (m, 2) [D].
        arcs: shape (m,) [D].
        low: [D]
        high: [D]
        cap: [D^2]
    """
    stride = max(1, len(points) // SEARCH_POINTS)
    some, at = points[::stride].copy(), arcs[::stride].copy()
    steps = max(1, int(np.ceil(2.0 * (high - low))))
    best, found = np.inf, low
    for k in range(steps + 1):
        start = low + (high - low) * k / steps
        value = mean_square_at(nodes, some, at, start, cap)
        if value < best:
            best, found = value, start
    step = (high - low) / steps
    middle = found
    for k in range(-5, 6):
        start = middle + 0.1 * k * step
        if step > 0.0 and low <= start <= high:
            value = mean_square_at(nodes, some, at, start, cap)
            if value < best:
                best, found = value, start
    return found, best


@compiled
def path_lengths(points: Points, spacing: float, arcs: Vector) -> None:
    """Write the arc length of each point of a noisy path.

    It is measured over steps of at least `spacing`, in which noise adds little; between their ends it is shared out.

    Args:
        points: shape (m, 2).
        spacing: same unit.
        arcs: written, shape (m,).
    """
    count, last = len(points), 0
    arcs[0] = 0.0
    for p in range(1, count):
        step = np.hypot(points[p, 0] - points[last, 0], points[p, 1] - points[last, 1])
        if step < spacing and p < count - 1:
            continue
        total = 0.0
        for k in range(last + 1, p + 1):
            arcs[k] = np.hypot(points[k, 0] - points[k - 1, 0], points[k, 1] - points[k - 1, 1])
            total += arcs[k]
        for k in range(last + 1, p + 1):
            arcs[k] = arcs[k - 1] + (step * arcs[k] / total if total > 0.0 else 0.0)
        last = p


@compiled
def project(nodes: Points, points: Points, arcs: Vector, start: float, slack: float) -> tuple[Vector, Vector, int]:
    """Project a piece's points onto the thread, each next to where its arc length says.

        place_p = i + t,    innovation_p = m_i . (y_p - (1 - t) x_i - t x_{i+1} + t (1 - t) (c_i + c_{i+1}) / 4)

    with m_i the normal of segment i and c_i = x_{i+1} - 2 x_i + x_{i-1}: the thread is an arc over its chord.
    Of a bend that lies elsewhere than predicted, the nearest place on the prediction would tell too little.

    Args:
        nodes: of the thread, shape (n + 1, 2) [D].
        points: shape (m, 2) [D].
        arcs: of the points from the first, shape (m,) [D].
        start: arc length of the first [D].
        slack: how far from its arc length the first point may lie; those after by `PATH_ERROR` more [D].

    Returns:
        The arc length of each point, nan of one that lies beyond an end, shape (m,) [D]; its innovation, shape (m,)
        [D]; and how many points lie on the thread.
    """
    segments, count = len(nodes) - 1, 0
    place, innovation = np.empty(len(points)), np.zeros(len(points))
    for p in range(len(points)):
        low, high = start + arcs[p] * (1.0 - PATH_ERROR) - slack, start + arcs[p] * (1.0 + PATH_ERROR) + slack
        place[p] = np.nan
        if high < 0.0 or low > segments:
            continue
        low, high = max(low, 0.0), min(high, float(segments))
        best, found = np.inf, -1
        for i in range(min(int(low), segments - 1), min(int(high), segments - 1) + 1):
            ex, ey = nodes[i + 1, 0] - nodes[i, 0], nodes[i + 1, 1] - nodes[i, 1]
            dx, dy = points[p, 0] - nodes[i, 0], points[p, 1] - nodes[i, 1]
            t = (dx * ex + dy * ey) / max(ex * ex + ey * ey, 1e-12)
            inside = min(max(t, max(low - i, 0.0)), min(high - i, 1.0))
            rx, ry = dx - inside * ex, dy - inside * ey
            square = rx * rx + ry * ry
            if square < best:
                best, found = square, i
                place[p] = i + inside
        t = place[p] - found
        ex, ey = nodes[found + 1, 0] - nodes[found, 0], nodes[found + 1, 1] - nodes[found, 1]
        size = np.hypot(ex, ey)
        mx, my = -ey / size, ex / size
        value = mx * (points[p, 0] - nodes[found, 0]) + my * (points[p, 1] - nodes[found, 1])
        for k in range(found, found + 2):
            if 0 < k < segments:
                cx = nodes[k + 1, 0] - 2.0 * nodes[k, 0] + nodes[k - 1, 0]
                cy = nodes[k + 1, 1] - 2.0 * nodes[k, 1] + nodes[k - 1, 1]
                if cx * cx + cy * cy < 1.0:
                    value += 0.25 * t * (1.0 - t) * (mx * cx + my * cy)
        innovation[p] = value
        count += 1
    return place, innovation, count
