"""Streaming estimation: poses and observations in any order, late ones folded in at their stamps."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from magnetosuture_thread.arguments import checked_arguments
from magnetosuture_thread.errors import InvalidInputError, SolverError
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.model.estimator.estimate import FilterState, ThreadEstimate
from magnetosuture_thread.model.estimator.estimator import ThreadEstimator
from magnetosuture_thread.model.estimator.pieces import LENGTH_ERROR
from magnetosuture_thread.model.margins import Margins
from magnetosuture_thread.model.prediction import MAX_COORDINATE, NeedlePose, Prediction
from magnetosuture_thread.model.predictor import ThreadPredictor
from magnetosuture_thread.thread_observation import PieceEnd, ThreadObservation, ThreadPiece

MAX_LATENESS = 1.0  # s; a pose older by more than this is not late: time itself was set back
MAX_POSES = 400  # that are kept, however many come in the time for which history is kept
DOUBLED = "a second observation of the same frame"


@dataclass
class _Moment:
    """A pose, what was measured at it, and the state of the filter after both."""

    pose: NeedlePose
    observation: ThreadObservation | None = None
    after: FilterState | None = None


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
        self._estimator = estimator
        self._moments: deque[_Moment] = deque(maxlen=MAX_POSES)
        self._early: dict[float, ThreadObservation] = {}

    def reset(self) -> None:
        """Forget the thread."""
        self._estimator.reset()
        self._moments.clear()
        self._early.clear()

    def follow_on(self, other: EstimatorSession) -> None:
        """Continue from the estimate of another session, of another thread, scene or other options.

        Observations of frames before its last pose are too late from then on.
        """
        self.reset()
        self._early = dict(other._early)
        before, now = other._estimator, self._estimator
        now.predictor.added.first_time = before.predictor.added.first_time
        kept = before.snapshot()
        if kept is None:
            return
        moment = other._moments[-1]
        state = kept.resampled(before.thread, now.thread, now.options)
        if (before.thread, before.options.slow_parameters) != (now.thread, now.options.slow_parameters):
            state = replace(state, slow=now.learned)  # of a thread of which something else is told
        prediction = _carried_over(state, now.predictor)
        # What was learned of another thread, or of other parameters, says nothing of this one; and the multipliers of
        # other rows are no warm start.
        same = now.thread == before.thread and now.options.slow_parameters == before.options.slow_parameters
        slow, warm_start = kept.slow if same else now.learned, now.predictor.formulation.warm_start()
        now.restore(replace(state, prediction=prediction, warm_start=warm_start, slow=slow))
        self._moments.append(_Moment(moment.pose, moment.observation, now.snapshot()))

    def start(self, pose: NeedlePose, centreline: Points | None = None) -> EstimationResult:
        """Start from a shape that is given; without it, straight behind the needle."""
        self.reset()
        estimate = self._estimator.start(pose, centreline)
        self._moments.append(_Moment(pose, after=self._estimator.snapshot()))
        return EstimationResult(estimate, estimate)

    def on_pose(self, pose: NeedlePose) -> EstimationResult:
        """Follow the needle to its next pose; an observation of its frame that came before it is taken with it.

        The first pose starts the thread: from the observation of its frame, or straight behind the needle.
        """
        if self._moments and pose.stamp < self._moments[-1].pose.stamp - MAX_LATENESS:
            self.reset()
        moment = _Moment(pose, self._early.pop(pose.stamp, None))
        try:
            estimate = self._take(moment)
        except (InvalidInputError, SolverError) as error:
            return EstimationResult(None, problem=error)
        self._moments.append(moment)
        while self._moments[0].pose.stamp < pose.stamp - self._estimator.options.history:
            self._moments.popleft()
        latest = pose.stamp + self._estimator.options.history
        problem = self._too_early(max(self._early)).problem if any(stamp > latest for stamp in self._early) else None
        self._early = {stamp: early for stamp, early in self._early.items() if pose.stamp < stamp <= latest}
        return EstimationResult(estimate, estimate, problem)

    def on_observation(self, stamp: float, observation: ThreadObservation) -> EstimationResult:
        """Take what a frame shows of the thread, at the pose of that frame.

        An observation of a frame whose pose has not come yet waits for it. One that is of long after the last pose is a
        problem, but waits too, as poses may have come to a stop; it is refused once a pose says that they have not. One
        that is older than what is kept, of a frame without a pose, or of one that was observed already, is refused.
        """
        if not np.isfinite(stamp):
            return self._refused(stamp, "a finite time [s]")
        last = self._moments[-1].pose.stamp if self._moments else -np.inf
        if stamp > last:
            self._early[stamp] = observation
            while len(self._early) > MAX_POSES:
                del self._early[min(self._early)]
            if self._moments and stamp > last + self._estimator.options.history:
                return self._too_early(stamp)
            return EstimationResult(None, waits=True)
        index = next((k for k, moment in enumerate(self._moments) if moment.pose.stamp == stamp), None)
        if index is None:
            return self._refused(stamp, "the stamp of a pose that is kept")
        if self._moments[index].observation is not None:
            return self._refused(stamp, f"no {DOUBLED}")
        before = self._moments[index - 1].after if index > 0 else None
        if index == 0 and self._moments[0].after is None:
            return self._refused(stamp, "a pose that was stepped to")
        self._moments[index].observation = observation
        return self._fold_in(index, before)

    def _fold_in(self, index: int, before: FilterState | None) -> EstimationResult:
        """Take a moment and all after it again."""
        measured: ThreadEstimate | None = None
        estimate: ThreadEstimate | None = None
        if before is None:
            # The oldest moment that is kept: its own step cannot be taken again, but be corrected after it.
            first = self._moments[index]
            assert first.after is not None
            assert first.observation is not None
            self._estimator.restore(first.after)
            measured = estimate = self._estimator.correct(first.observation)
            first.after = self._estimator.snapshot()
        else:
            self._estimator.restore(before)
            measured = estimate = self._take(self._moments[index])
        problem = None
        for later in list(self._moments)[index + 1 :]:
            try:
                estimate = self._take(later)
            except (InvalidInputError, SolverError) as error:
                problem = error
        return EstimationResult(estimate, measured, problem)

    def _take(self, moment: _Moment) -> ThreadEstimate:
        if not self._estimator.started:
            estimate = self._estimator.start(moment.pose)
            if moment.observation is not None:
                estimate = self._estimator.correct(moment.observation)
        else:
            estimate = self._estimator.step(moment.pose, moment.observation)
        moment.after = self._estimator.snapshot()
        return estimate

    def _too_early(self, stamp: float) -> EstimationResult:
        expected = f"at most {self._estimator.options.history:g} s after the last pose"
        return replace(self._refused(stamp, expected), waits=True)

    def _refused(self, stamp: float, expected: str) -> EstimationResult:
        return EstimationResult(None, problem=InvalidInputError("thread observation stamp", stamp, expected))


def _carried_over(state: FilterState, predictor: ThreadPredictor) -> Prediction:
    """Return the step that led to a state, as one of the predictor that goes on from there; it keeps no other alive."""
    formulation, positions, heading = predictor.formulation, state.thread.positions, state.pose.heading
    version = predictor.scene_version
    along = np.diff(positions, axis=0)
    return replace(
        state.prediction,
        scene_version=version,
        positions=positions,
        strain=np.hypot(*along.T) / formulation.rest_lengths(positions, heading) - 1.0,
        compute_margins=lambda: Margins.of(
            formulation.margins(positions, heading),
            predictor.contact_tolerance,
            version,
        ),
        compute_forces=lambda: None,
    )


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
