"""Streaming estimation: poses and observations in any order, late ones folded in at their stamps."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from magnetosuture_thread.estimator.association import LENGTH_ERROR
from magnetosuture_thread.estimator.estimator import Snapshot, ThreadEstimate, ThreadEstimator
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.settings.configuration import checked_arguments
from magnetosuture_thread.settings.errors import InvalidInputError, SolverError
from magnetosuture_thread.thread.prediction import MAX_COORDINATE, NeedlePose

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
        if not np.isfinite(stamp):
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
