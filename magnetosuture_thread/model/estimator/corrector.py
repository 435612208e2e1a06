"""Solves a correction's program, with memory that is kept from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.estimator.correction import (
    CORRECTED,
    CorrectionBuffers,
    MeasuredPoints,
    correct,
)
from magnetosuture_thread.model.estimator.sensitivity import correct_sensitivities
from magnetosuture_thread.model.formulations import RodFormulation
from magnetosuture_thread.model.formulations.step_buffers import StepBuffers
from magnetosuture_thread.model.predictor import ThreadPredictor
from magnetosuture_thread.model.solvers import BandedSolver
from magnetosuture_thread.model.solvers.banded import SolverBuffers

Vector = NDArray[np.float64]

RESIDUAL_TOLERANCE = 1e-4  # of a correction's program; the constraints themselves are checked at its end point


@dataclass(frozen=True)
class CorrectionResult:
    """What came of a correction; where it moved the thread is in the corrector's `work`.

    Attributes:
        solves: number of programs solved.
        off: how far off the hard constraints are over what is allowed, at most 1 where they hold.
        residual: the largest of the last solve.
        solved: whether the program was solved and the constraints hold.
    """

    solves: int
    off: float
    residual: float
    solved: bool


@dataclass(frozen=True)
class CorrectedSensitivities:
    """What a correction makes of derivatives of the nodes by parameters, and what its residuals say of these.

    Attributes:
        corrected: V, shape (p, n + 1, 2) [D].
        information: J, shape (p, p).
        score: s, shape (p,).
        square: squared innovations over their covariance, nu' S^-1 nu.
        independent: number of independent points.
    """

    corrected: NDArray[np.float64]
    information: NDArray[np.float64]
    score: Vector
    square: float
    independent: float


class Corrector:
    """Corrects a thread by measured points; see `correct`.

    Args:
        predictor: of the thread.
        formulation: its own.
        length: l, over which the model's errors are alike [D].

    Attributes:
        work: the last correction.
        solver_buffers: of the structured solver, with the factors of the last correction's matrix.
    """

    def __init__(self, predictor: ThreadPredictor, formulation: RodFormulation, length: float) -> None:
        thread, nodes = predictor.thread, predictor.thread.segments + 1
        self._formulation, self._length, self._segments = formulation, length, thread.segments
        self._unit = thread.segment_length
        self.work = CorrectionBuffers.of(nodes)
        self.work.known[[0, *predictor.fixed_nodes]] = True
        self._solver = BandedSolver()
        self._last: tuple[Points, MeasuredPoints, Vector, tuple[float, float], float]
        self._buffers = StepBuffers.of(nodes, 2, 3 * thread.segments + 1)
        self.solver_buffers: SolverBuffers = self._solver.buffers(nodes, 2, len(self._buffers.first))

    def solve(
        self,
        start: Points,
        heading: Points,
        density: Vector,
        noise: Vector,
        points: MeasuredPoints,
        weights: Vector,
        end: tuple[float, float],
    ) -> CorrectionResult:
        """Solve the program about a predicted thread.

        Args:
            start: the predicted thread, shape (n + 1, 2) [D].
            heading: of the needle.
            density: v of each node [D^2].
            noise: q of each node [D^2/s].
            points: the points.
            weights: robust ones to begin with; in the end those used.
            end: innovation of the free end along the thread, and its variance, inf if it is not measured [D], [D^2].
        """
        rod = self._formulation.rod
        stiffness = rod.bending_stiffness / (rod.drag_across * self._unit**4)
        code, solves, off, residuals, scale = correct(
            (0, 1),
            rod,
            self._buffers,
            self._formulation.workspace.data,
            self.solver_buffers,
            self.work,
            start,
            np.ascontiguousarray(heading, dtype=np.float64),
            density,
            noise,
            self._length,
            stiffness,
            points,
            weights,
            end,
            RESIDUAL_TOLERANCE,
        )
        self._last = (start, points, weights, end, scale)
        return CorrectionResult(solves, off, max(residuals), code == CORRECTED and off <= 1.0)

    def sensitivities(self, sensitivities: NDArray[np.float64]) -> CorrectedSensitivities:
        """Return what the last correction makes of derivatives of the nodes, shape (p, n + 1, 2) [D]."""
        count = len(sensitivities)
        corrected, information, score = np.empty_like(sensitivities), np.empty((count, count)), np.empty(count)
        start, points, weights, end, scale = self._last
        square, independent = correct_sensitivities(
            (0, 1),
            points,
            weights,
            end,
            start,
            self.work.moved,
            self.work.known,
            scale,
            self.solver_buffers.band,
            sensitivities,
            corrected,
            information,
            score,
        )
        return CorrectedSensitivities(corrected, information, score, square, independent)
