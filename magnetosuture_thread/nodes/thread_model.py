"""The node `thread_model`: predicts the thread from the needle poses of the tracker."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped

from magnetosuture_thread import InvalidInputError, MagnetosutureError, NeedlePose, Prediction, Scene
from magnetosuture_thread.configuration import configuration_fields
from magnetosuture_thread.messages import reading
from magnetosuture_thread.messages.cdr import header_stamp, time_of
from magnetosuture_thread.messages.packing import packed_margins, packed_markers, packed_prediction
from magnetosuture_thread.model.predictor import STARTED
from magnetosuture_thread.model.program import SOLVED
from magnetosuture_thread.model.session import WAITING, PredictionResult, ThreadSession
from magnetosuture_thread.model.settings import FIXED, ThreadModelSettings, parse_material
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.diagnostics import Health
from magnetosuture_thread.nodes.node import PackageNode
from magnetosuture_thread.nodes.parameter_files import node_options
from magnetosuture_thread.nodes.parameters import Changeable, declare
from magnetosuture_thread.nodes.run import run
from magnetosuture_thread.nodes.scene_follower import SceneFollower, initial_scene
from magnetosuture_thread.thread_observation import ThreadObservation


class ThreadSettings:
    """Changes a session's settings by the node's parameters.

    A message becomes parameters, so that these always tell what is in force, and there is one way to refuse.

    Args:
        node: has the session's settings declared as its parameters.
        session: whose settings they are.
        health: where a message is said to be refused; who calls a service is told.
    """

    def __init__(self, node: PackageNode, session: ThreadSession, health: Health) -> None:
        self._node, self._session, self._health = node, session, health
        self._names = [about.name for about in configuration_fields(ThreadModelSettings)]
        self._parameters = Changeable(node, session.settings, self._prepare)
        topics.MATERIAL.subscribe(node, self.on_material, raw=True, unheard=health.refuse)

    def on_material(self, data: bytes) -> None:
        """Apply a ThreadMaterial message, or report why it is refused."""
        try:
            self._parameters.set(parse_material(topics.MATERIAL.decode(data)))
        except MagnetosutureError as error:
            self._health.refuse(error)

    def _prepare(self, settings: ThreadModelSettings) -> Callable[[], None]:
        put_in_force = self._session.prepare(settings, self._session.scene)

        def change() -> None:
            before = self._session.settings
            put_in_force()
            changed = [name for name in self._names if getattr(settings, name) != getattr(before, name)]
            if changed:
                self._node.get_logger().info(f"changed: {', '.join(changed)}")

        return change


class ThreadModelNode(PackageNode):
    """Predicts the thread at every needle pose.

    Args:
        listens: whether poses and observations of the thread come by topics; else a tracker in the same process
            hands them over.
        options: for rclpy's node.
    """

    def __init__(self, *, listens: bool = True, **options: Any) -> None:
        super().__init__("thread_model", **node_options("thread_model", options))
        settings = declare(self, ThreadModelSettings, read_only=False, fixed=FIXED)
        self.get_logger().info("loading the model's kernels; the first start on a machine compiles them")
        scene = initial_scene(settings.scene)
        self._session = ThreadSession(settings, scene)
        self._scene = SceneFollower(self, self.health, scene, self.on_scene)
        self._settings = ThreadSettings(self, self._session, self.health)
        self._predicted = topics.PREDICTED_THREAD.publisher(self)
        self._margins = topics.MARGINS.publisher(self)
        self._markers = topics.THREAD_MARKERS.publisher(self)
        self._observed = False
        if listens:
            self.listen()
        self.health.warn("no needle pose yet")
        where = f"{len(scene.shapes)} shapes in a dish" if scene is not None else "no scene yet"
        self.get_logger().info(
            f"ready: {settings.segments} segments of {settings.material}, {where}, "
            f"{settings.formulation} by {settings.solver}"
        )

    def listen(self) -> None:
        """Subscribe to needle poses and to what is seen of the thread."""
        topics.THREAD_OBSERVATION.subscribe(self, self.on_observation_message, raw=True)
        topics.MEASURED_THREAD.subscribe(self, self.on_measured_thread_message, raw=True)
        topics.NEEDLE_POSE.subscribe(self, self.on_pose)

    def on_scene(self, scene: Scene) -> None:
        """Change the scene; one that the thread's segments do not resolve raises `ConfigurationError`."""
        self._session.change(self._session.settings, scene)

    def on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Step the thread to a needle pose, or report why that is impossible.

        No margin is published that is not proven.
        """
        self._step(message.header.stamp, lambda: reading.needle_pose(message))

    def on_tracked(self, stamp: Time, tail: np.ndarray, heading: np.ndarray) -> None:
        """Handle a pose handed over by a tracker in the same process, as its message would be."""
        self._step(stamp, lambda: reading.tracked_pose(stamp, tail, heading))

    def _step(self, stamp: Time, pose: Callable[[], NeedlePose]) -> None:
        began = time.perf_counter()
        try:
            outcome = self._session.on_pose(reading.nanoseconds(stamp), pose())
        except InvalidInputError as error:
            self.health.refuse(error)
            return
        self._report(outcome, time.perf_counter() - began)

    def on_measured_thread_message(self, data: bytes) -> None:
        """Start from a centreline, where no tracker tells whether it is all of the thread, as in older bags.

        Most are not needed, and to read a path of a hundred poses takes as long as some predictions: so
        only the stamp is read of those.
        """
        name = self.resolve_topic_name(topics.THREAD_OBSERVATION.name)
        self._observed = self._observed or self.count_publishers(name) > 0
        if not self._observed:
            self._take(data, topics.MEASURED_THREAD, reading.path_points, self._session.on_measured_thread)

    def on_observation_message(self, data: bytes) -> None:
        """Start from what the camera sees of the thread; as above, most are not read."""
        self._observed = True
        self._take(data, topics.THREAD_OBSERVATION, reading.thread_observation, self._session.on_observation)

    def _take(self, data: bytes, topic: topics.Topic, read: Callable[[Any], Any], start: Callable[..., Any]) -> None:
        stamp = header_stamp(data) or 0
        if self._session.needs_measured_thread(stamp):
            try:
                self._start(start(stamp, read(topic.decode(data))))
            except InvalidInputError as error:
                self.health.refuse(error)

    def on_observation(self, stamp: Time, observation: ThreadObservation) -> None:
        """Handle an observation of the thread handed over by a tracker in the same process."""
        self._start(self._session.on_observation(reading.nanoseconds(stamp), observation))

    def _start(self, outcomes: Iterator[PredictionResult]) -> None:
        began = time.perf_counter()
        for outcome in outcomes:
            self._report(outcome, time.perf_counter() - began)
            began = time.perf_counter()

    def _report(self, outcome: PredictionResult, step_time: float) -> None:
        """Publish the result of a pose, or why there is none."""
        if outcome.prediction is not None:
            self._publish(outcome, outcome.prediction, step_time)
        elif isinstance(outcome.problem, InvalidInputError):
            self.health.refuse(outcome.problem)
        else:
            problem = WAITING if outcome.problem is None else str(outcome.problem)
            (self.health.warn if outcome.problem is None else self.health.error)(problem)
            packed = packed_margins(time_of(outcome.stamp), None, problem, outcome.scene_version)
            self._margins.publish(packed)

    def _publish(self, outcome: PredictionResult, prediction: Prediction, step_time: float) -> None:
        when, settings, version = time_of(outcome.stamp), self._session.settings, outcome.scene_version
        # The prediction first: it is waited for, and the margins are only worked out here.
        self._predicted.publish(packed_prediction(when, prediction, settings.material, step_time=step_time))
        margins = outcome.margins
        reason = "" if margins else prediction.status
        self._margins.publish(packed_margins(when, margins, reason, version))
        if self._markers.get_subscription_count():
            self._markers.publish(packed_markers(when, prediction, margins, self._session.thread.diameter))
        figures = {"residual": f"{prediction.residual:.1e}", "step_time": f"{step_time * 1e6:.0f} us"}
        if prediction.status in (SOLVED, STARTED):
            self.health.ok("predicting", **figures)
        else:
            self.health.warn(f"predicting, but {prediction.status}", **figures)


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(ThreadModelNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
