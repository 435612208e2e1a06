"""Association: at which arc length of the thread each measured point lies, or why a piece is refused.

A piece is as long as the stretch of thread that it shows, so that all of its points follow from one number, the arc
length at which it begins: that is given, or searched for along the prior. Each point is then projected onto the
prior next to where its arc length says, in order along the piece. Lengths are in units of the segment length D.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from magnetosuture_thread.geometry.compiled import compiled
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import Mask, Points, Vector
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece

Obstacles = tuple[Workspace, float]

MAX_PIECES = 64  # of an observation
MIN_POINTS = 2  # of a piece
MAX_COORDINATE = 10.0  # m; also the largest deviation
MIN_DEVIATION = 5e-6  # m; standard deviation of a measured point, however good the camera says it is
POINT_CORRELATION = 2.5e-4  # m along a piece; points closer than this err alike and share one point's information
PATH_ERROR = 0.005  # of an arc length that is measured along a piece
LENGTH_ERROR = 0.005  # of the length, by which a thread is known to be longer or shorter than told
WHOLE = 0.05  # of the length, by which a piece from the tail to the free end may differ and still be the thread
GATE = 4.0  # standard deviations; a piece of unknown arc length that is farther from the prior is another thread's


@compiled
def path_without_outliers(points: Points, spacing: float, penalty: float) -> Mask:
    """Return which points of a piece lie on its path, shape (m,).

    The path goes through the points in their order. A step costs what it is longer than twice the spacing of the
    points it leads over, a point left out costs `penalty`: a point far aside costs two long ways, one on the path
    nothing.

    Args:
        points: shape (m, 2).
        spacing: of the points, same unit.
        penalty: less than the distance of an outlier.
    """
    count = len(points)
    cost, before = np.empty(count), np.empty(count, dtype=np.int64)
    best, last = np.inf, 0
    for i in range(count):
        cost[i], before[i] = penalty * i, -1
        # At most 8 points in a row are outliers.
        for j in range(max(0, i - 8), i):
            step = math.hypot(points[i, 0] - points[j, 0], points[i, 1] - points[j, 1])
            value = cost[j] + max(step - 2.0 * spacing * (i - j), 0.0) + penalty * (i - j - 1)
            if value <= cost[i]:
                cost[i], before[i] = value, j
        if cost[i] + penalty * (count - 1 - i) <= best:
            best, last = cost[i] + penalty * (count - 1 - i), i
    kept = np.zeros(count, dtype=np.bool_)
    while last >= 0:
        kept[last] = True
        last = before[last]
    return kept


@compiled
def path_lengths(points: Points, spacing: float) -> Vector:
    """Return the arc length of each point of a noisy path, shape (m,).

    It is measured over steps of at least `spacing`, in which noise adds little; between their ends it is shared out.

    Args:
        points: shape (m, 2).
        spacing: same unit.
    """
    count, last = len(points), 0
    arcs = np.zeros(count)
    for p in range(1, count):
        step = math.hypot(points[p, 0] - points[last, 0], points[p, 1] - points[last, 1])
        if step < spacing and p < count - 1:
            continue
        total = 0.0
        for k in range(last + 1, p + 1):
            arcs[k] = math.hypot(points[k, 0] - points[k - 1, 0], points[k, 1] - points[k - 1, 1])
            total += arcs[k]
        for k in range(last + 1, p + 1):
            arcs[k] = arcs[k - 1] + (step * arcs[k] / total if total > 0.0 else 0.0)
        last = p
    return arcs


class PieceRefusedError(Exception):
    """A piece that is not of the thread; its text is the reason."""


def read_piece(piece: ThreadPiece, unit: float, max_points: int) -> tuple[Points, Vector, Vector, Vector]:
    """Return the points of a piece that lie on its path, their deviations, arc lengths and shares of information.

    Args:
        piece: as the camera gives it; points that are not finite or out of bounds are left out.
        unit: D, the unit of what is returned [m].
        max_points: that are returned; of more, so many are taken evenly, with both ends.

    Raises:
        PieceRefusedError: the shapes do not agree, or no path is left.
    """
    points, deviation = np.asarray(piece.points, dtype=np.float64), np.asarray(piece.deviation, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or deviation.shape != (len(points),):
        shapes = f"{points.shape} and {deviation.shape}"
        raise PieceRefusedError(f"a piece of shapes {shapes}, expected (m, 2) and (m,)")
    inside = (np.abs(points) <= MAX_COORDINATE).all(axis=1) & (deviation >= 0.0) & (deviation <= MAX_COORDINATE)
    finite = np.flatnonzero(inside)
    taken = -(-len(finite) // max(1, -(-len(finite) // max_points)))
    chosen = finite[np.arange(taken) * (len(finite) - 1) // max(taken - 1, 1)]
    path, deviations = points[chosen] / unit, np.maximum(deviation[chosen], MIN_DEVIATION) / unit
    if taken >= MIN_POINTS:
        spacing = np.hypot(*np.diff(path, axis=0).T)
        usual = float(np.median(spacing))
        if spacing.max() > 2.0 * usual:  # else the path through all points costs nothing
            # Noise lengthens the path at a point by eight standard deviations at most.
            kept = path_without_outliers(path, usual, 8.0 * float(np.median(deviations)))
            path, deviations = path[kept], deviations[kept]
    if len(path) < MIN_POINTS:
        raise PieceRefusedError("a piece has fewer than two finite points on a path")
    # Length is measured over steps of 20 standard deviations.
    arcs = path_lengths(path, 20.0 * float(np.median(deviations)))
    if not arcs[-1] > 0.0:
        raise PieceRefusedError("a piece has no length")
    return path, deviations, arcs, np.minimum(1.0, np.gradient(arcs) * unit / POINT_CORRELATION)


def search_start(
    nodes: Points, points: Points, arcs: Vector, low: float, high: float, cap: float
) -> tuple[float, float]:
    """Return the arc length at which a piece best begins, and its mean squared distance from the thread there.

    Args:
        nodes: of the thread, shape (n + 1, 2) [D].
        points: of the piece, shape (m, 2) [D].
        arcs: of the points from the first, shape (m,) [D].
        low: least arc length of the first point [D].
        high: greatest [D].
        cap: of each point's squared distance [D^2].
    """
    # So many points are enough to find where a piece begins.
    stride, numbers = max(1, len(points) // 24), np.arange(len(nodes))
    some, at = points[::stride], arcs[::stride]
    steps = max(1, math.ceil(2.0 * (high - low)))
    starts = np.linspace(low, high, steps + 1)
    for _ in range(2 if high > low else 1):  # then finer about the best
        places = starts[:, None] + at
        x, y = [np.interp(places, numbers, nodes[:, axis]) - some[:, axis] for axis in (0, 1)]
        squares = np.minimum(x * x + y * y, cap).mean(axis=1)
        best = int(squares.argmin())
        found = float(starts[best]), float(squares[best])
        starts = np.clip(starts[best] + np.linspace(-0.5, 0.5, 11) * (high - low) / steps, low, high)
    return found


@compiled
def project(nodes: Points, points: Points, arcs: Vector, start: float, slack: float) -> tuple[Vector, Vector]:
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
        The arc length of each point, nan of one that lies beyond an end, shape (m,) [D]; and its innovation, shape
        (m,) [D].
    """
    segments = len(nodes) - 1
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
        size = math.hypot(ex, ey)
        mx, my = -ey / size, ex / size
        value = mx * (points[p, 0] - nodes[found, 0]) + my * (points[p, 1] - nodes[found, 1])
        for k in range(found, found + 2):
            if 0 < k < segments:
                cx = nodes[k + 1, 0] - 2.0 * nodes[k, 0] + nodes[k - 1, 0]
                cy = nodes[k + 1, 1] - 2.0 * nodes[k, 1] + nodes[k - 1, 1]
                if cx * cx + cy * cy < 1.0:
                    value += 0.25 * t * (1.0 - t) * (mx * cx + my * cy)
        innovation[p] = value
    return place, innovation


class PlacedPiece(NamedTuple):
    """A piece on the thread, in units of the segment length D.

    Attributes:
        points: that are no outliers, shape (m, 2) [D].
        variance: across the thread, shape (m,) [D^2].
        share: of its information that is a point's own, shape (m,).
        arcs: from the first point, shape (m,) [D].
        start: arc length of the first point [D].
        slack: how far from its arc length the first point may lie [D].
        attached: whether it begins at the needle's tail.
        free_end: whether it ends where the thread ends.
        square: mean squared distance from the prior [D^2].
    """

    points: Points
    variance: Vector
    share: Vector
    arcs: Vector
    start: float
    slack: float
    attached: bool
    free_end: bool
    square: float


def place_pieces(
    observation: ThreadObservation, nodes: Points, variance: Vector, unit: float
) -> tuple[list[PlacedPiece], list[str]]:
    """Return the pieces that are of this thread, and the reason for each that is refused.

    Args:
        observation: from the camera.
        nodes: of the predicted thread, shape (n + 1, 2) [D].
        variance: of each across the thread, shape (n + 1,) [D^2].
        unit: D [m].
    """
    segments, pieces = len(nodes) - 1, observation.pieces
    covered = np.zeros(segments, dtype=np.bool_)
    placed: list[PlacedPiece] = []
    problems: list[str] = []
    if len(pieces) > MAX_PIECES:
        problems.append(f"{len(pieces)} pieces, more than {MAX_PIECES}; the others are ignored")
    # Pieces whose place is known come first, whatever the order in which they were given.
    order = [(piece.first_end is not PieceEnd.TAIL, np.nan_to_num(piece.arc_length[0], nan=np.inf)) for piece in pieces]
    for index in sorted(range(min(len(pieces), MAX_PIECES)), key=order.__getitem__):
        try:
            found = place_piece(pieces[index], nodes, variance, unit)
        except PieceRefusedError as error:
            problems.append(str(error))
            continue
        low, high = max(int(found.start), 0), min(math.ceil(found.start + found.arcs[-1]), segments)
        if placed and high > low and np.count_nonzero(covered[low:high]) > 0.5 * (high - low):
            problems.append("a piece lies where another one shows the thread already")
            continue
        covered[low:high] = True
        placed.append(found)
    return placed, problems


def place_piece(piece: ThreadPiece, nodes: Points, variance: Vector, unit: float) -> PlacedPiece:
    """Return a piece on the thread; see `place_pieces`.

    Raises:
        PieceRefusedError: it is none of this thread.
    """
    segments = len(nodes) - 1
    # Of four points for each segment that it could cover, every so many is taken.
    points, deviation, arcs, share = read_piece(piece, unit, 4 * segments)
    length = float(arcs[-1])
    if length * (1.0 - WHOLE) > segments:
        raise PieceRefusedError(f"a piece {length * unit * 1e3:.1f} mm long, longer than the thread")
    first, last = piece.first_end, piece.last_end
    if {first, last} == {PieceEnd.TAIL, PieceEnd.FREE} and abs(length / segments - 1.0) < WHOLE:
        arcs *= segments / length
    attached, known = first is PieceEnd.TAIL, bool(np.isfinite(piece.arc_length).all())
    low, high = 0.0, 0.0 if attached else max(segments - float(arcs[-1]), 0.0)
    if known:
        low, high = np.clip(np.sort(piece.arc_length) / unit, -segments, 2 * segments)
    cap = (0.25 * segments) ** 2
    start, square = search_start(nodes, points, arcs, low, high, cap)
    if not piece.direction_known:
        turned = np.ascontiguousarray(points[::-1]), arcs[-1] - arcs[::-1]
        other, other_square = search_start(nodes, *turned, low, high, cap)
        if other_square < square:
            (points, arcs), deviation, share, last = turned, deviation[::-1], share[::-1], first
            start, square = other, other_square
    # A place that was searched for is as good as the prior lets it be.
    slack = 2.0 * float(deviation.mean()) + (0.25 if high > low else 0.0)
    if not known and not attached:
        place, innovation = project(nodes, points, arcs, start, slack)
        on = np.isfinite(place)
        if on.sum() < max(MIN_POINTS, 0.5 * len(place)):
            raise PieceRefusedError("a piece lies beyond the thread's ends")
        prior = np.interp(place[on], np.arange(len(nodes)), variance)
        # Whether as much of it as could be is in the gate: one or two far points are outliers.
        off = innovation[on] ** 2 / (prior + deviation[on] ** 2)
        if float(np.median(off)) > GATE**2 or float((off > GATE**2).mean()) > 0.3:
            raise PieceRefusedError("a piece lies too far from the predicted thread: it is of another one")
    return PlacedPiece(points, deviation**2, share, arcs, start, slack, attached, last is PieceEnd.FREE, square)


class MeasuredPoints(NamedTuple):
    """Points that are associated with the thread.

    Attributes:
        place: arc length, shape (m,) [D].
        innovation: across the thread, shape (m,) [D].
        variance: of each point across the thread, shape (m,) [D^2].
        share: part of its information that is its own, shape (m,).
        weight: robust weight of each, at most 1, shape (m,); rewritten by each use.
        residual: memory of a correction, shape (m,).
        end: innovation of the free end along the thread and the variance of it, inf if it is not seen [D], [D^2].
    """

    place: Vector
    innovation: Vector
    variance: Vector
    share: Vector
    weight: Vector
    residual: Vector
    end: tuple[float, float] = (0.0, math.inf)


def measured_points(
    placed: list[PlacedPiece], nodes: Points, end_variance: float, scale: float, unit: float, obstacles: Obstacles
) -> tuple[MeasuredPoints | None, list[str]]:
    """Return the points of all pieces on the thread, None if there is none, and why points are refused.

    Args:
        placed: the pieces.
        nodes: of the predicted thread, shape (n + 1, 2) [D].
        end_variance: of the last node [D^2].
        scale: factor on the points' variance.
        unit: D [m].
        obstacles: and how deep the way from a point to the thread must lead into one to be refused [m].
    """
    workspace, margin = obstacles
    segments, found, problems, end = len(nodes) - 1, [np.empty((4, 0))], [], (0.0, math.inf)
    for piece in placed:
        place, innovation = project(nodes, piece.points, piece.arcs, piece.start, piece.slack)
        good = np.isfinite(place)
        far = np.flatnonzero(good & (np.abs(innovation) > 0.5)) if len(workspace.shapes) else ()
        if len(far):
            start = np.column_stack([np.interp(place[far], np.arange(segments + 1), axis) for axis in nodes.T]) * unit
            for share in (0.25, 0.5, 0.75):  # of the way from the thread to the point
                near = workspace.near(start + share * (piece.points[far] * unit - start))
                good[far[near.node[near.distance < -margin]]] = False
            if (refused := int(np.isfinite(place).sum() - good.sum())) > 0:
                problems.append(f"{refused} points lie beyond an obstacle")
        found.append(np.array([place, innovation, scale * piece.variance, piece.share])[:, good])
        if piece.free_end and end[1] == math.inf:  # by how much farther along the thread its free end is seen
            along = nodes[-1] - nodes[-2]
            off = float((piece.points[-1] - nodes[-1]) @ along / np.hypot(*along))
            deviation = LENGTH_ERROR * segments
            if abs(off) < 6.0 * (deviation + math.sqrt(end_variance)):
                end = off, deviation**2 + float(piece.variance[-1])
    columns = np.ascontiguousarray(np.concatenate(found, axis=1))  # compiled code takes its rows
    if not columns.size:
        return None, problems
    (place, innovation, variance, share), (weight, residual) = columns, np.ones((2, columns.shape[1]))
    return MeasuredPoints(place, innovation, variance, share, weight, residual, end), problems
