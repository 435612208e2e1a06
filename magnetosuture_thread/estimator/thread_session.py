"""Streaming prediction and estimation from poses and observations; the core of the node `thread_model`."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from magnetosuture_thread.estimator.estimator import ThreadEstimate, observation_of
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.geometry.polyline import Points, Vector, lay_behind_needle
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.geometry.thread_observation import ThreadObservation
from magnetosuture_thread.settings.errors import InvalidInputError, SolverError
from magnetosuture_thread.thread.margins import FrictionLaw, Margins, NodeMotion
from magnetosuture_thread.thread.material import Thread
from magnetosuture_thread.thread.prediction import MAX_COORDINATE, NeedleMotion, NeedlePose, Prediction, check_pose

MAX_WAITING_POSES = 30  # poses that may wait for the centreline of their frame
MAX_LATENESS = 1_000_000_000  # ns; a pose older by more than this is not late: time itself was set back
PARTIAL_WAIT = 1_000_000_000  # ns; for all of the thread to be seen, before the rest of a part is extrapolated
WAITING = "waiting for the thread to be seen"
MANEUVER = 16.0  # normalized square of three innovations, of which a motion without a change of mind exceeds 0.1 %
UNKNOWN_MOTION = np.diag((0.01, 0.01, 3.0)) ** 2  # variances of a velocity of which nothing is known [m/s], [rad/s]
NOISE_RATES = np.array((1.5e-3, 1.5e-3, 0.2)) ** 2
"""Of the random walks of the velocity, as tracked needles move in closed loop [m^2/s^3], and of turning [rad^2/s^3]."""


@dataclass(frozen=True)
class PredictionResult:
    """What came of one needle pose, or of an observation that came after the pose of its frame.

    Attributes:
        stamp: of the pose [ns].
        pose: of the needle, with what the poses before say of it; None of a late observation.
        prediction: of the thread by the model alone; None where there is none.
        problem: why there is none; None while the thread is waited for.
        estimate: the thread by model and camera; None until the camera has measured the thread, and where thread or
            settings are not for the estimator.
        estimate_problem: why there is none, or why an observation was refused; None if nothing is wrong.
        late: whether an observation came after the pose of this stamp. There is no new prediction then, and the
            estimate takes the place of the one before.
        scene_version: of the scene in force; empty where there is none.
        law: of friction.
        speeds: of each node of the estimate, else of the prediction, shape (n + 1,) [m/s]; empty where there is none.
    """

    stamp: int
    pose: NeedlePose | None = field(default=None, repr=False, compare=False)
    prediction: Prediction | None = None
    problem: InvalidInputError | SolverError | None = None
    estimate: ThreadEstimate | None = None
    estimate_problem: InvalidInputError | SolverError | None = None
    late: bool = False
    scene_version: str = ""
    law: FrictionLaw | None = field(default=None, repr=False, compare=False)
    speeds: Vector = field(default_factory=lambda: np.empty(0), repr=False, compare=False)

    @cached_property
    def margins(self) -> Margins | None:
        """All margins, with the friction; None where they prove nothing, as the step did not converge.

        Of the estimate where there is one, with their bounds; else of the prediction.
        """
        thread = self.prediction if self.estimate is None else self.estimate
        if thread is None or self.law is None or not thread.converged:
            return None
        margins = thread.margins
        return replace(margins, friction=self.law.classify(margins, self.speeds))

    @property
    def reason(self) -> str:
        """Why there are no margins; the solver's word where there are."""
        if self.estimate is not None:
            return "" if self.estimate.converged else "the estimate is not where the barriers hold"
        if self.prediction is not None:
            return self.prediction.status
        return WAITING if self.problem is None else str(self.problem)

    @property
    def refused(self) -> InvalidInputError | None:
        """Why the pose is refused, so that there is neither prediction nor estimate of it; None where it is not."""
        return self.problem if isinstance(self.problem, InvalidInputError) and self.estimate is None else None

    @property
    def waiting(self) -> bool:
        """Whether the pose waits for the first measured thread."""
        return self.prediction is None and self.problem is None and not self.late


class InitialObservation:
    """Chooses the observation from which a thread starts.

    Half of a thread looks like a shorter one. So a thread starts from the first observation that is complete. If there
    was none for `PARTIAL_WAIT` of the frames' time since a part was first seen, it starts from the piece that leaves
    the needle.
    """

    def __init__(self) -> None:
        self._first_part = math.inf  # stamp of the first part since the last start [ns]

    def shape(self, stamp: int, observation: ThreadObservation) -> Points | None:
        """Return the shape to start from.

        Args:
            stamp: of the frame [ns].
            observation: of the thread.

        Returns:
            Points from the needle's tail on, shape (m, 2) [m]; None where the thread does not start from this frame.
        """
        points = observation.from_tail
        if points is None:
            return None
        if not observation.complete:
            self._first_part = min(self._first_part, stamp)
            if stamp - self._first_part < PARTIAL_WAIT:
                return None
        self._first_part = math.inf
        return points


class NeedleMotionFilter:
    """Estimates pose and velocity of a needle from poses with known deviations, in the plane.

    The state is tail, angle of the heading, velocity of the tail along the heading and across it, and rate of turning.
    Velocities are random walks in the needle's own frame, so that a needle on a circle has a constant one:

        x' = v_1 t + v_2 n,    theta' = omega,    v', omega' = white noise

    Differences of poses have too much noise: with 10 um at 60 Hz it is 0.8 mm/s. Where a pose is farther from the
    prediction than `MANEUVER`, the needle has changed its motion, and its velocity is taken anew from then on.

    Source: Bar-Shalom, Li and Kirubarajan 2001, extended Kalman filter with white-noise acceleration and maneuver
    detection. Deviation: the velocity is in the needle's frame.
    """

    def __init__(self) -> None:
        self._state, self._covariance = np.zeros(6), np.zeros((6, 6))
        self._stamp = -math.inf

    def update(self, pose: NeedlePose) -> NeedlePose:
        """Return a measured pose with what the poses before say of it, and its motion.

        One whose deviations are not known, that is the first for a while, or not later than the last, is returned as
        it is.

        Args:
            pose: finite, in the plane, with a unit heading.
        """
        interval, (place, angle) = pose.stamp - self._stamp, pose.deviation
        if interval <= 0.0:
            return pose
        known = 0.0 < place < math.inf and 0.0 < angle < math.inf
        self._stamp = pose.stamp if known else -math.inf
        measured = np.array([*pose.tail, math.atan2(pose.heading[1], pose.heading[0])])
        variances = np.diag((place**2, place**2, angle**2))
        state, before = self._state, self._covariance
        # Between poses more than 0.2 s apart nothing is known of the motion.
        if not known or interval > 0.2:
            state[:3], state[3:], before[:] = measured, 0.0, 0.0
            before[:3, :3], before[3:, 3:] = variances, UNKNOWN_MOTION
            return pose
        # It moves by the velocity in the middle of the interval, in which the noise is added.
        middle = float(state[2] + 0.5 * interval * state[5])
        c, s = math.cos(middle), math.sin(middle)
        turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        x, y, turning = turned @ state[3:]
        state[:3] += interval * x, interval * y, interval * turning
        move, half = np.eye(6), np.vstack([0.5 * interval * turned, np.eye(3)])
        move[:3, 3:] = interval * turned
        move[:2, 2] = -interval * y, interval * x
        move[:2, 5] = 0.5 * interval * move[:2, 2]
        noise = (half * interval * NOISE_RATES) @ half.T
        covariance = move @ before @ move.T + noise
        innovation = measured - state[:3]
        innovation[2] = math.remainder(innovation[2], 2.0 * math.pi)
        inverse = np.linalg.inv(covariance[:3, :3] + variances)
        if innovation @ inverse @ innovation > MANEUVER:
            before[3:, :], before[:, 3:] = 0.0, 0.0
            before[3:, 3:] = UNKNOWN_MOTION
            covariance = move @ before @ move.T + noise
            inverse = np.linalg.inv(covariance[:3, :3] + variances)
        gain = covariance[:, :3] @ inverse
        state += gain @ innovation
        before[:] = covariance - gain @ covariance[:3, :]
        c, s = math.cos(state[2]), math.sin(state[2])
        along, across, turning = state[3:].tolist()
        deviation = math.sqrt(0.5 * (before[0, 0] + before[1, 1])), math.sqrt(before[2, 2])
        motion = NeedleMotion(np.array([along * c - across * s, along * s + across * c]), turning)
        return replace(pose, tail=state[:2].copy(), heading=np.array([c, s]), deviation=deviation, motion=motion)


class ThreadSession:
    """Predicts and estimates the thread over one run.

    The prediction starts from the first measured centreline, and follows the poses alone after. The estimate, by an
    estimator with a predictor of its own, is corrected by every observation; see `EstimatorSession`. The node
    `thread_model` and the replay without a graph are both a shell around this, so that the same poses and
    observations give the same predictions and estimates to the last bit.

    Args:
        settings: of thread and liquid.
        scene: dish and obstacles; None while nobody knows them, and then there is neither wall nor obstacle.

    Attributes:
        settings: in force.
        scene: in force.

    Raises:
        ConfigurationError: a shape of the scene cannot be used.
    """

    def __init__(self, settings: ThreadModelSettings, scene: Scene | None) -> None:
        self.settings, self.scene = settings, scene
        self.reset()

    def reset(self) -> None:
        """Forget the thread, as if nothing had come yet; settings and scene stay in force."""
        settings, scene = self.settings, self.scene
        self._predictor = settings.predictor(scene)
        self._first = math.inf  # stamp of the first pose [s]
        self._motion = NodeMotion(settings.friction_averaging)
        self._start_over()
        self._estimator = settings.estimator_session(scene)
        self._last_pose: int | None = None  # stamp of the last pose of the estimate [ns]
        self._late_estimates: list[PredictionResult] = []
        self._measured = False  # whether the camera ever measured the thread that is estimated
        self._estimate_motion = NodeMotion(settings.friction_averaging)
        self._motion_before = self._estimate_motion  # the estimate's, before its last pose

    def _start_over(self) -> None:
        """Let the prediction wait for the first measured thread."""
        self._predictor.reset()
        self._last: int | None = None  # stamp of the last pose of the prediction [ns]
        self._seen: tuple[int, Points] | None = None
        self._early: deque[tuple[int, NeedlePose]] = deque(maxlen=MAX_WAITING_POSES)
        self._needle_motion, self._initial_observation = NeedleMotionFilter(), InitialObservation()

    @property
    def thread(self) -> Thread:
        """The thread that is predicted."""
        return self._predictor.thread

    @property
    def scene_version(self) -> str:
        """Version of the scene in force; empty where there is none."""
        return self.scene.version if self.scene is not None else ""

    def prepare(self, settings: ThreadModelSettings, scene: Scene | None) -> Callable[[], None]:
        """Build what other settings or another scene need, and return what puts them in force, which cannot fail.

        The prediction then goes on from where the thread is and as it moves; what appears upon it pushes it out. That
        takes some milliseconds, and with an outline of a thousand corners a tenth of a second.

        Raises:
            ConfigurationError: they cannot be used.
        """
        if settings == self.settings and scene == self.scene:
            return lambda: None
        predictor, estimator = settings.predictor(scene), settings.estimator_session(scene)

        def put_in_force() -> None:
            predictor.follow_on(self._predictor)
            if estimator is not None and self._estimator is not None:
                estimator.follow_on(self._estimator)
            for motion in (self._motion, self._estimate_motion, self._motion_before):
                motion.averaging = settings.friction_averaging
            self.settings, self.scene, self._predictor, self._estimator = settings, scene, predictor, estimator
            self._measured = self._measured and estimator is not None

        return put_in_force

    def change(self, settings: ThreadModelSettings, scene: Scene | None) -> None:
        """Change settings or scene, keeping the thread's state.

        Raises:
            ConfigurationError: they cannot be used; those before stay in force.
        """
        self.prepare(settings, scene)()

    @property
    def estimates(self) -> bool:
        """Whether the thread is estimated too, and every observation of it needed."""
        return self._estimator is not None

    def needs_measured_thread(self, stamp: int) -> bool:
        """Return whether the prediction needs a measured thread of this stamp [ns] to start from; most are not."""
        if self.settings.initial_shape != "measured":
            return False
        return not self._predictor.started or self._last is None or stamp < self._last - MAX_LATENESS

    def on_measured_thread(self, stamp: int, centreline: Points) -> Iterator[PredictionResult]:
        """Take a thread that the camera measured: whole, or a part from the needle on.

        Args:
            stamp: of the frame [ns].
            centreline: from the needle's tail on, shape (m, 2) [m].

        Returns:
            What comes of the poses that waited for it, each worked out when it is asked for. What comes of the
            estimate is returned by `late_estimates`, if the pose of the frame came before, else by `on_pose`.
        """
        deviation, length = self.settings.estimator_path_deviation, self.settings.thread_length
        self._correct(stamp, observation_of(centreline, length, deviation))
        return self._start_from(stamp, centreline)

    def _start_from(self, stamp: int, centreline: Points) -> Iterator[PredictionResult]:
        if not self.needs_measured_thread(stamp):
            return iter(())
        self._seen = (stamp, centreline)
        # The pose of the same frame may have come first, and others after it.
        early = [(at, pose) for at, pose in self._early if at >= stamp]
        self._early.clear()
        return (self._follow(at, pose) for at, pose in early)

    def on_observation(self, stamp: int, observation: ThreadObservation) -> Iterator[PredictionResult]:
        """Take what the camera sees of the thread.

        The prediction starts from all of it, or after a while from a part, see `InitialObservation`; what is missing
        of a part goes on straight, see `ThreadPredictor.start`.

        Args:
            stamp: of the frame [ns].
            observation: of the thread.

        Returns:
            See `on_measured_thread`.
        """
        self._correct(stamp, observation)
        points = self._initial_observation.shape(stamp, observation) if self.needs_measured_thread(stamp) else None
        return iter(()) if points is None else self._start_from(stamp, points)

    def late_estimates(self) -> list[PredictionResult]:
        """Return, once, what came of observations that came after the poses of their frames, or were refused.

        Of each observation the estimate at its stamp, and the one at the last pose.
        """
        late, self._late_estimates = self._late_estimates, []
        return late

    def _correct(self, stamp: int, observation: ThreadObservation) -> None:
        """Correct the estimate by an observation; one that comes before the pose of its frame waits for that."""
        if self._estimator is None:
            return
        if self.settings.attachment_offset:
            observation = observation.measured_from(-self.settings.attachment_offset[0])
        found = self._estimator.on_observation(stamp * 1e-9, observation)
        if found.measured is not None and found.estimate is not None and self._last_pose is not None:
            self._measured = self._measured or math.isfinite(found.estimate.unmeasured_for)
            # As if the observation had come before the last pose.
            self._estimate_motion = copy(self._motion_before)
            self._estimate_motion.update(found.estimate.positions, found.estimate.prediction.interval)
            for at, estimate in {stamp: found.measured, self._last_pose: found.estimate}.items():
                known, speeds = math.isfinite(estimate.unmeasured_for), self._estimate_motion.speeds
                self._late_estimates.append(
                    self._result(at, late=True, estimate=estimate if known else None, speeds=speeds)
                )
        if found.problem is not None and not found.waits:
            self._late_estimates.append(self._result(stamp, late=True, estimate_problem=found.problem))

    def _result(self, stamp: int, pose: NeedlePose | None = None, **values: Any) -> PredictionResult:
        law = self.settings.friction_law()
        return PredictionResult(stamp, pose, scene_version=self.scene_version, law=law, **values)

    def on_pose(self, stamp: int, pose: NeedlePose) -> PredictionResult:
        """Follow the needle to a pose.

        Args:
            stamp: of the frame [ns]; `pose.stamp` is the same in seconds.
            pose: as tracked; where the thread is fixed to it, `attachment_offset` says.
        """
        return self.estimate(self.predict(stamp, pose))

    def estimate(self, result: PredictionResult) -> PredictionResult:
        """Add the estimate to the prediction of a pose; the second half of `on_pose`."""
        if self._estimator is None or result.pose is None:
            return result
        attached = self.settings.attachment_pose(result.pose)
        found = self._estimator.on_pose(attached)
        if isinstance(found.problem, SolverError) and not self._measured:
            # The thread has been laid straight behind the needle, where a shape or the wall may be; begin anew here.
            self._estimator.reset()
            found = self._estimator.on_pose(attached)
        if found.estimate is None:
            return replace(result, estimate_problem=found.problem)
        self._last_pose = result.stamp
        self._motion_before = copy(self._estimate_motion)
        speeds = self._estimate_motion.update(found.estimate.positions, found.estimate.prediction.interval)
        self._measured = math.isfinite(found.estimate.unmeasured_for)
        if not self._measured:
            return replace(result, estimate_problem=found.problem)
        return replace(result, estimate=found.estimate, estimate_problem=found.problem, speeds=speeds)

    def predict(self, stamp: int, pose: NeedlePose) -> PredictionResult:
        """Return what the model alone says of a pose; the first half of `on_pose`.

        A pose with deviations is filtered by those before, and its velocity is that of the forces.
        """
        if self._last is not None and stamp < self._last - MAX_LATENESS:
            seen = self._seen
            self._start_over()
            if seen is not None and seen[0] <= stamp:  # else of the time before it was set back
                self._seen = seen
        try:
            check_pose(pose, self._predictor.reach)
        except InvalidInputError as error:
            return self._result(stamp, pose, problem=error)
        self._first = self._predictor.added.first_time = min(self._first, pose.stamp)
        return self._follow(stamp, self._needle_motion.update(pose))

    def _follow(self, stamp: int, pose: NeedlePose) -> PredictionResult:
        """Step the prediction to a filtered pose, or keep the pose until the thread is measured."""
        try:
            attached = self.settings.attachment_pose(pose)
            if self._predictor.started:
                prediction = self._predictor.step(attached)
            elif (centreline := self._initial_shape(stamp, pose, attached)) is not None:
                prediction = self._predictor.start(attached, centreline, strict=False)
            else:
                self._early.append((stamp, pose))
                return self._result(stamp, pose)
        except (InvalidInputError, SolverError) as error:
            return self._result(stamp, pose, problem=error)
        self._last = stamp
        speeds = self._motion.update(prediction.positions, prediction.interval)
        return self._result(stamp, pose, prediction=prediction, speeds=speeds)

    def _initial_shape(self, stamp: int, pose: NeedlePose, attached: NeedlePose) -> Points | None:
        if self.settings.initial_shape == "straight":
            radius = self.scene.dish.radius - 0.5 * self.thread.diameter if self.scene is not None else math.inf
            return lay_behind_needle(attached.tail, attached.heading, self.thread.length, radius)
        if self._seen is None or self._seen[0] != stamp:
            return None
        centreline = self._seen[1]
        if attached is pose or len(centreline) < 2 or not np.all(np.abs(centreline) <= MAX_COORDINATE):
            return centreline
        # What is between the tail and where the thread is fixed belongs to the needle. How far the seen thread begins
        # from the tail goes on to the predictor, which refuses one that is not this needle's.
        nearest = int(np.linalg.norm(centreline - attached.tail, axis=1).argmin())
        return np.vstack([centreline[:1] + (attached.tail - pose.tail), centreline[nearest + 1 :]])
