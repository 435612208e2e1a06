"""From an observation to points on the thread: each piece is checked, and placed along it or refused with a reason."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.estimator.association import (
    Vector,
    project,
    read_piece,
    search_start,
)
from magnetosuture_thread.model.estimator.correction import MeasuredPoints
from magnetosuture_thread.model.estimator.options import EstimatorOptions
from magnetosuture_thread.thread_observation import PieceEnd, ThreadObservation, ThreadPiece

MAX_POINTS = 4  # of a piece, for each segment that it could cover; of more, every so many is taken
MAX_PIECES = 64  # of an observation
MAX_COORDINATE = 10.0  # m
DETOUR = 8.0  # standard deviations that noise may lengthen the path by at a point
STEP = 20.0  # standard deviations; steps of a path over which its length is measured
WHOLE = 0.05  # of the length, by which a piece from the tail to the free end may differ and still be the thread
WHOLE_ENDS = ((PieceEnd.TAIL, PieceEnd.FREE), (PieceEnd.FREE, PieceEnd.TAIL))
LENGTH_ERROR = 0.005  # of the length, by which a thread is known to be longer or shorter than told
GATE = 4.0  # standard deviations; a piece of unknown arc length that is farther from the prior is another thread's
OVERLAP = 0.5  # of a piece; if so much of it lies where another one does already, it is that one again or not ours
FRESH_POINTS = 2  # of a piece, at the least


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

    def projected(self, nodes: Points) -> tuple[Vector, Vector, int]:
        """Return what `project` makes of its points on a thread."""
        return project(nodes, self.points, self.arcs, self.start, self.slack)


def place_pieces(
    observation: ThreadObservation,
    nodes: Points,
    variance: Vector,
    unit: float,
    options: EstimatorOptions,
    problems: list[str],
) -> list[PlacedPiece]:
    """Return the pieces that are of this thread.

    Args:
        observation: from the camera.
        nodes: of the predicted thread, shape (n + 1, 2) [D].
        variance: of each across the thread, shape (n + 1,) [D^2].
        unit: D [m].
        options: of the estimator.
        problems: gets the reason for each piece that is refused.
    """
    segments = len(nodes) - 1
    covered = np.zeros(segments, dtype=np.bool_)
    placed: list[PlacedPiece] = []
    if len(observation.pieces) > MAX_PIECES:
        problems.append(f"{len(observation.pieces)} pieces, more than {MAX_PIECES}; the others are ignored")
    # What is known to be where it is comes first, whatever the order in which it was given.
    order: Sequence[ThreadPiece] = observation.pieces
    if len(order) > 1:
        order = sorted(order[:MAX_PIECES], key=lambda piece: (*_rank(piece), _first_arc(piece)))
    for piece in order:
        found = _place(piece, nodes, variance, unit, options)
        if isinstance(found, str):
            problems.append(found)
            continue
        low, high = max(int(found.start), 0), min(math.ceil(found.start + found.arcs[-1]), segments)
        if placed and high > low and np.count_nonzero(covered[low:high]) > OVERLAP * (high - low):
            problems.append("a piece lies where another one shows the thread already")
            continue
        covered[low:high] = True
        placed.append(found)
    return placed


def _rank(piece: ThreadPiece) -> tuple[bool, bool]:
    return piece.first_end is not PieceEnd.TAIL, not _known(piece)


def _first_arc(piece: ThreadPiece) -> float:
    return piece.arc_length[0] if _known(piece) else math.inf


def _known(piece: ThreadPiece) -> bool:
    return math.isfinite(piece.arc_length[0]) and math.isfinite(piece.arc_length[1])


def _place(
    piece: ThreadPiece, nodes: Points, variance: Vector, unit: float, options: EstimatorOptions
) -> PlacedPiece | str:
    """Return a piece on the thread, or why it is none of it."""
    points, segments = np.ascontiguousarray(piece.points, dtype=np.float64), len(nodes) - 1
    deviation = np.ascontiguousarray(piece.deviation, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or deviation.shape != (len(points),):
        return f"a piece of shapes {points.shape} and {deviation.shape}, expected (m, 2) and (m,)"
    points, squares, arcs, share, mean, finite = read_piece(
        points,
        deviation,
        MAX_COORDINATE,
        options.min_deviation,
        unit,
        MAX_POINTS * segments,
        DETOUR,
        STEP,
        options.point_correlation / unit,
    )
    if finite < FRESH_POINTS:
        return "a piece has fewer than two finite points"
    if len(points) < FRESH_POINTS:
        return "a piece has fewer than two points on a path"
    length = float(arcs[-1])
    if not length > 0.0:
        return "a piece has no length"
    if length * (1.0 - WHOLE) > segments:
        return f"a piece {length * unit * 1e3:.1f} mm long, longer than the thread"
    ends = (piece.first_end, piece.last_end)
    if ends in WHOLE_ENDS and abs(length / segments - 1.0) < WHOLE:
        arcs *= segments / length
    low, high = (value / unit for value in piece.arc_length)
    attached = piece.first_end is PieceEnd.TAIL
    known = _known(piece) or attached
    if attached and not _known(piece):
        low = high = 0.0
    elif not known:
        low, high = 0.0, max(segments - arcs[-1], 0.0)
    low, high = min(low, high), max(low, high)
    cap = (0.25 * segments) ** 2
    best, turned = search_start(nodes, points, arcs, low, high, cap), False
    if not piece.direction_known:
        other = search_start(nodes, np.ascontiguousarray(points[::-1]), arcs[-1] - arcs[::-1], low, high, cap)
        if other[1] < best[1]:
            best, turned = other, True
    if turned:
        points, arcs = np.ascontiguousarray(points[::-1]), np.ascontiguousarray(arcs[-1] - arcs[::-1])
        squares, share, ends = np.ascontiguousarray(squares[::-1]), np.ascontiguousarray(share[::-1]), ends[::-1]
    # A place that was searched for is as good as the prior lets it be.
    slack = 2.0 * mean + (0.25 if high > low else 0.0)
    found = PlacedPiece(
        points,
        squares,
        share,
        arcs,
        best[0],
        slack,
        attached,
        ends[1] is PieceEnd.FREE,
        best[1],
    )
    if not known and (problem := _not_ours(found, nodes, variance)):
        return problem
    return found


def _not_ours(piece: PlacedPiece, nodes: Points, variance: Vector) -> str:
    """Return why a piece of unknown arc length cannot be of this thread, or nothing."""
    place, innovation, _ = piece.projected(nodes)
    on = np.isfinite(place)
    if on.sum() < max(FRESH_POINTS, 0.5 * len(place)):
        return "a piece lies beyond the thread's ends"
    prior = np.interp(place[on], np.arange(len(nodes)), variance)
    # Whether as much of it as could be is in the gate: one or two far points are outliers.
    off = innovation[on] ** 2 / (prior + piece.variance[on])
    if float(np.median(off)) > GATE**2 or float((off > GATE**2).mean()) > 0.3:
        return "a piece lies too far from the predicted thread: it is of another one"
    return ""


def smoothed_line(points: Points, arcs: Vector, length: float) -> Points:
    """Return a path averaged over a length along it, by a normal distribution of that standard deviation."""
    weights = np.exp(-0.5 * ((arcs[:, None] - arcs[None, :]) / length) ** 2)
    # Towards an end the average is taken over less, evenly to both sides, so that the end stays where it is.
    room = np.minimum(arcs, arcs[-1] - arcs)
    weights *= np.abs(arcs[:, None] - arcs[None, :]) <= room[:, None] + 1e-12
    return np.asarray(weights @ points / weights.sum(axis=1, keepdims=True))


def continued(path: Points, positions: Points, node: int) -> Points:
    """Return a path that goes on as a thread lay from a node on, turned so that it goes on straight.

    Args:
        path: shape (m, 2), m >= 2.
        positions: of the thread, shape (n + 1, 2).
        node: at the end of the path.
    """
    path = path[np.concatenate([[True], np.hypot(*np.diff(path, axis=0).T) > 0.0])]
    if node >= len(positions) - 2 or len(path) < 2:
        return path
    rest = positions[node + 1 :] - positions[node]
    old, new = positions[node + 1] - positions[max(node - 1, 0)], path[-1] - path[-min(len(path), 4)]
    turn = math.atan2(new[1], new[0]) - math.atan2(old[1], old[0])
    c, s = math.cos(turn), math.sin(turn)
    return np.vstack([path, path[-1] + rest @ np.array([[c, s], [-s, c]])])


def measured_points(
    placed: list[PlacedPiece],
    nodes: Points,
    unit: float,
    workspace: Workspace,
    margin: float,
    scale: float,
    problems: list[str],
) -> MeasuredPoints | None:
    """Return the points of all pieces on the thread, or None if there is none.

    Args:
        placed: the pieces.
        nodes: of the predicted thread, shape (n + 1, 2) [D].
        unit: D [m].
        workspace: the obstacles.
        margin: how deep the way from a point to the thread must lead into one to be refused [m].
        scale: factor on the points' variance.
        problems: gets why points are refused.
    """
    found = []
    for piece in placed:
        place, innovation, count = piece.projected(nodes)
        variance = scale * piece.variance
        if count == len(place) and not len(workspace.shapes):
            found.append((place, innovation, variance, piece.share))
            continue
        good = np.isfinite(place)
        if len(workspace.shapes) and (far := good & (np.abs(innovation) > 0.5)).any():
            at = np.minimum(place[far].astype(np.int64), len(nodes) - 2)
            part = (place[far] - at)[:, None]
            start = (1.0 - part) * nodes[at] + part * nodes[at + 1]
            parted = through_obstacle(start * unit, piece.points[far] * unit, workspace, margin)
            if parted.any():
                problems.append(f"{int(parted.sum())} points lie beyond an obstacle")
                good[np.flatnonzero(far)[parted]] = False
        if good.all():
            found.append((place, innovation, variance, piece.share))
        elif good.any():
            found.append((place[good], innovation[good], variance[good], piece.share[good]))
    if not found:
        return None
    if len(found) == 1:
        return MeasuredPoints(*found[0])
    return MeasuredPoints(*(np.ascontiguousarray(np.concatenate(each)) for each in zip(*found, strict=True)))


def free_end(placed: list[PlacedPiece], nodes: Points, variance: float) -> tuple[float, float]:
    """Return by how much farther along the thread its free end is seen [D], and the variance of it [D^2].

    Args:
        placed: the pieces.
        nodes: of the predicted thread, shape (n + 1, 2) [D].
        variance: of the last one [D^2].
    """
    for piece in placed:
        if piece.free_end:
            (ax, ay), (bx, by) = nodes[-2:].tolist()
            px, py = piece.points[-1].tolist()
            off = ((px - bx) * (bx - ax) + (py - by) * (by - ay)) / math.hypot(bx - ax, by - ay)
            deviation = LENGTH_ERROR * (len(nodes) - 1)
            if abs(off) < 6.0 * (deviation + math.sqrt(variance)):
                return off, deviation**2 + float(piece.variance[-1])
    return 0.0, math.inf


def through_obstacle(start: Points, points: Points, workspace: Workspace, margin: float) -> np.ndarray:
    """Return which points an obstacle parts from where they would belong, shape (m,).

    Args:
        start: on the thread, shape (m, 2) [m].
        points: measured, shape (m, 2) [m].
        workspace: the obstacles.
        margin: how deep the way between must lead into one [m].
    """
    parted = np.zeros(len(points), dtype=np.bool_)
    for part in (0.25, 0.5, 0.75):
        near = workspace.near(start + part * (points - start))
        parted[near.node[near.distance < -margin]] = True
    return parted
