"""The estimate: the thread as model and camera have it, with its covariance."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.barrier import BarrierRows
from magnetosuture_thread.estimator.disturbance import Disturbance, DisturbanceTest
from magnetosuture_thread.estimator.noise import Innovations, NoiseModel
from magnetosuture_thread.estimator.stiffness import LearnedState, SlowParameter
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread.margins import SOLID, Margins
from magnetosuture_thread.thread.material import Thread
from magnetosuture_thread.thread.prediction import NeedlePose, Prediction
from magnetosuture_thread.thread.step import ThreadState, WarmStart

Vector = NDArray[np.float64]

ONE_SIDED_99 = 2.3263478740408408


@dataclass(frozen=True)
class ThreadEstimate:
    """The thread at one instant, as model and camera have it.

    Attributes:
        prediction: the step that led to it; its positions and margins are the model's, from the last estimate.
        positions: of all nodes, shape (n + 1, 2) [m].
        covariance: of each node, shape (n + 1, 2, 2) [m^2].
        deviation: of each node across the thread, shape (n + 1,) [m].
        corrected: whether a measurement went into it; otherwise it is only a prediction.
        unmeasured_for: time since the last measurement went in, inf if none ever did [s].
        converged: whether the barriers themselves hold.
        residual: largest scaled residual of the correction's program.
        solves: number of programs of the correction.
        points: number of points that were measured and placed on the thread.
        hidden: part of the thread that no point shows.
        innovations: None without a measurement.
        noise: intensity of the process noise in each window, shape (w,) [m^2/s].
        disturbances: what the model does not know.
        problems: why pieces or the whole observation were refused.
        slow_parameters: what is learned of thread and liquid; empty if nothing is asked for.
        thread: with what is learned.
        compute_rows: of the barriers, at its positions.
        contact_tolerance: a node this close to a shape or the wall touches it [m].
    """

    prediction: Prediction
    positions: Points
    covariance: NDArray[np.float64]
    deviation: Vector
    corrected: bool
    unmeasured_for: float
    converged: bool
    residual: float
    solves: int
    points: int
    hidden: float
    innovations: Innovations | None
    noise: Vector
    disturbances: tuple[Disturbance, ...]
    problems: tuple[str, ...]
    slow_parameters: tuple[SlowParameter, ...]
    thread: Thread
    compute_rows: Callable[[], list[BarrierRows]] = field(repr=False, compare=False)
    contact_tolerance: float = field(repr=False)

    @property
    def stamp(self) -> float:
        """Of the needle's pose [s]."""
        return self.prediction.stamp

    @cached_property
    def _rows(self) -> list[BarrierRows]:
        return self.compute_rows()

    @cached_property
    def margins(self) -> Margins:
        """The margins of every barrier by its name with their bounds, of its positions; computed at first access."""
        margins = Margins.of(self._rows, self.contact_tolerance, self.prediction.scene_version)
        return margins.with_bounds(self.clearance_bounds)

    @cached_property
    def clearance_bounds(self) -> dict[str, Vector]:
        """One-sided 99 % bound of each margin of obstacles, wall and added barriers as a distance [m].

            clearance - 2.33 sum_k (g_k' C_k g_k)^(1/2) / |g|

        with the covariances C_k of the nodes that the row depends on, taken as fully correlated. Of obstacles and wall
        the clearance is that of the half segments beside a node too, and the greatest deviation along g of the node
        and its neighbours counts: that of a point between two nodes is not greater.
        """
        bounds = {}
        for rows in self._rows:
            if rows.name in SOLID or rows.name not in _OWN:
                bounds[rows.name] = _bound(rows, self.covariance, rows.name in SOLID)
        return bounds


_OWN = ("connectivity", "compression", "enhanced_connectivity", "stiffness", *SOLID)


def _bound(rows: BarrierRows, covariance: NDArray[np.float64], of_segments: bool) -> Vector:
    if not len(rows.clearance):
        return rows.clearance
    deviation = np.zeros(len(rows.clearance))
    for apart in (-1, 0, 1) if of_segments else (0,):
        nodes = np.clip(rows.nodes + apart, 0, len(covariance) - 1)
        spread = np.einsum("rkab,rkb->rka", covariance[nodes], rows.gradient)
        single = np.sqrt(np.maximum(np.einsum("rka,rka->rk", rows.gradient, spread), 0.0)).sum(axis=1)
        deviation = np.maximum(deviation, single)
    slope = np.sqrt(np.einsum("rkd,rkd->r", rows.gradient, rows.gradient))
    return np.asarray(rows.clearance - ONE_SIDED_99 * deviation / np.where(slope > 0.0, slope, 1.0))


@dataclass
class FilterState:
    """Everything that the next step and correction depend on.

    Attributes:
        errors: variance and density of each node, see `noise`, shape (2, n + 1) [D^2].
        noise: what is learned of the noise.
        test: for disturbances.
        measured_at: stamp of the last measurement, -inf before the first [s].
        gross: number of frames in a row that showed the thread somewhere else.
        unknown: whether nobody has seen the thread's shape.
        converged: whether the barriers themselves hold.
        prediction: the last step.
        pose, thread, warm_start, learned: of predictor, formulation and `StiffnessLearner`; set in a snapshot.
    """

    errors: Points
    noise: NoiseModel
    test: DisturbanceTest
    measured_at: float = -math.inf
    gross: int = 0
    unknown: bool = True
    converged: bool = False
    prediction: Prediction | None = None
    pose: NeedlePose | None = None
    thread: ThreadState | None = None
    warm_start: WarmStart | None = None
    learned: LearnedState | None = None
