"""The estimator: the predictor's steps along the needle's poses, each corrected by what the camera measures."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.arguments import checked_arguments
from magnetosuture_thread.barrier import BarrierRows
from magnetosuture_thread.errors import ConfigurationError, InvalidInputError
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, chain_inside
from magnetosuture_thread.model.estimator.correction import MeasuredPoints
from magnetosuture_thread.model.estimator.corrector import Corrector
from magnetosuture_thread.model.estimator.disturbance import DisturbanceTest
from magnetosuture_thread.model.estimator.estimate import FilterState, ThreadEstimate
from magnetosuture_thread.model.estimator.innovations import Innovations, WindowSums, weigh
from magnetosuture_thread.model.estimator.noise import WINDOWS, interpolate_to_nodes
from magnetosuture_thread.model.estimator.noise_model import NoiseModel, propagate_errors, take_correction
from magnetosuture_thread.model.estimator.options import EstimatorOptions
from magnetosuture_thread.model.estimator.pieces import (
    PlacedPiece,
    continued,
    free_end,
    measured_points,
    place_pieces,
    smoothed_line,
)
from magnetosuture_thread.model.estimator.slow_parameters import LearnedState, SlowParameters
from magnetosuture_thread.model.formulations import RodFormulation, ThreadState
from magnetosuture_thread.model.prediction import NeedlePose, Prediction
from magnetosuture_thread.model.predictor import ThreadPredictor
from magnetosuture_thread.thread_observation import PieceEnd, ThreadObservation, ThreadPiece

Vector = NDArray[np.float64]

LARGE_ERROR = 1.5  # segments; a piece that begins at the needle and lies farther off gives the shape itself
SMOOTHING = 2.0  # of a shape that is laid along a piece, in lengths over which its points err alike
LAID_DEVIATION = 5.0  # of the shape laid along a piece, in those of its points
MIN_VARIANCE = 1e-12  # D^2
MIN_SHARED = 0.4  # of a point's variance, which the points of a window share and which lasts


class ThreadEstimator:
    """Estimates a thread from the needle's poses and what the camera measures of the thread.

        estimator = ThreadEstimator(predictor)
        estimator.start(pose)                          # shape unknown: straight behind the needle
        estimate = estimator.step(next_pose, observation)

    Without observations its positions are those of the predictor to the last bit.

    Args:
        predictor: steps the thread; formulation `rod`, in the plane. The estimator moves its state.
        options: how much camera and model are trusted.

    Raises:
        ConfigurationError: the predictor's formulation is not `rod`, or it is not in the plane.
    """

    @checked_arguments("estimator")
    def __init__(self, predictor: ThreadPredictor, options: EstimatorOptions | None = None) -> None:
        formulation = predictor.formulation
        if not isinstance(formulation, RodFormulation):
            raise ConfigurationError("formulation", formulation.name, "rod, which the estimator corrects")
        if formulation.dimension != 2:
            raise ConfigurationError("dimension", formulation.dimension, "2: a camera measures in the plane")
        self.predictor, self.thread = predictor, predictor.thread
        self.options = options or EstimatorOptions()
        self._formulation = formulation
        self._unit = self.thread.segment_length
        self._length = max(self.options.error_correlation * self.thread.segments, 0.5)
        self._corrector = Corrector(predictor, formulation, self._length)
        self._slow = SlowParameters(predictor, self.options)
        self._prediction: Prediction | None = None
        self._converged = False
        self._sums = WindowSums.of(WINDOWS)
        self._forget()

    def _forget(self) -> None:
        nodes = self.thread.segments + 1
        self._density, self._variance = np.zeros(nodes), np.zeros(nodes)  # D^2
        self._noise = NoiseModel(self.options.noise_time)
        self._test = DisturbanceTest(self.thread, self.options.disturbance_time)
        self._measured_at = -math.inf
        self._gross, self._unknown = 0, True
        self._slow.reset()

    @property
    def learned(self) -> LearnedState:
        """What is known of the slow parameters."""
        return self._slow.state

    @property
    def started(self) -> bool:
        """Whether the thread has a shape."""
        return self.predictor.started

    def warm_up(self) -> None:
        """Compile everything, so that no callback waits for it."""
        self.predictor.warm_up()
        path = np.array([[0.0, 0.0], [-self.thread.length, 0.0]])
        points = np.linspace(path[0], path[1], 50)
        piece = ThreadPiece(points, np.full(50, 1e-5), PieceEnd.TAIL, PieceEnd.FREE, (0.0, 0.0), False)
        pose = NeedlePose(0.0, np.zeros(2), np.array([1.0, 0.0]))
        self.start(pose, path)
        self.step(replace(pose, stamp=0.01), ThreadObservation((piece,), True))
        self.reset()
        self.predictor.added.first_time = math.inf

    def reset(self) -> None:
        """Forget the thread; the next call must be `start`."""
        self.predictor.reset()
        self._prediction = None
        self._forget()

    def start(
        self, pose: NeedlePose, centreline: Points | None = None, deviation: float | None = None
    ) -> ThreadEstimate:
        """Set the thread's shape.

        Args:
            pose: the needle.
            centreline: measured, from the needle's tail on, shape (m, 2) [m]; it may end early. None is a thread that
                lies straight behind the needle, of which nothing is known.
            deviation: of the centreline [m]; None for `initial_error`, which grows along the thread.

        Raises:
            InvalidInputError: see `ThreadPredictor.start`.
        """
        self._prediction = self.predictor.start(pose, centreline, strict=False)
        self._converged = self._prediction.converged
        self._forget()
        arcs = np.arange(self.thread.segments + 1.0)
        variance = (self.options.initial_error * arcs) ** 2
        if centreline is not None:
            seen = arc_lengths(centreline)[-1] / self._unit
            known = (LAID_DEVIATION * self.options.min_deviation if deviation is None else deviation) / self._unit
            variance = known**2 + (self.options.initial_error * np.maximum(arcs - seen, 0.0)) ** 2
        self._set_variance(variance)
        self._unknown = centreline is None
        return self._estimate(())

    def start_observed(self, pose: NeedlePose, observation: ThreadObservation) -> ThreadEstimate:
        """Set the thread's shape along the piece that leaves the needle; without one, straight behind it."""
        self.start(pose)
        return self.correct(observation)

    def step(self, pose: NeedlePose, observation: ThreadObservation | None = None) -> ThreadEstimate:
        """Follow the needle to its next pose, and correct the thread by what the frame of that pose shows of it.

        Args:
            pose: the needle.
            observation: of the thread, at the same instant; None if there is none.

        Raises:
            InvalidInputError: see `ThreadPredictor.step`.
            SolverError: see `ThreadPredictor.step`.
        """
        before = self.predictor.state
        self._prediction = self._slow.step(pose)
        self._converged = self._prediction.converged
        state = self.predictor.state
        assert before is not None
        assert state is not None
        propagate_errors(
            np.ascontiguousarray(state.positions),
            np.ascontiguousarray(before.positions),
            self._unit,
            self._noise.bank.intensity,
            self._prediction.interval,
            2.0 * self._length,
            self._variance,
            self._density,
        )
        self._test.decay(self._prediction.interval, self._formulation.nodes_in_contact)
        return self.correct(observation) if observation is not None else self._estimate(())

    def correct(self, observation: ThreadObservation) -> ThreadEstimate:
        """Correct the thread at the last pose by an observation of the same instant."""
        state, pose = self.predictor.state, self.predictor.pose
        if state is None or pose is None:
            raise InvalidInputError("thread observation", "one before the start", "a centreline first")
        unit = self._unit
        problems: list[str] = []
        nodes = state.positions / unit
        placed = place_pieces(observation, nodes, self._variance, unit, self.options, problems)
        if placed and (laid := self._laid_along(placed[0], pose, state)) is not None:
            state = laid
            nodes = state.positions / unit
            placed = place_pieces(observation, nodes, self._variance, unit, self.options, problems := [])
        workspace, scale = self._formulation.workspace, self._noise.scale
        points = measured_points(placed, nodes, unit, workspace, 0.5 * self.thread.diameter, scale, problems)
        if points is None:
            return self._estimate(tuple(problems))
        end = free_end(placed, nodes, float(self._variance[-1]))
        if (moved := self._learn_parameters(points, end, pose, state)) is not state:
            state, nodes = moved, moved.positions / unit
            end = free_end(placed, nodes, float(self._variance[-1]))
            again = measured_points(placed, nodes, unit, workspace, 0.5 * self.thread.diameter, scale, problems := [])
            points = again if again is not None else points
        return self._corrected(points, end, pose, nodes, state, problems)

    def _learn_parameters(
        self, points: MeasuredPoints, end: tuple[float, float], pose: NeedlePose, state: ThreadState
    ) -> ThreadState:
        """Learn the slow parameters; return where the thread is predicted with them."""
        if not self._slow.active:
            return state
        weights, noise = np.ones(len(points.place)), np.empty(self.thread.segments + 1)
        interpolate_to_nodes(self._noise.intensity, len(noise), noise)
        weigh(points, self._variance, weights, self._sums)
        density, start = np.maximum(self._density, MIN_VARIANCE), np.ascontiguousarray(state.positions / self._unit)
        done = self._corrector.solve(start, pose.heading, density, noise / self._unit**2, points, weights, end)
        if not done.solved:
            return state
        return self._slow.learn(self._corrector, state, pose.stamp)

    def _laid_along(self, piece: PlacedPiece, pose: NeedlePose, state: ThreadState) -> ThreadState | None:
        """Lay the thread along a piece that begins at the needle, if the estimate is nowhere near it.

        At once where the estimate is known to be as bad as that, or was never measured, else when a second frame says
        so too. What the piece does not show goes on as it lay.
        """
        fresh = self._unknown
        if not piece.attached or (not fresh and piece.square < LARGE_ERROR**2):
            self._gross = 0
            return None
        self._gross += 1
        end = piece.start + piece.arcs[-1]
        prior = float(np.interp(0.5 * end, np.arange(len(self._variance)), self._variance))
        measured = math.isfinite(self._measured_at)
        if not fresh and measured and self._gross < 2 and piece.square > 9.0 * prior:
            return None
        self._gross = 0
        unit, segments = self._unit, self.thread.segments
        seen = smoothed_line(piece.points, piece.arcs, SMOOTHING * self.options.point_correlation / unit) * unit
        path = continued(np.vstack([pose.tail, seen[1:]]), state.positions, int(min(end, segments - 1.0)))
        radius = self._formulation.workspace.wall_radius - 0.5 * self.thread.diameter
        chain = chain_inside(path, segments, unit, radius)
        laid = ThreadState.at_rest(chain)
        # Whether it lies outside of obstacles is not known before it is corrected.
        self._unknown = self._converged = False
        self.predictor.pose, self.predictor.state = pose, laid
        arcs = np.arange(segments + 1.0)
        known = LAID_DEVIATION**2 * float(np.median(piece.variance))
        self._set_variance(known + (self.options.initial_error * np.maximum(arcs - end, 0.0)) ** 2)
        self._noise = NoiseModel(self.options.noise_time)
        self._test = DisturbanceTest(self.thread, self.options.disturbance_time)
        self._slow.restart()
        return laid

    def _corrected(
        self,
        points: MeasuredPoints,
        end: tuple[float, float],
        pose: NeedlePose,
        nodes: Points,
        state: ThreadState,
        problems: list[str],
    ) -> ThreadEstimate:
        unit, segments = self._unit, self.thread.segments
        weights = np.empty(len(points.place))
        elapsed = pose.stamp - self._measured_at if math.isfinite(self._measured_at) else 0.0
        innovations, noise = self._noise.learn(
            points, weights, self._sums, unit, elapsed, 2.0 * self._length, self._variance, self._density
        )
        density = np.maximum(self._density, MIN_VARIANCE)
        start = np.ascontiguousarray(nodes)
        done = self._corrector.solve(start, pose.heading, density, noise, points, weights, end)
        if not done.solved:
            problems.append(f"the correction was not solved: residual {done.residual:.1e}, off by {done.off:.1g}")
            return self._estimate(tuple(problems), innovations=innovations, points=len(weights))
        self._density, self._variance = density, np.empty(segments + 1)
        work = self._corrector.work
        hidden = take_correction(points, weights, work, unit, self._noise.bank, density, self._variance)
        self._slow.correct(self._corrector, self._variance)
        positions = work.about * unit
        # What of a point's variance does not change from frame to frame is of the dish's place in the image: the points
        # of a window share it, and so do both times that the test compares.
        shared = max(1.0 - self._noise.scale, MIN_SHARED) / self._noise.scale * self._sums.independent
        variance = self._sums.own * (1.0 + 0.5 * shared) * unit**2
        if math.isfinite(self._measured_at):  # else there is no earlier time to compare with
            deviations = np.asarray(pose.deviation)
            self._test.add(work.moved * unit, work.normals, variance, pose.stamp, deviations)
            if self._test.confirmed(pose.stamp):
                self._slow.activate()
        corrected = ThreadState(positions, state.velocities, state.interval)
        self.predictor.pose, self.predictor.state = pose, corrected
        self._converged = True
        self._unknown = False
        self._measured_at = pose.stamp
        return self._estimate(
            tuple(problems),
            corrected=True,
            innovations=innovations,
            residual=done.residual,
            solves=done.solves,
            points=len(weights),
            hidden=hidden,
        )

    def _set_variance(self, variance: Vector) -> None:
        self._variance = np.array(variance)
        self._variance[0] = 0.0
        self._density = 2.0 * self._length * self._variance

    def _estimate(
        self,
        problems: tuple[str, ...],
        *,
        corrected: bool = False,
        innovations: Innovations | None = None,
        residual: float = 0.0,
        solves: int = 0,
        points: int = 0,
        hidden: float = 1.0,
    ) -> ThreadEstimate:
        prediction, pose, state = self._prediction, self.predictor.pose, self.predictor.state
        assert prediction is not None
        assert pose is not None
        assert state is not None
        formulation, positions = self._formulation, state.positions
        # Where innovations are larger than expected, so are the errors that are left.
        scale = self._unit**2 * max(self._noise.ratio, 1.0)
        if corrected:
            covariance = scale * self._corrector.work.covariance
        else:
            along = np.gradient(positions, axis=0)
            normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.hypot(*along.T), 1e-12)[:, None]
            covariance = scale * self._variance[:, None, None] * normal[:, :, None] * normal[:, None, :]
        formulation.added.set_time(pose.stamp)
        added, tolerance = formulation.added.rows(positions), self.predictor.contact_tolerance

        def compute_rows() -> list[BarrierRows]:
            return [*formulation.margins(positions, pose.heading), *added]

        return ThreadEstimate(
            prediction=prediction,
            positions=positions,
            covariance=covariance,
            deviation=np.sqrt(scale * np.maximum(self._variance, 0.0)),
            corrected=corrected,
            unmeasured_for=pose.stamp - self._measured_at,
            converged=self._converged,
            residual=residual,
            solves=solves,
            points=points,
            hidden=hidden,
            innovations=innovations,
            noise=self._noise.bank.intensity.copy(),
            disturbances=self._test.found(pose.stamp, positions),
            problems=problems,
            slow_parameters=self._slow.report(),
            thread=self._slow.thread,
            compute_rows=compute_rows,
            contact_tolerance=tolerance,
        )

    def snapshot(self) -> FilterState | None:
        """Return everything that the next step depends on; None before the start."""
        state, pose = self.predictor.state, self.predictor.pose
        if state is None or pose is None or self._prediction is None:
            return None
        return FilterState(
            self._prediction,
            self._converged,
            pose,
            state,
            self._formulation.warm_start(),
            self._density.copy(),
            self._variance.copy(),
            self._noise.copied(),
            self._test.copied(),
            self._measured_at,
            self._gross,
            self._unknown,
            self._slow.state,
        )

    def restore(self, kept: FilterState) -> None:
        """Go back to a snapshot; what follows is the same again to the last bit."""
        self.predictor.pose, self.predictor.state = kept.pose, kept.thread
        self._prediction, self._converged = kept.prediction, kept.converged
        self._formulation.restore(kept.warm_start)
        self._density, self._variance = kept.density.copy(), kept.variance.copy()
        self._noise, self._test = kept.noise.copied(), kept.test.copied()
        self._measured_at, self._gross, self._unknown = kept.measured_at, kept.gross, kept.unknown
        self._slow.restore(kept.slow)
