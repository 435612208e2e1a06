"""The node `thread_model`: predicts the thread from needle poses, and estimates it by what the camera sees of it."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped

from magnetosuture_thread import InvalidInputError, NeedlePose, Scene
from magnetosuture_thread.messages import reading
from magnetosuture_thread.messages.cdr import header_stamp, time_of
from magnetosuture_thread.messages.markers import packed_markers
from magnetosuture_thread.messages.packing import packed_estimate, packed_margins, packed_prediction
from magnetosuture_thread.model.session import PredictionResult, ThreadSession
from magnetosuture_thread.model.settings import FIXED, ThreadModelSettings
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.node import PackageNode
from magnetosuture_thread.nodes.parameter_files import node_options
from magnetosuture_thread.nodes.parameters import declare
from magnetosuture_thread.nodes.run import run
from magnetosuture_thread.nodes.scene_follower import SceneFollower, initial_scene
from magnetosuture_thread.nodes.thread_forecast import ThreadForecasts
from magnetosuture_thread.nodes.thread_health import ThreadHealth
from magnetosuture_thread.nodes.thread_settings import ThreadSettings
from magnetosuture_thread.thread_observation import ThreadObservation


class ThreadModelNode(PackageNode):
    """Predicts and estimates the thread at every needle pose.

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
        self._states = ThreadHealth(self.health)
        self._settings = ThreadSettings(self, self._session, self.health)
        self._predicted = topics.PREDICTED_THREAD.publisher(self)
        self._estimated = topics.ESTIMATED_THREAD.publisher(self)
        self._margins = topics.MARGINS.publisher(self)
        self._markers = topics.THREAD_MARKERS.publisher(self)
        self._forecasts = ThreadForecasts(self, self._session) if settings.forecast_horizon > 0.0 else None
        self._observed = False
        self._last_margins = 0  # stamp of those that were published [ns]
        if listens:
            self.listen()
        self.health.warn("no needle pose yet")
        where = f"{len(scene.shapes)} shapes in a dish" if scene is not None else "no scene yet"
        self.get_logger().info(
            f"ready: {settings.segments} segments of {settings.material}, {where}, "
            f"{settings.formulation} by {settings.solver}"
        )

    def destroy_node(self) -> None:
        """Leave the graph, once no forecast is being made."""
        if self._forecasts is not None:
            self._forecasts.close()
        super().destroy_node()

    def listen(self) -> None:
        """Subscribe to needle poses and to what is seen of the thread."""
        topics.THREAD_OBSERVATION.subscribe(self, self.on_observation_message, raw=True)
        topics.MEASURED_THREAD.subscribe(self, self.on_measured_thread_message, raw=True)
        topics.NEEDLE_POSE.subscribe(self, self.on_pose)

    def on_scene(self, scene: Scene) -> None:
        """Change the scene; one that the thread's segments do not resolve raises `ConfigurationError`."""
        self._session.change(self._session.settings, scene)

    def on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Step the thread to a needle pose, or report why that is impossible."""
        self._step(message.header.stamp, lambda: reading.needle_pose(message))

    def on_tracked(self, stamp: Time, tail: np.ndarray, heading: np.ndarray, covariance: np.ndarray) -> None:
        """Handle a pose handed over by a tracker in the same process, as its message would be."""
        self._step(stamp, lambda: reading.tracked_pose(stamp, tail, heading, covariance))

    def _step(self, stamp: Time, pose: Callable[[], NeedlePose]) -> None:
        began = time.perf_counter()
        try:
            read = pose()
        except InvalidInputError as error:
            self.health.refuse(error)
            return
        result = self._session.predict(reading.nanoseconds(stamp), read)
        step_time = time.perf_counter() - began
        self._publish_prediction(result, step_time)  # at once, as it is waited for
        result = self._session.estimate(result)
        self._report(result, step_time)
        if self._forecasts is not None:
            self._forecasts.request(result, read)

    def on_measured_thread_message(self, data: bytes) -> None:
        """Take a centreline, where no tracker tells whether it is all of the thread, as in older bags.

        Where the thread is not estimated most are not needed, and to read a path of a hundred poses takes as long as
        some predictions: so only the stamp is read of those.
        """
        name = self.resolve_topic_name(topics.THREAD_OBSERVATION.name)
        self._observed = self._observed or self.count_publishers(name) > 0
        if not self._observed:
            self._take(data, topics.MEASURED_THREAD, reading.path_points, self._session.on_measured_thread)

    def on_observation_message(self, data: bytes) -> None:
        """Take what the camera sees of the thread; as above, it may not be needed."""
        self._observed = True
        self._take(data, topics.THREAD_OBSERVATION, reading.thread_observation, self._session.on_observation)

    def _take(self, data: bytes, topic: topics.Topic, read: Callable[[Any], Any], take: Callable[..., Any]) -> None:
        stamp = header_stamp(data) or 0
        if self._session.estimates or self._session.needs_measured_thread(stamp):
            try:
                self._report_all(take(stamp, read(topic.decode(data))))
            except InvalidInputError as error:
                self.health.refuse(error)

    def on_observation(self, stamp: Time, observation: ThreadObservation) -> None:
        """Handle an observation of the thread handed over by a tracker in the same process."""
        self._report_all(self._session.on_observation(reading.nanoseconds(stamp), observation))

    def _report_all(self, results: Iterator[PredictionResult]) -> None:
        began = time.perf_counter()
        for result in results:
            step_time = time.perf_counter() - began
            self._publish_prediction(result, step_time)
            self._report(result, step_time)
            began = time.perf_counter()
        for late in self._session.late_estimates():
            self._report(late, 0.0)

    def _publish_prediction(self, result: PredictionResult, step_time: float) -> None:
        if result.prediction is not None:
            when, material = time_of(result.stamp), self._session.settings.material
            self._predicted.publish(packed_prediction(when, result.prediction, material, step_time=step_time))

    def _report(self, result: PredictionResult, step_time: float) -> None:
        """Publish estimate and margins of a pose or of a late observation, or why there are none.

        No margin is published that is not proven.
        """
        if result.refused is not None:
            self.health.refuse(result.refused)
            return
        if result.estimate is not None:
            self._estimated.publish(packed_estimate(time_of(result.stamp), result.estimate))
        if result.stamp >= self._last_margins or not result.late:  # those of an earlier frame are of no use any more
            self._publish_margins(result)
        self._states.show(result, step_time)

    def _publish_margins(self, result: PredictionResult) -> None:
        if result.late and result.estimate is None:
            return
        when, margins, of_estimate = time_of(result.stamp), result.margins, result.estimate is not None
        reason = "" if margins else result.reason
        self._margins.publish(packed_margins(when, margins, reason, result.scene_version, of_estimate=of_estimate))
        self._last_margins = result.stamp
        if self._markers.get_subscription_count() and (result.prediction or result.estimate):
            diameter = self._session.thread.diameter
            self._markers.publish(packed_markers(when, result.prediction, margins, diameter, result.estimate))


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(ThreadModelNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
