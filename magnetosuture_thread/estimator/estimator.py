"""The estimator: the predictor's steps along the needle's poses, each corrected by what the camera measures.

A session takes poses and observations in any order; late ones are folded in at their stamps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.estimator import association, noise
from magnetosuture_thread.estimator.association import LENGTH_ERROR
from magnetosuture_thread.estimator.correction import Correction, Corrector, Prior, normals_of
from magnetosuture_thread.estimator.disturbance import Disturbance, DisturbanceTest
from magnetosuture_thread.estimator.noise import Innovations, NoiseModel
from magnetosuture_thread.geometry.polyline import Points, Table, Vector, arc_lengths, chain_inside
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.settings.configuration import bounded, checked_arguments, plain
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError, SolverError
from magnetosuture_thread.thread.margins import SOLID, BarrierMargins, Margins
from magnetosuture_thread.thread.prediction import MAX_COORDINATE, TIME, NeedlePose, Prediction
from magnetosuture_thread.thread.predictor import ThreadPredictor
from magnetosuture_thread.thread.rod import RodFormulation
from magnetosuture_thread.thread.step import ThreadState, WarmStart

ONE_SIDED_99 = 2.3263478740408408  # standard deviations
LAID_DEVIATION = 5.0  # of the shape laid along a piece, in those of its points


@checked_arguments("estimator")
@dataclass(frozen=True)
class EstimatorOptions:
    """What a laboratory may choose of the estimator.

    Attributes:
        history: how late an observation may come [s].

    Raises:
        ConfigurationError: it is out of bounds.
    """

    history: Annotated[float, bounded("s", 1e-3, 1e5)] = 1.0


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
        points: number of points that were measured and placed on the thread.
        hidden: part of the thread that no point shows.
        innovations: None without a measurement.
        noise: intensity of the process noise in each window, shape (w,) [m^2/s].
        disturbances: what the model does not know.
        problems: why pieces or the whole observation were refused.
        compute_margins: at its positions.
    """

    prediction: Prediction
    positions: Points
    covariance: Table
    deviation: Vector
    corrected: bool
    unmeasured_for: float
    converged: bool
    residual: float
    points: int
    hidden: float
    innovations: Innovations | None
    noise: Vector
    disturbances: tuple[Disturbance, ...]
    problems: tuple[str, ...]
    compute_margins: Callable[[], Margins] = field(repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        """Return everything computed, for `copy` and `pickle`."""
        return {**self.__dict__, "margins": self.margins, "compute_margins": None}

    @property
    def stamp(self) -> float:
        """Of the needle's pose [s]."""
        return self.prediction.stamp

    @cached_property
    def margins(self) -> Margins:
        """The margins of every barrier by its name with their bounds, of its positions; computed at first access."""
        return self.compute_margins()


def clearance_bound(
    nodes: NDArray[Any], gradient: Table, clearance: Vector, covariance: Points, neighbours: bool = False
) -> Vector:
    """Return the one-sided 99 % bound of each margin of a barrier as a distance [m].

        clearance - 2.33 sum_k (g_k' C_k g_k)^(1/2) / |g|

    with the covariances C_k of the nodes that the row depends on, taken as fully correlated. Of obstacles and wall
    the clearance is that of the half segments beside a node too, and the greatest deviation along g of the node
    and its neighbours counts: that of a point between two nodes is not greater.

    Args:
        nodes: that each row depends on, shape (m, k).
        gradient: g_k of each row, shape (m, k, 2).
        clearance: of each row, shape (m,) [m].
        covariance: of each node, shape (n + 1, 2, 2) [m^2].
        neighbours: whether the clearance is that of the half segments beside a node too.
    """
    deviation = np.zeros(len(clearance))
    for apart in (-1, 0, 1) if neighbours else (0,):
        near = covariance[np.clip(nodes.astype(np.int64) + apart, 0, len(covariance) - 1)]
        square = np.einsum("rka,rkab,rkb->rk", gradient, near, gradient)
        deviation = np.maximum(deviation, np.sqrt(np.maximum(square, 0.0)).sum(axis=1))
    slope = np.sqrt(np.einsum("rkd,rkd->r", gradient, gradient))
    return np.asarray(clearance - ONE_SIDED_99 * deviation / np.where(slope > 0.0, slope, 1.0))


@dataclass(frozen=True)
class FilterState:
    """What the next step and correction depend on, besides the predictor. It is replaced and never written to.

    Attributes:
        errors: variance and density of each node, see `noise`, shape (2, n + 1) [D^2].
        noise: what is learned of the noise.
        test: for disturbances.
        measured_at: stamp of the last measurement, -inf before the first [s].
        gross: number of frames in a row that showed the thread somewhere else.
        unknown: whether nobody has seen the thread's shape.
        converged: whether the barriers themselves hold.
        prediction: the last step.
    """

    errors: Points
    noise: NoiseModel
    test: DisturbanceTest
    measured_at: float = -math.inf
    gross: int = 0
    unknown: bool = True
    converged: bool = False
    prediction: Prediction | None = None


Snapshot = tuple[FilterState, NeedlePose | None, ThreadState | None, WarmStart]
"""Everything that the next step depends on: of the filter, predictor and formulation."""


class ThreadEstimator:
    """Estimates a thread from the needle's poses and what the camera measures of the thread.

        estimator = ThreadEstimator(predictor)
        estimator.start(pose)                          # shape unknown: straight behind the needle
        estimate = estimator.step(next_pose, observation)

    Without observations its positions are those of the predictor to the last bit.

    Args:
        predictor: steps the thread; formulation `rod`, in the plane. The estimator moves its state.
        options: what may be chosen.

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
        self._formulation, self._unit = formulation, self.thread.segment_length
        # The model's errors are alike over a tenth of the length.
        self._length = max(0.1 * self.thread.segments, 0.5)  # l [D]
        self._corrector = Corrector(predictor, formulation)
        self._forget()

    def _forget(self) -> None:
        errors = np.zeros((2, self.thread.segments + 1))
        self._now = FilterState(errors, NoiseModel.new(), DisturbanceTest(self.thread))

    @property
    def started(self) -> bool:
        """Whether the thread has a shape."""
        return self.predictor.started

    def warm_up(self) -> None:
        """Compile everything, so that no callback waits for it."""
        self.predictor.warm_up()
        path = np.array([[0.0, 0.0], [-self.thread.length, 0.0]])
        points = np.linspace(path[0], path[1], 50)
        points[10, 1] = self.thread.length  # an outlier
        piece = ThreadPiece(points, np.full(50, 1e-5), PieceEnd.TAIL, PieceEnd.FREE, (0.0, 0.0), False)
        pose = NeedlePose(0.0, np.zeros(2), np.array([1.0, 0.0]))
        self.start(pose, path)
        self.step(replace(pose, stamp=0.01), ThreadObservation((piece,), True))
        self.reset()
        self.predictor.added.first_time = math.inf

    def reset(self) -> None:
        """Forget the thread; the next call must be `start`."""
        self.predictor.reset()
        self._forget()

    def start(self, pose: NeedlePose, centreline: Points | None = None) -> ThreadEstimate:
        """Set the thread's shape.

        Args:
            pose: the needle.
            centreline: measured, from the needle's tail on, shape (m, 2) [m]; it may end early. None is a thread that
                lies straight behind the needle, of which nothing is known.

        Raises:
            InvalidInputError: see `ThreadPredictor.start`.
        """
        prediction = self.predictor.start(pose, centreline, strict=False)
        seen, known = 0.0, 0.0
        if centreline is not None:
            seen, known = float(arc_lengths(centreline)[-1]), LAID_DEVIATION * association.MIN_DEVIATION
        self._forget()
        self._now = replace(
            self._now,
            prediction=prediction,
            converged=prediction.converged,
            unknown=centreline is None,
            errors=self._errors_of(seen / self._unit, (known / self._unit) ** 2),
        )
        return self._estimate([])

    def _errors_of(self, seen: float, variance: float) -> Points:
        """Return the errors of a shape that is known up to an arc length [D] with a variance [D^2]."""
        beyond = np.maximum(np.arange(self.thread.segments + 1.0) - seen, 0.0)
        # The free end of a thread whose shape nobody has seen is off by 0.2 of its length (standard deviation).
        found = variance + (0.2 * beyond) ** 2
        found[0] = 0.0
        return np.array([found, 2.0 * self._length * found])

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
        before, now = self.predictor.state, self._now
        prediction, test = self.predictor.step(pose), copy(now.test)
        assert before is not None
        intensity = noise.at_nodes(now.noise.intensity, self.thread.segments + 1)
        intensity[0] = 0.0
        added = np.outer((1.0, 2.0 * self._length), intensity) * (prediction.interval / self._unit**2)
        errors = noise.propagate_errors(prediction.positions, before.positions, self._unit, added, now.errors)
        test.decay(prediction.interval, self._formulation.nodes_in_contact)
        self._now = replace(now, prediction=prediction, converged=prediction.converged, errors=errors, test=test)
        return self.correct(observation) if observation is not None else self._estimate([])

    def correct(self, observation: ThreadObservation) -> ThreadEstimate:
        """Correct the thread at the last pose by an observation of the same instant.

        Its points are associated with the thread, the correction is solved, and the noise updated by what is left. The
        result is kept in the end; where there is no solution, the thread stays where it was predicted.
        """
        state, pose = self.predictor.state, self.predictor.pose
        if state is None or pose is None:
            raise InvalidInputError("thread observation", "one before the start", "a centreline first")
        now, state, points, problems = self._associate(observation, state, pose)
        innovations, correction = None, None
        if points is not None:
            elapsed = pose.stamp - now.measured_at if math.isfinite(now.measured_at) else 0.0
            learned = noise.learn(now.noise, points, now.errors, self._unit, elapsed, 2.0 * self._length)
            now, innovations = replace(now, noise=learned[0], errors=learned[2]), learned[1]
            prior = self._prior(now, state, pose)
            correction = self._corrector.solve(prior, points)
            if correction.problem:
                problems, correction = [*problems, correction.problem], None
            else:
                now = self._updated(now, prior, points, correction, pose)
                state = ThreadState(correction.positions * self._unit, state.velocities, state.interval)
        self._now, self.predictor.state = now, state
        return self._estimate(problems, innovations, 0 if points is None else len(points.place), correction)

    def _associate(
        self, observation: ThreadObservation, state: ThreadState, pose: NeedlePose
    ) -> tuple[FilterState, ThreadState, association.MeasuredPoints | None, list[str]]:
        """Return filter and thread before the correction, the points on the thread, and why others are refused."""
        now, unit = self._now, self._unit
        placed, problems = association.place_pieces(observation, state.positions / unit, now.errors[0], unit)
        if placed:
            now, laid = self._laid_along(placed[0], pose, state)
            if laid is not state:
                state = laid
                placed, problems = association.place_pieces(observation, state.positions / unit, now.errors[0], unit)
        obstacles = self._formulation.workspace, 0.5 * self.thread.diameter
        points, refused = association.measured_points(
            placed, state.positions / unit, float(now.errors[0, -1]), now.noise.scale, unit, obstacles
        )
        return now, state, points, problems + refused

    def _updated(
        self,
        now: FilterState,
        prior: Prior,
        points: association.MeasuredPoints,
        correction: Correction,
        pose: NeedlePose,
    ) -> FilterState:
        """Return the filter after a correction."""
        normals, moved, unit, test = normals_of(prior.positions), correction.moved, self._unit, now.test
        errors, applied = noise.take_correction(points, normals, moved, correction.covariance, prior.density)
        if math.isfinite(now.measured_at):  # else there is no earlier time to compare with
            # What of a point's variance does not change from frame to frame is of the dish's place in the image: the
            # points of a window share it, and so do both times that the test compares: at least 0.4 of it.
            scale, sums = now.noise.scale, now.noise.sums
            variance = sums.own * (1.0 + 0.5 * max(1.0 - scale, 0.4) / scale * sums.independent) * unit**2
            test = copy(test)
            test.add(moved * unit, normals, variance, pose.stamp, np.asarray(pose.deviation))
        learned = now.noise._replace(error=now.noise.error - unit * applied[:, None])
        return replace(
            now, errors=errors, noise=learned, test=test, converged=True, unknown=False, measured_at=pose.stamp
        )

    def _prior(self, now: FilterState, state: ThreadState, pose: NeedlePose) -> Prior:
        unit, rod = self._unit, self._formulation.rod
        return Prior(
            np.ascontiguousarray(state.positions / unit),
            np.ascontiguousarray(pose.heading, dtype=np.float64),
            np.maximum(now.errors[1], 1e-12),
            noise.at_nodes(now.noise.raised, self.thread.segments + 1) / unit**2,
            self._length,
            rod.bending_stiffness / (rod.drag_across * unit**4),
        )

    def _laid_along(
        self, piece: association.PlacedPiece, pose: NeedlePose, state: ThreadState
    ) -> tuple[FilterState, ThreadState]:
        """Lay the thread along a piece that begins at the needle, if the estimate is nowhere near it.

        At once where the estimate is known to be as bad as that, or was never measured, else when a second frame says
        so too. What the piece does not show goes on as it lay.
        """
        now, unit, segments = self._now, self._unit, self.thread.segments
        # A piece that begins at the needle and lies more than 1.5 segments off gives the shape itself.
        if not piece.attached or (not now.unknown and piece.square < 1.5**2):
            return replace(now, gross=0), state
        gross, end = now.gross + 1, piece.start + float(piece.arcs[-1])
        prior = float(np.interp(0.5 * end, np.arange(segments + 1), now.errors[0]))
        measured = math.isfinite(now.measured_at)
        if not now.unknown and measured and gross < 2 and piece.square > 9.0 * prior:
            return replace(now, gross=gross), state
        seen = smoothed_line(piece.points, piece.arcs, 2.0 * association.POINT_CORRELATION / unit) * unit
        path = continued(np.vstack([pose.tail, seen[1:]]), state.positions, int(min(end, segments - 1.0)))
        radius = self._formulation.workspace.wall_radius - 0.5 * self.thread.diameter
        laid = ThreadState.at_rest(chain_inside(path, segments, unit, radius))
        # Whether it lies outside of obstacles is not known before it is corrected.
        now = replace(
            now,
            gross=0,
            unknown=False,
            converged=False,
            errors=self._errors_of(end, LAID_DEVIATION**2 * float(np.median(piece.variance))),
            noise=NoiseModel.new(),
            test=DisturbanceTest(self.thread),
        )
        return now, laid

    def _estimate(
        self,
        problems: Sequence[str],
        innovations: Innovations | None = None,
        points: int = 0,
        correction: Correction | None = None,
    ) -> ThreadEstimate:
        """Return the estimate; `correction` is None where the thread was not corrected."""
        now, pose, state, prediction = self._now, self.predictor.pose, self.predictor.state, self._now.prediction
        assert prediction is not None
        assert pose is not None
        assert state is not None
        formulation, positions, tolerance = self._formulation, state.positions, self.predictor.contact_tolerance
        # Where innovations are larger than expected, so are the errors that are left.
        scale = self._unit**2 * max(now.noise.ratio, 1.0)
        if correction is not None:
            covariance = scale * correction.covariance
        else:
            normal = normals_of(positions)
            covariance = scale * now.errors[0][:, None, None] * normal[:, :, None] * normal[:, None, :]
        # At once, as barriers may move on before they are asked again.
        added = formulation.added.rows_at(pose.stamp, positions, pose.heading)

        def compute_margins() -> Margins:
            margins = []
            for each in formulation.margins(positions, pose.heading):
                if each.barrier in SOLID:
                    rows = each.node[:, None], each.normal[:, None], each.clearance
                    each = replace(each, bound=clearance_bound(*rows, covariance, True))
                margins.append(each)
            for row in added:
                bound = clearance_bound(row.nodes, row.gradient, row.clearance, covariance)
                margins.append(replace(BarrierMargins.from_rows(row), bound=bound))
            return Margins.of(margins, tolerance, prediction.scene_version)

        return ThreadEstimate(
            prediction=prediction,
            positions=positions,
            covariance=covariance,
            deviation=np.sqrt(scale * np.maximum(now.errors[0], 0.0)),
            corrected=correction is not None,
            unmeasured_for=pose.stamp - now.measured_at,
            converged=now.converged,
            residual=0.0 if correction is None else correction.residual,
            points=points,
            hidden=1.0 if correction is None else correction.hidden,
            innovations=innovations,
            noise=now.noise.intensity,
            disturbances=now.test.found(pose.stamp, positions),
            problems=tuple(problems),
            compute_margins=compute_margins,
        )

    def snapshot(self) -> Snapshot:
        """Return everything that the next step depends on."""
        predictor = self.predictor
        return self._now, predictor.pose, predictor.state, self._formulation.warm_start()

    def restore(self, kept: Snapshot) -> None:
        """Go back to a snapshot of a thread that has started; what follows is the same again to the last bit."""
        self._now, self.predictor.pose, self.predictor.state, warm_start = kept
        self._formulation.restore(warm_start)

    def follow_on(self, other: ThreadEstimator) -> None:
        """Continue from the estimate of another thread, in another scene or with other options; a step comes next.

        What was added up for disturbances stays with the thread that it is of.
        """
        self.reset()
        self.predictor.follow_on(other.predictor)
        kept, old, new = other.snapshot()[0], other._unit, self._unit
        at, nodes = new * np.arange(self.thread.segments + 1), old * np.arange(other.thread.segments + 1)
        errors = (old / new) ** 2 * np.array([np.interp(at, nodes, each) for each in kept.errors])
        test = kept.test if self.thread == other.thread else self._now.test
        self._now = replace(kept, errors=errors, test=test, prediction=None)


def smoothed_line(points: Points, arcs: Vector, length: float) -> Points:
    """Return a path averaged over a length along it, by a normal distribution of that standard deviation."""
    apart = np.abs(arcs[:, None] - arcs[None, :])
    # Towards an end the average is taken over less, evenly to both sides, so that the end stays where it is.
    room = np.minimum(arcs, arcs[-1] - arcs)
    weights = np.exp(-0.5 * (apart / length) ** 2) * (apart <= room[:, None] + 1e-12)
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


MAX_POSES = 400  # that are kept, however many come in the time for which history is kept


@dataclass
class _Moment:
    """A pose, what was measured at it, and the state of the filter after both."""

    pose: NeedlePose
    observation: ThreadObservation | None
    after: Snapshot


@dataclass(frozen=True)
class EstimationResult:
    """What came of a pose or an observation.

    Attributes:
        estimate: at the last pose; None before the thread has a shape, or where a step was not solved.
        measured: at the observation's own stamp, where that came late; else the same as `estimate`.
        problem: why there is no estimate, or why an observation was refused; None if nothing is wrong.
        waits: whether the observation waits for the pose of its frame.
    """

    estimate: ThreadEstimate | None
    measured: ThreadEstimate | None = field(default=None, repr=False)
    problem: InvalidInputError | SolverError | None = None
    waits: bool = False


class EstimatorSession:
    """Estimates the thread over one run.

    A late observation is folded in at its stamp: the filter goes back to the pose of its frame and takes all later
    poses and observations again. So the estimate is, to the last bit, the one that would have been had it come in time.

    Args:
        estimator: warmed up.
    """

    @checked_arguments("estimator session")
    def __init__(self, estimator: ThreadEstimator) -> None:
        self._estimator, self._history = estimator, estimator.options.history
        self._moments: dict[float, _Moment] = {}  # by stamps, which rise
        self._early: dict[float, ThreadObservation] = {}

    def reset(self) -> None:
        """Forget the thread."""
        self._estimator.reset()
        self._moments.clear()
        self._early.clear()

    def follow_on(self, other: EstimatorSession) -> None:
        """Continue from the estimate of another session, of another thread, scene or other options.

        Observations of frames up to its last pose are too late from then on.
        """
        self.reset()
        self._early = dict(other._early)
        if other._estimator.started:
            self._estimator.follow_on(other._estimator)

    def start(self, pose: NeedlePose, centreline: Points | None = None) -> EstimationResult:
        """Start from a shape that is given; without it, straight behind the needle."""
        self.reset()
        estimate = self._estimator.start(pose, centreline)
        self._moments[pose.stamp] = _Moment(pose, None, self._estimator.snapshot())
        return EstimationResult(estimate, estimate)

    def on_pose(self, pose: NeedlePose) -> EstimationResult:
        """Follow the needle to its next pose; an observation of its frame that came before it is taken with it.

        The first pose starts the thread: from the observation of its frame, or straight behind the needle.
        """
        last = self._estimator.predictor.pose
        # Older by more than a second, it is not late: time itself was set back.
        if last is not None and pose.stamp < last.stamp - 1.0:
            self.reset()
        try:
            estimate = self._take(pose, self._early.pop(pose.stamp, None))
        except (InvalidInputError, SolverError) as error:
            return EstimationResult(None, problem=error)
        oldest = next(iter(self._moments))
        while oldest < pose.stamp - self._history or len(self._moments) > MAX_POSES:
            del self._moments[oldest]
            oldest = next(iter(self._moments))
        latest = pose.stamp + self._history
        too_early = [stamp for stamp in self._early if stamp > latest]
        self._early = {stamp: early for stamp, early in self._early.items() if pose.stamp < stamp <= latest}
        return EstimationResult(estimate, estimate, self._too_early(too_early[0]) if too_early else None)

    def on_observation(self, stamp: float, observation: ThreadObservation) -> EstimationResult:
        """Take what a frame shows of the thread, at the pose of that frame.

        An observation of a frame whose pose has not come yet waits for it. One that is of long after the last pose is a
        problem, but waits too, as poses may have come to a stop; it is refused once a pose says that they have not. One
        that is older than what is kept, of a frame without a pose, or of one that was observed already, is refused.
        """
        stamp = plain(stamp)
        if not TIME.within(stamp):
            return EstimationResult(None, problem=_refusal(stamp, "a finite time [s]"))
        last = self._estimator.predictor.pose
        if last is None or stamp > last.stamp:
            self._early[stamp] = observation
            while len(self._early) > MAX_POSES:
                del self._early[min(self._early)]
            early = last is not None and stamp > last.stamp + self._history
            return EstimationResult(None, problem=self._too_early(stamp) if early else None, waits=True)
        moment, problem = self._moments.get(stamp), None
        if moment is None:
            return EstimationResult(None, problem=_refusal(stamp, "the stamp of a pose that is kept"))
        if moment.observation is not None:
            return EstimationResult(None, problem=_refusal(stamp, "no second observation of the same frame"))
        self._estimator.restore(moment.after)
        estimate = measured = self._estimator.correct(observation)
        moment.observation, moment.after = observation, self._estimator.snapshot()
        for later in [self._moments.pop(at) for at in list(self._moments) if at > stamp]:
            try:
                estimate = self._take(later.pose, later.observation)
            except (InvalidInputError, SolverError) as error:
                problem = error
        return EstimationResult(estimate, measured, problem)

    def _take(self, pose: NeedlePose, observation: ThreadObservation | None) -> ThreadEstimate:
        """Step or start the thread, and keep the state after it."""
        if self._estimator.started:
            estimate = self._estimator.step(pose, observation)
        elif observation is not None:
            estimate = self._estimator.start_observed(pose, observation)
        else:
            estimate = self._estimator.start(pose)
        self._moments[pose.stamp] = _Moment(pose, observation, self._estimator.snapshot())
        return estimate

    def _too_early(self, stamp: float) -> InvalidInputError:
        return _refusal(stamp, f"at most {self._history:g} s after the last pose")


def _refusal(stamp: float, expected: str) -> InvalidInputError:
    return InvalidInputError("thread observation stamp", stamp, expected)


def observation_of(centreline: Points, length: float, deviation: float) -> ThreadObservation:
    """Return an observation of a measured centreline, from the needle's tail on, which may end early.

    A centreline alone does not say whether it is all of the thread. It is taken for a part unless it is as long as the
    thread, within twice the error to which the length is known: a part that is taken for all would pull the free end to
    where the measurement ends.

    Args:
        centreline: shape (m, 2) [m]; points that are not finite are left out.
        length: of the thread [m].
        deviation: of each point across it [m].
    """
    points = np.asarray(centreline, dtype=np.float64).reshape(-1, 2)
    fit = len(points) > 1 and bool(np.all(np.abs(points) <= MAX_COORDINATE))  # another is refused by the estimator
    along = float(arc_lengths(points)[-1]) if fit else 0.0
    complete = along > (1.0 - 2.0 * LENGTH_ERROR) * length
    last = PieceEnd.FREE if complete else PieceEnd.UNKNOWN
    piece = ThreadPiece(points, np.full(len(points), deviation), PieceEnd.TAIL, last, (0.0, 0.0))
    return ThreadObservation((piece,), complete)
