"""The thread model node: needle poses in, predicted thread and safety margins out."""

from __future__ import annotations

import sys
import time
from collections import deque
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path
from rclpy.node import Node
from rclpy.serialization import deserialize_message

from magnetosuture_thread.errors import InvalidInputError, SolverError
from magnetosuture_thread.model.predictor import STARTED, NeedlePose, Prediction
from magnetosuture_thread.model.program import SOLVED
from magnetosuture_thread.model.settings import ThreadModelSettings
from magnetosuture_thread.nodes import messages, topics
from magnetosuture_thread.nodes.diagnostics import Health
from magnetosuture_thread.nodes.parameters import declare
from magnetosuture_thread.nodes.run import run

EARLY = 30  # poses that may wait for the centreline of their frame
REPLAYED = 1.0  # s; a pose older by more than this is not late: time itself was set back


class ThreadModelNode(Node):
    """Predicts the thread at every needle pose."""

    def __init__(self, **options: Any) -> None:
        super().__init__("thread_model", automatically_declare_parameters_from_overrides=True, **options)
        self._settings = declare(self, ThreadModelSettings)
        self._thread = self._settings.thread()
        self.get_logger().info("loading the model's kernels; the first start on a machine compiles them")
        self._predictor = self._settings.predictor()
        self._health = Health(self)
        self._seen: tuple[float, np.ndarray] | None = None
        self._early: deque[PoseWithCovarianceStamped] = deque(maxlen=EARLY)
        self._last = -np.inf
        self._predicted = topics.PREDICTED_THREAD.publisher(self)
        self._margins = topics.MARGINS.publisher(self)
        self._markers = topics.THREAD_MARKERS.publisher(self)
        obstacles = topics.OBSTACLE_MARKERS.publisher(self)
        obstacles.publish(messages.obstacle_markers(self.get_clock().now().to_msg(), self._settings.obstacles()))
        topics.SEEN_THREAD.subscribe(self, self.on_seen_thread, raw=True)
        topics.NEEDLE_POSE.subscribe(self, self.on_pose)
        self._health.warn("no needle pose yet")
        self.get_logger().info(
            f"ready: {self._settings.segments} segments of {self._settings.material}, "
            f"{len(self._settings.obstacles())} obstacles, {self._settings.formulation} by {self._settings.solver}"
        )

    def on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Step the thread to a needle pose; where that cannot be done, say so.

        No margin is published that is not proven.
        """
        stamp = message.header.stamp
        began = time.perf_counter()
        try:
            prediction = self._follow(message)
        except InvalidInputError as error:
            self._health.refuse(error)
            return
        except SolverError as error:
            self._health.error(str(error))
            self._margins.publish(messages.invalid_margins(stamp, str(error)))
            return
        if prediction is not None:
            self._publish(message, prediction, time.perf_counter() - began)

    def on_seen_thread(self, data: bytes) -> None:
        """Keep the thread that the camera sees, to start from.

        Most are not needed, and to read a path of a hundred poses takes as long as some predictions: so
        only the stamp is read of those.
        """
        if self._settings.initial_shape != "seen":
            return
        stamp = (messages.header_stamp(data) or 0) * 1e-9
        if self._predictor.started and stamp >= self._last - REPLAYED:
            return
        try:
            self._seen = (stamp, messages.path_points(deserialize_message(data, Path)))
        except InvalidInputError as error:
            self._health.refuse(error)
            return
        # The pose of the same frame may have come first, and others after it.
        while self._early and messages.seconds(self._early[0].header.stamp) < self._seen[0]:
            self._early.popleft()
        early = list(self._early)
        self._early.clear()
        for pose in early:
            self.on_pose(pose)

    def _follow(self, message: PoseWithCovarianceStamped) -> Prediction | None:
        pose = messages.needle_pose(message)
        if pose.stamp < self._last - REPLAYED:
            self._predictor.reset()
            self._last = -np.inf
            self._early.clear()
            if self._seen is not None and self._seen[0] > pose.stamp:
                self._seen = None  # of the time before it was set back
        if self._predictor.started:
            prediction = self._predictor.step(pose)
        else:
            centreline = self._initial_shape(pose)
            if centreline is None:
                self._early.append(message)
                reason = "waiting for the thread to be seen"
                self._health.warn(reason)
                self._margins.publish(messages.invalid_margins(message.header.stamp, reason))
                return None
            prediction = self._predictor.start(pose, centreline)
        self._last = pose.stamp
        return prediction

    def _initial_shape(self, pose: NeedlePose) -> np.ndarray | None:
        if self._settings.initial_shape == "straight":
            return np.array([pose.tail, pose.tail - self._thread.length * pose.heading])
        if self._seen is None or self._seen[0] != pose.stamp:
            return None
        return self._seen[1]

    def _publish(self, message: PoseWithCovarianceStamped, prediction: Prediction, step_time: float) -> None:
        stamp, settings = message.header.stamp, self._settings
        self._predicted.publish(messages.prediction_message(stamp, prediction, settings.material, step_time))
        if prediction.converged:
            margins = messages.margins_message(stamp, prediction, settings.contact_tolerance)
        else:
            margins = messages.invalid_margins(stamp, prediction.status)
        self._margins.publish(margins)
        self._markers.publish(messages.thread_markers(stamp, prediction, self._thread.diameter))
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
