"""Threads, poses and observations that the estimator's tests share."""

from __future__ import annotations

import math

import numpy as np

from magnetosuture_thread import Disc
from magnetosuture_thread.estimator.estimator import ThreadEstimator
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.thread.material import MATERIALS, Attachment, Thread
from magnetosuture_thread.thread.prediction import NeedlePose
from magnetosuture_thread.thread.predictor import ThreadPredictor

LENGTH = 0.019
RATE = 30.0
DEVIATION = 2e-5


def thread_of(
    segments: int = 25, material: str = "silk_6_0", viscosity: float = 1.0, attachment: str = "pinned"
) -> Thread:
    kind = Attachment(attachment)
    return Thread.of(MATERIALS[material], length=LENGTH, segments=segments, attachment=kind, viscosity=viscosity)


def predictor_of(thread: Thread, discs: tuple[Disc, ...] = ()) -> ThreadPredictor:
    return ThreadPredictor(thread, Workspace(discs, 5e-3))


def estimator_of(thread: Thread, discs: tuple[Disc, ...] = ()) -> ThreadEstimator:
    return ThreadEstimator(predictor_of(thread, discs))


def poses(count: int, speed: float = 2e-3, turn: float = 0.6) -> list[NeedlePose]:
    """Return poses of a needle that drives in a circle."""
    found, place, heading = [], np.zeros(2), 0.0
    for k in range(count):
        way = np.array([math.cos(heading), math.sin(heading)])
        found.append(NeedlePose(k / RATE, place.copy(), way))
        place, heading = place + speed / RATE * way, heading + turn / RATE
    return found


def true_shapes(thread: Thread, way: list[NeedlePose], discs: tuple[Disc, ...] = ()) -> np.ndarray:
    """Return the nodes at each pose of a thread that starts straight behind the needle."""
    predictor = predictor_of(thread, discs)
    first = predictor.start(way[0]).positions
    return np.array([first, *(predictor.step(pose).positions for pose in way[1:])])


def piece_of(
    nodes: Points, seed: int, begin: float = 0.0, end: float = LENGTH, deviation: float = DEVIATION
) -> ThreadPiece:
    """Return a noisy piece of a thread between two arc lengths, by default all of it."""
    rng = np.random.default_rng(seed)
    total = float(arc_lengths(nodes)[-1])
    points = points_at(nodes, np.linspace(begin, min(end, total), max(int((end - begin) / 2e-4), 2)))
    along = np.gradient(points, axis=0)
    normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.hypot(*along.T)[:, None]
    points = points + rng.normal(0.0, deviation, len(points))[:, None] * normal
    return ThreadPiece(
        points,
        np.full(len(points), deviation),
        PieceEnd.TAIL if begin == 0.0 else PieceEnd.COVERED,
        PieceEnd.FREE if end >= LENGTH else PieceEnd.COVERED,
        (begin, begin),
    )


def whole(nodes: Points, seed: int) -> ThreadObservation:
    return ThreadObservation((piece_of(nodes, seed),), True)


def error_percent(positions: Points, truth: Points) -> float:
    return float(100.0 / LENGTH * np.linalg.norm(positions - truth, axis=1).mean())
