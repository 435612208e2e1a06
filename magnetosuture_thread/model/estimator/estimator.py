"""The estimator: the predictor's steps along the needle's poses, each corrected by what the camera measures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.barrier import OBSTACLE, WALL, BarrierRows
from magnetosuture_thread.errors import ConfigurationError, InvalidInputError
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, chain_inside
from magnetosuture_thread.model.estimator.correction import (
    CORRECTED,
    NO_ROOM,
    CorrectionBuffers,
    MeasuredPoints,
    correct,
    propagate,
)
from magnetosuture_thread.model.estimator.disturbance import Disturbance, force_density, strongest
from magnetosuture_thread.model.estimator.innovations import WindowSums, moved_apart, take_over, weigh
from magnetosuture_thread.model.estimator.noise import (
    GRID,
    WINDOWS,
    NoiseBank,
    learn,
    shift_errors,
    spread_to_nodes,
    unexplained,
)
from magnetosuture_thread.model.estimator.options import EstimatorOptions
from magnetosuture_thread.model.estimator.pieces import PlacedPiece, place_pieces, smoothed, through_obstacle
from magnetosuture_thread.model.formulations import RodFormulation, ThreadState
from magnetosuture_thread.model.formulations.step import StepBuffers
from magnetosuture_thread.model.margins import Margins
from magnetosuture_thread.model.predictor import NeedlePose, Prediction, ThreadPredictor
from magnetosuture_thread.model.solvers import BandedSolver
from magnetosuture_thread.thread_observation import PieceEnd, ThreadObservation, ThreadPiece

Vector = NDArray[np.float64]

ONE_SIDED_99 = 2.3263478740408408
RESIDUAL_TOLERANCE = 1e-4  # of a correction's program; the constraints themselves are checked at its end point
LARGE_ERROR = 1.5  # segments; a piece that begins at the needle and lies farther off gives the shape itself
SMOOTHING = 2.0  # of a shape that is laid along a piece, in lengths over which its points err alike
LAID_DEVIATION = 5.0  # of the shape laid along a piece, in those of its points
SCALE_MEMORY = 5.0  # s; over which the scale of the points' variance is learned
RATIO_MEMORY = 2.0  # s; over which the covariance of innovations is matched to them
LEARNING_PRIOR = 0.2  # s of measurements, that what is assumed to begin with is worth
MIN_SCALE, MAX_SCALE = 0.25, 16.0
FOUND, LOST = 4.5, 2.5  # standard deviations at which a disturbance begins and ends
CONFIRMED = 0.25  # of `disturbance_time`, for which it must last
SURE = 3.0  # standard deviations
MIN_INTERVAL = 1e-3  # s; between measurements, in which noise can be at work
MIN_VARIANCE = 1e-12  # D^2


@dataclass(frozen=True)
class Innovations:
    """What a frame says against the prediction, by windows of equal arc length from the needle to the free end.

    Attributes:
        mean: of the points' innovations across the thread, positive to the left; nan where nothing is measured [m].
        variance: that the filter expects of it [m^2].
    """

    mean: Vector
    variance: Vector

    @property
    def normalised_squared(self) -> Vector:
        """Normalised innovation squared of each window, 1 in the mean; nan where nothing is measured."""
        return np.asarray(self.mean**2 / self.variance)


@dataclass(frozen=True)
class Estimate:
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
    compute_rows: Callable[[], list[BarrierRows]] = field(repr=False, compare=False)
    make_margins: Callable[[Sequence[BarrierRows]], Margins] = field(repr=False, compare=False)

    @property
    def stamp(self) -> float:
        """Of the needle's pose [s]."""
        return self.prediction.stamp

    @cached_property
    def margins(self) -> Margins:
        """The margins of every barrier by its name, of the estimate's positions; computed at first access."""
        return self.make_margins(self.compute_rows())

    @cached_property
    def clearance_bounds(self) -> dict[str, Vector]:
        """One-sided 99 % bound of each margin of obstacles, wall and added barriers as a distance [m].

            clearance - 2.33 sum_k (g_k' C_k g_k)^(1/2) / |g|

        with the covariances C_k of the nodes that the row depends on, taken as fully correlated.
        """
        bounds = {}
        for rows in self.compute_rows():
            if rows.name in (OBSTACLE, WALL) or rows.name not in _OWN:
                bounds[rows.name] = _bound(rows, self.covariance)
        return bounds


_OWN = ("connectivity", "compression", "enhanced_connectivity", "stiffness", OBSTACLE, WALL)


def _bound(rows: BarrierRows, covariance: NDArray[np.float64]) -> Vector:
    spread = np.sqrt(np.einsum("rka,rkab,rkb->rk", rows.gradient, covariance[rows.nodes], rows.gradient)).sum(axis=1)
    slope = np.sqrt(np.einsum("rkd,rkd->r", rows.gradient, rows.gradient))
    return np.asarray(rows.clearance - ONE_SIDED_99 * spread / np.where(slope > 0.0, slope, 1.0))


@dataclass(frozen=True)
class FilterState:
    """Everything that the next step and correction depend on."""

    prediction: Prediction
    converged: bool
    pose: NeedlePose
    thread: ThreadState
    memory: tuple[Vector, Vector]
    density: Vector
    variance: Vector
    bank: NoiseBank
    measured_at: float
    rate: Points
    rate_time: float
    gross: tuple[int, bool]
    since: float
    scale: tuple[float, float, float, float]
    last_mean: Vector
    last_variance: Vector
    significance: Vector


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

    def __init__(self, predictor: ThreadPredictor, options: EstimatorOptions | None = None) -> None:
        formulation = predictor.formulation
        if not isinstance(formulation, RodFormulation):
            raise ConfigurationError("formulation", formulation.name, "rod, which the estimator corrects")
        if formulation.dimension != 2:
            raise ConfigurationError("dimension", formulation.dimension, "2: a camera measures in the plane")
        self.predictor, self.thread = predictor, predictor.thread
        self.options = options or EstimatorOptions()
        self._formulation = formulation
        nodes = self.thread.segments + 1
        self._unit = self.thread.segment_length
        self._length = max(self.options.error_correlation * self.thread.segments, 0.5)
        self._stiffness = self.thread.bending_stiffness / (self.thread.medium.drag_across * self._unit**4)
        self._solver = BandedSolver()
        self._memory = CorrectionBuffers.of(nodes)
        self._use(StepBuffers.of(nodes, 2, 3 * self.thread.segments + 1, 2 * nodes))
        self._known = np.zeros(nodes, dtype=np.bool_)
        self._known[[0, *predictor.fixed_nodes]] = True
        self._work = np.empty(nodes)
        self._added = np.empty(nodes)
        self._prediction: Prediction | None = None
        self._converged = False
        self._sums, self._applied = WindowSums.of(WINDOWS), np.zeros(WINDOWS)
        self._forget()

    def _use(self, buffers: StepBuffers) -> None:
        self._buffers = buffers
        self._solver_buffers = self._solver.buffers(self.thread.segments + 1, 2, len(buffers.first))

    def _forget(self) -> None:
        nodes = self.thread.segments + 1
        self._density, self._variance = np.zeros(nodes), np.zeros(nodes)  # D^2
        self._bank = NoiseBank.of(WINDOWS)
        self._measured_at = -math.inf
        self._rate, self._rate_time = np.zeros((nodes, 2)), 0.0
        self._gross, self._unknown = 0, True
        self._since = math.nan
        self._scale, self._ratio, self._elapsed, self._learned_for = 1.0, 1.0, 0.0, 0.0
        self._last_mean, self._last_variance = np.full(WINDOWS, np.nan), np.full(WINDOWS, np.nan)
        self._significance = np.zeros(WINDOWS)

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

    def reset(self) -> None:
        """Forget the thread; the next call must be `start`."""
        self.predictor.reset()
        self._prediction = None
        self._forget()

    def start(self, pose: NeedlePose, centreline: Points | None = None, deviation: float | None = None) -> Estimate:
        """Set the thread's shape.

        Args:
            pose: the needle.
            centreline: measured, from the needle's tail on, shape (m, 2) [m]; it may end early. None is a thread that
                lies straight behind the needle, of which nothing is known.
            deviation: of the centreline [m]; None for `initial_error`, which grows along the thread.

        Raises:
            InvalidInputError: see `ThreadPredictor.start`.
        """
        self._prediction = self.predictor.start(pose, centreline)
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

    def start_observed(self, pose: NeedlePose, observation: ThreadObservation) -> Estimate:
        """Set the thread's shape from a first observation: along the piece that leaves the needle, and on from there.

        Without such a piece the thread lies straight behind the needle, and nothing is known of it.
        """
        self.start(pose)
        return self.correct(observation)

    def step(self, pose: NeedlePose, observation: ThreadObservation | None = None) -> Estimate:
        """Follow the needle to its next pose, and correct the thread by what the frame of that pose shows of it.

        Args:
            pose: the needle.
            observation: of the thread, at the same instant; None if there is none.

        Raises:
            InvalidInputError: see `ThreadPredictor.step`.
            SolverError: see `ThreadPredictor.step`.
        """
        before = self.predictor.state
        self._prediction = self.predictor.step(pose)
        self._converged = self._prediction.converged
        state = self.predictor.state
        assert before is not None
        assert state is not None
        spread_to_nodes(self._bank.intensity, len(self._added), self._added)
        self._added *= self._prediction.interval / self._unit**2
        self._added[0] = 0.0
        here, there = state.positions / self._unit, before.positions / self._unit
        propagate(here, there, self._added, self._variance, self._work)
        propagate(here, there, 2.0 * self._length * self._added, self._density, self._work)
        self._decay_rate(self._prediction.interval)
        return self.correct(observation) if observation is not None else self._estimate(())

    def correct(self, observation: ThreadObservation) -> Estimate:
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
        points = self._points(placed, nodes, problems)
        if points is None:
            return self._estimate(tuple(problems))
        return self._corrected(points, self._free_end(placed, nodes), pose, state, problems)

    def _laid_along(self, piece: PlacedPiece, pose: NeedlePose, state: ThreadState) -> ThreadState | None:
        """Lay the thread along a piece that begins at the needle, if the estimate is nowhere near it.

        At once where the estimate is known to be as bad as that, else when a second frame says so too. What the piece
        does not show goes on as it lay.
        """
        fresh = self._unknown
        if not piece.attached or (not fresh and piece.square < LARGE_ERROR**2):
            self._gross = 0
            return None
        self._gross += 1
        end = piece.start + piece.arcs[-1]
        prior = float(np.interp(0.5 * end, np.arange(len(self._variance)), self._variance))
        if not fresh and self._gross < 2 and piece.square > 9.0 * prior:
            return None
        self._gross = 0
        unit, segments = self._unit, self.thread.segments
        path = np.vstack(
            [
                pose.tail,
                smoothed(piece.points, piece.arcs, SMOOTHING * self.options.point_correlation / unit)[1:] * unit,
            ]
        )
        path = path[np.concatenate([[True], np.hypot(*np.diff(path, axis=0).T) > 0.0])]
        at = int(min(end, segments - 1.0))
        if at < segments - 1 and len(path) >= 2:
            rest = state.positions[at + 1 :] - state.positions[at]
            old = state.positions[at + 1] - state.positions[max(at - 1, 0)]
            new = path[-1] - path[-min(len(path), 4)]
            turn = math.atan2(new[1], new[0]) - math.atan2(old[1], old[0])
            c, s = math.cos(turn), math.sin(turn)
            path = np.vstack([path, path[-1] + rest @ np.array([[c, s], [-s, c]])])
        radius = self._formulation.workspace.wall_radius - 0.5 * self.thread.diameter
        chain = chain_inside(path, segments, unit, radius)
        laid = ThreadState.at_rest(chain)
        # Whether it lies outside of obstacles is not known before it is corrected.
        self._unknown = self._converged = False
        self.predictor.continue_from(pose, laid)
        arcs = np.arange(segments + 1.0)
        known = LAID_DEVIATION**2 * float(np.median(piece.variance))
        self._set_variance(known + (self.options.initial_error * np.maximum(arcs - end, 0.0)) ** 2)
        self._bank = NoiseBank.of(WINDOWS)
        self._rate[:] = 0.0
        return laid

    def _points(self, placed: list[PlacedPiece], nodes: Points, problems: list[str]) -> MeasuredPoints | None:
        """Return the points of all pieces on the thread."""
        found = []
        for piece in placed:
            place, innovation = piece.projected(nodes)
            good = np.isfinite(place)
            far = good & (np.abs(innovation) > 0.5)
            if far.any() and len(self._formulation.workspace.shapes):
                at = np.minimum(place[far].astype(np.int64), len(nodes) - 2)
                part = (place[far] - at)[:, None]
                start = (1.0 - part) * nodes[at] + part * nodes[at + 1]
                margin = 0.5 * self.thread.diameter
                parted = through_obstacle(
                    start * self._unit, piece.points[far] * self._unit, self._formulation.workspace, margin
                )
                if parted.any():
                    problems.append(f"{int(parted.sum())} points lie beyond an obstacle")
                    good[np.flatnonzero(far)[parted]] = False
            if good.any():
                variance = self._scale * piece.variance[good]
                found.append((place[good], innovation[good], variance, piece.share[good]))
        if not found:
            return None
        return MeasuredPoints(*(np.ascontiguousarray(np.concatenate(each)) for each in zip(*found, strict=True)))

    def _free_end(self, placed: list[PlacedPiece], nodes: Points) -> tuple[float, float]:
        """Return by how much farther along the thread its free end is seen, and the variance of it."""
        for piece in placed:
            if piece.free_end:
                along = nodes[-1] - nodes[-2]
                off = (piece.points[-1] - nodes[-1]) @ along / math.hypot(*along)
                deviation = 0.005 * self.thread.segments  # a thread's length is known to half a percent
                if abs(off) < 6.0 * (deviation + math.sqrt(float(self._variance[-1]))):
                    return float(off), deviation**2 + float(piece.variance[-1])
        return 0.0, math.inf

    def _corrected(
        self,
        points: MeasuredPoints,
        end: tuple[float, float],
        pose: NeedlePose,
        state: ThreadState,
        problems: list[str],
    ) -> Estimate:
        unit, segments = self._unit, self.thread.segments
        weights = np.ones(len(points.place))
        elapsed = pose.stamp - self._measured_at
        innovations = self._learn(points, weights, elapsed if math.isfinite(elapsed) else 0.0)
        noise = np.empty(segments + 1)
        spread_to_nodes(self._intensity, segments + 1, noise)
        noise /= unit**2
        weigh(points, self._variance, weights, self._sums)
        self._memory.known[:] = self._known
        density = np.maximum(self._density, MIN_VARIANCE)
        start = np.ascontiguousarray(state.positions / unit)
        while True:
            code, solves, off, residuals = correct(
                (0, 1),
                self._formulation.rod,
                self._buffers,
                self._formulation.workspace.data,
                self._solver_buffers,
                self._memory,
                start,
                np.ascontiguousarray(pose.heading, dtype=np.float64),
                density,
                noise,
                self._length,
                self._stiffness,
                points,
                weights,
                end,
                RESIDUAL_TOLERANCE,
            )
            if code != NO_ROOM:
                break
            self._use(self._buffers.enlarged())
        if code != CORRECTED or off > 1.0:
            problems.append(f"the correction was not solved: residual {max(residuals):.1e}, off by {off:.1g}")
            return self._estimate(tuple(problems), innovations=innovations, points=len(weights))
        self._density, self._variance = density, np.empty(segments + 1)
        hidden = take_over(points, weights, self._memory, density, self._variance, self._applied)
        shift_errors(self._bank, self._applied * unit)
        self._rate += self._memory.moved * (unit / self.options.disturbance_time)
        self._test(pose.stamp)
        corrected = ThreadState(self._memory.about * unit, state.velocities, state.interval)
        self.predictor.continue_from(pose, corrected)
        self._converged = True
        self._unknown = False
        self._elapsed = elapsed if math.isfinite(elapsed) else 0.0
        self._learned_for += self._elapsed
        self._measured_at = pose.stamp
        return self._estimate(
            tuple(problems),
            corrected=True,
            innovations=innovations,
            residual=max(residuals),
            solves=solves,
            points=len(weights),
            hidden=hidden,
        )

    def _learn(self, points: MeasuredPoints, weights: Vector, elapsed: float) -> Innovations:
        """Test the innovations of each window, learn the noise from them, and grow the prior where it rose."""
        unit, segments, sums = self._unit, self.thread.segments, self._sums
        weigh(points, self._variance, weights, sums)
        mean, spread = sums.mean * unit, sums.spread * unit**2
        seen = np.isfinite(mean)
        expected = spread + sums.known * unit**2
        innovations = Innovations(mean, self._ratio * expected)
        if seen.any():
            self._ratio += self._share(elapsed, RATIO_MEMORY) * (float((mean**2 / expected)[seen].mean()) - self._ratio)
        self._learn_scale(mean, spread / self._scale, seen, elapsed)
        before = self._bank.intensity.copy()
        learn(self._bank, GRID, mean, spread, elapsed, self.options.memory)
        # Where the bank knows of an error that the last correction left, the noise was too low: as if it came at once.
        left, doubt = unexplained(self._bank)
        excess = np.where(seen, np.maximum(left**2 - SURE**2 * doubt, 0.0), 0.0)
        span = max(elapsed, MIN_INTERVAL)
        self._intensity = self._bank.intensity + excess / span
        spread_to_nodes(np.maximum(self._intensity, before), segments + 1, self._added)
        spread_to_nodes(before, segments + 1, self._work)
        extra = np.maximum(self._added - self._work, 0.0) * (span / unit**2)
        extra[0] = 0.0
        self._variance = self._variance + extra
        self._density = self._density + 2.0 * self._length * extra
        return innovations

    def _learn_scale(self, mean: Vector, variance: Vector, seen: NDArray[np.bool_], elapsed: float) -> None:
        """Learn by how much the points' variance is larger than told, from what changes between two frames.

        E (nu_k - nu_{k-1})^2 = 2 s r,    as errors of the model last, and those of two frames are independent
        """
        both = seen & np.isfinite(self._last_mean)
        if both.any():
            change = (mean - self._last_mean)[both] ** 2
            ratio = float(np.minimum(change / (variance + self._last_variance)[both], MAX_SCALE).mean())
            share = self._share(elapsed, SCALE_MEMORY)
            self._scale = min(max(self._scale + share * (ratio - self._scale), MIN_SCALE), MAX_SCALE)
        self._last_mean, self._last_variance = np.where(seen, mean, np.nan), variance

    def _share(self, elapsed: float, memory: float) -> float:
        """Return the share of a new value in a mean: of all values so far at first, later of those in a memory."""
        return min(elapsed / (min(self._learned_for, memory) + LEARNING_PRIOR), 1.0)

    def _decay_rate(self, interval: float) -> None:
        share = math.exp(-interval / self.options.disturbance_time)
        self._rate *= share
        self._rate_time = self._rate_time * share + interval

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
    ) -> Estimate:
        prediction, pose, state = self._prediction, self.predictor.pose, self.predictor.state
        assert prediction is not None
        assert pose is not None
        assert state is not None
        formulation, positions = self._formulation, state.positions
        # Where innovations are larger than expected, so are the errors that are left.
        scale = self._unit**2 * max(self._ratio, 1.0)
        if corrected:
            covariance = scale * self._memory.covariance
        else:
            along = np.gradient(positions, axis=0)
            normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.hypot(*along.T), 1e-12)[:, None]
            covariance = scale * self._variance[:, None, None] * normal[:, :, None] * normal[:, None, :]
        added = formulation.added.rows(positions)

        def compute_rows() -> list[BarrierRows]:
            return [*formulation.margins(positions, pose.heading), *added]

        return Estimate(
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
            noise=self._bank.intensity.copy(),
            disturbances=self._disturbances(),
            problems=problems,
            compute_rows=compute_rows,
            make_margins=self.predictor.margins_of,
        )

    def _test(self, stamp: float) -> None:
        """Test what the camera moved the thread by in the last moments, in each window.

        Corrections of a right model are a difference of two errors of the estimate; those that go on in one direction
        are of something that the model does not know.
        """
        self._significance = np.empty(WINDOWS)
        moved_apart(
            self._rate,
            self._memory.normals,
            self.options.disturbance_time,
            self._sums.spread * self._unit**2,
            self._significance,
        )
        largest = float(self._significance.max())
        if largest > FOUND:
            self._since = stamp if math.isnan(self._since) else self._since
        elif largest < LOST:
            self._since = math.nan

    def _disturbances(self) -> tuple[Disturbance, ...]:
        """Return the forces that explain what the camera moves the thread by, if it does so for long."""
        state, pose = self.predictor.state, self.predictor.pose
        assert state is not None
        assert pose is not None
        if not pose.stamp - self._since >= CONFIRMED * self.options.disturbance_time:
            return ()
        medium = self.thread.medium
        return (
            strongest(
                force_density(
                    self._rate,
                    state.positions,
                    medium.drag_across,
                    medium.drag_along,
                    self.thread.bending_stiffness * self._elapsed,
                ),
                state.positions,
                self._unit,
                float(self._significance.max()),
                self._since,
            ),
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
            self._formulation.memory(),
            self._density.copy(),
            self._variance.copy(),
            self._bank.copied(),
            self._measured_at,
            self._rate.copy(),
            self._rate_time,
            (self._gross, self._unknown),
            self._since,
            (self._scale, self._ratio, self._elapsed, self._learned_for),
            self._last_mean,
            self._last_variance,
            self._significance,
        )

    def restore(self, kept: FilterState) -> None:
        """Go back to a snapshot; what follows is the same again to the last bit."""
        self.predictor.continue_from(kept.pose, kept.thread)
        self._prediction, self._converged = kept.prediction, kept.converged
        self._formulation.restore(kept.memory)
        self._density, self._variance = kept.density.copy(), kept.variance.copy()
        self._bank, self._measured_at = kept.bank.copied(), kept.measured_at
        self._rate, self._rate_time = kept.rate.copy(), kept.rate_time
        (self._gross, self._unknown), self._since = kept.gross, kept.since
        self._scale, self._ratio, self._elapsed, self._learned_for = kept.scale
        self._last_mean, self._last_variance = kept.last_mean, kept.last_variance
        self._significance = kept.significance
