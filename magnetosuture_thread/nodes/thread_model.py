"""The thread model node: needle poses in, predicted thread and safety margins out."""

from __future__ import annotations

import sys
import time
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.model.friction import UNKNOWN
from magnetosuture_thread.model.margins import Margins
from magnetosuture_thread.model.predictor import STARTED, Prediction
from magnetosuture_thread.model.program import SOLVED
from magnetosuture_thread.model.session import WAITING, Outcome, ThreadSession
from magnetosuture_thread.model.settings import FIXED, ThreadModelSettings
from magnetosuture_thread.nodes import messages, thread_messages, topics
from magnetosuture_thread.nodes.diagnostics import Health
from magnetosuture_thread.nodes.parameters import declare
from magnetosuture_thread.nodes.run import run
from magnetosuture_thread.nodes.scene_follower import SceneFollower
from magnetosuture_thread.nodes.thread_settings import ThreadSettings
from magnetosuture_thread.scene import Scene


class ThreadModelNode(Node):
    """Predicts the thread at every needle pose."""

    def __init__(self, **options: Any) -> None:
        super().__init__("thread_model", automatically_declare_parameters_from_overrides=True, **options)
        settings = declare(self, ThreadModelSettings, read_only=False, fixed=FIXED)
        self.get_logger().info("loading the model's kernels; the first start on a machine compiles them")
        self._health = Health(self)
        self._scene = SceneFollower(self, settings.scene, self._health)
        self._session = ThreadSession(settings, self._scene.scene)
        self._settings = ThreadSettings(self, self._session, self._health)
        self._predicted = topics.PREDICTED_THREAD.publisher(self)
        self._margins = topics.MARGINS.publisher(self)
        self._markers = topics.THREAD_MARKERS.publisher(self)
        topics.SEEN_THREAD.subscribe(self, self.on_seen_thread, raw=True)
        topics.NEEDLE_POSE.subscribe(self, self.on_pose)
        self._scene.follow(self.on_scene)
        self._health.warn("no needle pose yet")
        scene = self._session.scene
        where = f"{len(scene.shapes)} shapes in a dish" if scene is not None else "no scene yet"
        self.get_logger().info(
            f"ready: {settings.segments} segments of {settings.material}, {where}, "
            f"{settings.formulation} by {settings.solver}"
        )

    def on_scene(self, scene: Scene) -> None:
        """Go on in another scene; one that the thread's segments do not resolve raises `ConfigurationError`."""
        self._session.change(self._session.settings, scene)

    def on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Step the thread to a needle pose; where that cannot be done, say so.

        No margin is published that is not proven.
        """
        stamp = messages.nanoseconds(message.header.stamp)
        began = time.perf_counter()
        try:
            outcome = self._session.on_pose(stamp, messages.needle_pose(message))
        except InvalidInputError as error:
            self._health.refuse(error)
            return
        self._tell(outcome, time.perf_counter() - began)

    def on_seen_thread(self, data: bytes) -> None:
        """Keep the thread that the camera sees, to start from.

        Most are not needed, and to read a path of a hundred poses takes as long as some predictions: so
        only the stamp is read of those.
        """
        stamp = messages.header_stamp(data) or 0
        if not self._session.wants_seen(stamp):
            return
        try:
            centreline = messages.path_points(thread_messages.decoded(topics.SEEN_THREAD, data))
        except InvalidInputError as error:
            self._health.refuse(error)
            return
        began = time.perf_counter()
        for outcome in self._session.on_seen(stamp, centreline):
            self._tell(outcome, time.perf_counter() - began)
            began = time.perf_counter()

    def _tell(self, outcome: Outcome, step_time: float) -> None:
        """Publish what came of a pose."""
        stamp = messages.stamp_of(outcome.stamp)
        if outcome.prediction is not None:
            self._publish(stamp, outcome.prediction, outcome.margins, step_time)
        elif isinstance(outcome.problem, InvalidInputError):
            self._health.refuse(outcome.problem)
        elif outcome.problem is not None:
            self._health.error(str(outcome.problem))
            self._margins.publish(thread_messages.invalid_margins(stamp, str(outcome.problem), outcome.scene_version))
        else:
            self._health.warn(WAITING)
            self._margins.publish(thread_messages.invalid_margins(stamp, WAITING, outcome.scene_version))

    def _publish(self, stamp: Time, prediction: Prediction, margins: Margins | None, step_time: float) -> None:
        settings = self._session.settings
        self._predicted.publish(thread_messages.prediction_message(stamp, prediction, settings.material, step_time))
        if margins is None:
            self._margins.publish(thread_messages.invalid_margins(stamp, prediction.status, prediction.scene_version))
        else:
            self._margins.publish(thread_messages.margins_message(stamp, margins))
        friction = margins.friction if margins else UNKNOWN
        diameter = self._session.thread.diameter
        self._markers.publish(thread_messages.thread_markers(stamp, prediction, friction, diameter))
        figures = {"residual": f"{prediction.residual:.1e}", "step_time": f"{step_time * 1e6:.0f} us"}
        if prediction.status in (SOLVED, STARTED):
            self._health.ok("predicting", **figures)
        else:
            self._health.warn(f"predicting, but {prediction.status}", **figures)


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(ThreadModelNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
