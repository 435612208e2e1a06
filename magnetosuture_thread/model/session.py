"""Streaming thread prediction from needle poses and measured centrelines; the core of the node `thread_model`."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import InvalidInputError, SolverError
from magnetosuture_thread.geometry.obstacles import Disc, Polygon, Workspace
from magnetosuture_thread.geometry.polyline import Points, lay_behind_needle
from magnetosuture_thread.model.margins import FrictionLaw, Margins
from magnetosuture_thread.model.predictor import MAX_COORDINATE, NeedlePose, Prediction
from magnetosuture_thread.model.settings import ThreadModelSettings
from magnetosuture_thread.model.thread import Thread
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.thread_observation import ThreadObservation

MAX_WAITING_POSES = 30  # poses that may wait for the centreline of their frame
MAX_LATENESS = 1_000_000_000  # ns; a pose older by more than this is not late: time itself was set back
PARTIAL_WAIT = 1_000_000_000  # ns; for all of the thread to be seen, before the rest of a part is extrapolated
WAITING = "waiting for the thread to be seen"
_OBSTACLES = (Disc((0.0, 0.0), 1e-3), Polygon(((0.0, 0.0), (1e-3, 0.0), (0.0, 1e-3))))  # one of each kind


@dataclass(frozen=True)
class PredictionResult:
    """What came of one needle pose.

    Attributes:
        stamp: of the pose [ns].
        prediction: of the thread; None where there is none.
        problem: why there is none; None while the thread is waited for.
        scene_version: of the scene in force; empty where there is none.
        law: of friction.
        speeds: of each node, shape (n + 1,) [m/s]; empty where there is no prediction.
    """

    stamp: int
    prediction: Prediction | None = None
    problem: InvalidInputError | SolverError | None = None
    scene_version: str = ""
    law: FrictionLaw | None = field(default=None, repr=False, compare=False)
    speeds: NDArray[np.float64] = field(default_factory=lambda: np.empty(0), repr=False, compare=False)

    @cached_property
    def margins(self) -> Margins | None:
        """All margins, with the friction; None where they prove nothing, as the step did not converge."""
        if self.prediction is None or self.law is None or not self.prediction.converged:
            return None
        margins = self.prediction.margins
        return margins.with_friction(self.law.classify(margins, self.speeds))

    @property
    def waiting(self) -> bool:
        """Whether the pose waits for the first measured thread."""
        return self.prediction is None and self.problem is None


class InitialObservation:
    """Chooses the observation from which a thread starts.

    Half of a thread looks like a shorter one. So a thread starts from the first observation that is complete. If there
    was none for `PARTIAL_WAIT` of the frames' time since a part was first seen, it starts from the piece that leaves
    the needle.
    """

    def __init__(self) -> None:
        self._first_part: int | None = None  # stamp of the first part since the last start [ns]

    def reset(self) -> None:
        """Forget the parts that were seen."""
        self._first_part = None

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
            if self._first_part is None or stamp < self._first_part:
                self._first_part = stamp
            if stamp - self._first_part < PARTIAL_WAIT:
                return None
        self._first_part = None
        return points


class ThreadSession:
    """Predicts the thread over one run: starts from its first measured centreline, then follows the poses.

    The node `thread_model` and the replay without a graph are both a shell around this, so that the same poses
    give the same predictions to the last bit.

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
        self._predictor = settings.predictor(scene)
        # Obstacles may come later, and no callback shall wait for the compiler of what they need.
        Workspace(_OBSTACLES, settings.margin_range)
        self._seen: tuple[int, Points] | None = None
        self._early: deque[tuple[int, NeedlePose]] = deque(maxlen=MAX_WAITING_POSES)
        self._last: int | None = None
        self._initial_observation = InitialObservation()
        self._motion = settings.node_motion()

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
        predictor, motion = settings.predictor(scene), settings.node_motion()

        def put_in_force() -> None:
            predictor.follow_on(self._predictor)
            motion.follow_on(self._motion)
            self.settings, self.scene, self._predictor, self._motion = settings, scene, predictor, motion

        return put_in_force

    def change(self, settings: ThreadModelSettings, scene: Scene | None) -> None:
        """Change settings or scene, keeping the thread's state.

        Raises:
            ConfigurationError: they cannot be used; those before stay in force.
        """
        self.prepare(settings, scene)()

    def needs_measured_thread(self, stamp: int) -> bool:
        """Return whether a measured thread of this stamp [ns] is needed; most are not."""
        if self.settings.initial_shape != "measured":
            return False
        return not self._predictor.started or self._last is None or stamp < self._last - MAX_LATENESS

    def on_measured_thread(self, stamp: int, centreline: Points) -> Iterator[PredictionResult]:
        """Start from a thread that the camera measured.

        Args:
            stamp: of the frame [ns].
            centreline: from the needle's tail on, shape (m, d) [m].

        Returns:
            What comes of the poses that waited for it, each worked out when it is asked for.
        """
        if not self.needs_measured_thread(stamp):
            return iter(())
        self._seen = (stamp, centreline)
        # The pose of the same frame may have come first, and others after it.
        early = [(at, pose) for at, pose in self._early if at >= stamp]
        self._early.clear()
        return (self.on_pose(at, pose) for at, pose in early)

    def on_observation(self, stamp: int, observation: ThreadObservation) -> Iterator[PredictionResult]:
        """Start from what the camera sees of the thread: from all of it, or after a while from a part.

        See `InitialObservation`; what is missing of a part goes on straight, see `ThreadPredictor.start`.

        Args:
            stamp: of the frame [ns].
            observation: of the thread.

        Returns:
            See `on_measured_thread`.
        """
        if not self.needs_measured_thread(stamp):
            return iter(())
        points = self._initial_observation.shape(stamp, observation)
        if points is None:
            return iter(())
        return self.on_measured_thread(stamp, points)

    def on_pose(self, stamp: int, pose: NeedlePose) -> PredictionResult:
        """Follow the needle to a pose.

        Args:
            stamp: of the frame [ns]; `pose.stamp` is the same in seconds.
            pose: as tracked; where the thread is fixed to it, `attachment_offset` says.
        """
        if self._last is not None and stamp < self._last - MAX_LATENESS:
            self._predictor.reset()
            self._last = None
            self._initial_observation.reset()
            self._early.clear()
            if self._seen is not None and self._seen[0] > stamp:
                self._seen = None  # of the time before it was set back
        try:
            attached = self.settings.attachment_pose(pose)
            if self._predictor.started:
                prediction = self._predictor.step(attached)
            elif (centreline := self._initial_shape(stamp, pose, attached)) is not None:
                prediction = self._predictor.start(attached, centreline)
            else:
                self._early.append((stamp, pose))
                return PredictionResult(stamp, scene_version=self.scene_version)
        except (InvalidInputError, SolverError) as error:
            return PredictionResult(stamp, problem=error, scene_version=self.scene_version)
        self._last = stamp
        speeds = self._motion.update(prediction.positions, prediction.interval)
        law = self.settings.friction_law()
        return PredictionResult(stamp, prediction, scene_version=self.scene_version, law=law, speeds=speeds)

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
