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
from magnetosuture_thread.messages.cdr import header_stamp
from magnetosuture_thread.model.session import PredictionResult, ThreadSession
from magnetosuture_thread.model.settings import FIXED, ThreadModelSettings
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.lifecycle import StandbyNode
from magnetosuture_thread.nodes.run import run
from magnetosuture_thread.nodes.scene_follower import SceneFollower
from magnetosuture_thread.nodes.thread_forecast import ThreadForecasts
from magnetosuture_thread.nodes.thread_health import ThreadHealth, model_text
from magnetosuture_thread.nodes.thread_outputs import ThreadOutputs
from magnetosuture_thread.nodes.thread_settings import ThreadSettings
from magnetosuture_thread.thread_observation import ThreadObservation


class ThreadModelNode(StandbyNode[ThreadModelSettings]):
    """Predicts and estimates the thread at every needle pose.

    Activated again, it starts from the next measured thread. Parameters that are not `FIXED` can be changed in any
    state.

    Args:
        listens: whether poses and observations of the thread come by topics; else a tracker in the same process
            hands them over.
        options: for rclpy's node.
    """

    def __init__(self, *, listens: bool = True, **options: Any) -> None:
        super().__init__("thread_model", ThreadModelSettings, fixed=FIXED, **options)
        self._scene = SceneFollower(self, self.health, None, self.on_scene)
        self._states = ThreadHealth(self.health)
        self._changes: ThreadSettings | None = None
        self._forecasts: ThreadForecasts | None = None
        self._material: bytes | None = None  # that came while the node was unconfigured; each is applied once
        topics.MATERIAL.subscribe(self, self.on_material, raw=True, unheard=self.health.refuse)
        self._observed = False
        self._listens = listens
        self.start()

    def allocate(self, settings: ThreadModelSettings) -> None:
        """Make the model, and load its kernels."""
        scene = self._scene.load(settings.scene)
        with self.health.load("the model's kernels"):
            self._session = ThreadSession(settings, scene)
            self._forecasts = ThreadForecasts(self, self._session) if settings.forecast_horizon > 0.0 else None
        self._changes = ThreadSettings(self, self._session, self.health)
        if self._material is not None:
            self._changes.on_material(self._material)
            self._material = None
        self._outputs = ThreadOutputs(self, self._session)
        if self._listens:
            self._subscribe()
        self.get_logger().info(f"ready: {model_text(settings, scene)}")

    def activate(self) -> None:
        """Wait for a needle pose."""
        self.health.warn("no needle pose yet")

    def deactivate(self) -> None:
        """Forget the thread, which moves meanwhile."""
        if self._forecasts is not None:
            self._forecasts.reset()
        if not self.is_shutting_down:
            self._session.reset()

    def release(self) -> None:
        """Give the model up, once no forecast is being made."""
        if self._forecasts is not None:
            self._forecasts.close()
        if self._changes is not None:
            self._changes.close()
        self._changes = self._forecasts = None
        super().release()

    def listen(self) -> None:
        """Take needle poses, and what is seen of the thread, by topics from now on."""
        self._listens = True
        if self.settings is not None:
            self._subscribe()

    def on_material(self, data: bytes) -> None:
        """Handle a ThreadMaterial message; one that comes before the node is configured waits for that."""
        if self._changes is None:
            self._material = data
        else:
            self._changes.on_material(data)

    def on_scene(self, scene: Scene) -> None:
        """Change the scene; one that the thread's segments do not resolve raises `ConfigurationError`."""
        if self.settings is not None:
            self._session.change(self._session.settings, scene)

    def on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Step the thread to a needle pose, or report why that is impossible."""
        self._step(message.header.stamp, lambda: reading.needle_pose(message))

    def on_tracked(self, stamp: Time, tail: np.ndarray, heading: np.ndarray, covariance: np.ndarray) -> None:
        """Handle a pose handed over by a tracker in the same process, as its message would be."""
        if self.is_active:
            self._step(stamp, lambda: reading.tracked_pose(stamp, tail, heading, covariance))

    def _subscribe(self) -> None:
        observation, measured = self.on_observation_message, self.on_measured_thread_message
        self.held(topics.THREAD_OBSERVATION.subscribe(self, self.while_active(observation), raw=True))
        self.held(topics.MEASURED_THREAD.subscribe(self, self.while_active(measured), raw=True))
        self.held(topics.NEEDLE_POSE.subscribe(self, self.while_active(self.on_pose)))

    def _step(self, stamp: Time, pose: Callable[[], NeedlePose]) -> None:
        began = time.perf_counter()
        try:
            read = pose()
        except InvalidInputError as error:
            self.health.refuse(error)
            return
        result = self._session.predict(reading.nanoseconds(stamp), read)
        step_time = time.perf_counter() - began
        self._outputs.publish_prediction(result, step_time)  # at once, as it is waited for
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
        if self.is_active:
            self._report_all(self._session.on_observation(reading.nanoseconds(stamp), observation))

    def _report_all(self, results: Iterator[PredictionResult]) -> None:
        began = time.perf_counter()
        for result in results:
            step_time = time.perf_counter() - began
            self._outputs.publish_prediction(result, step_time)
            self._report(result, step_time)
            began = time.perf_counter()
        for late in self._session.late_estimates():
            self._report(late, 0.0)

    def _report(self, result: PredictionResult, step_time: float) -> None:
        """Publish estimate and margins of a pose or of a late observation, or why there are none."""
        if result.refused is not None:
            self.health.refuse(result.refused)
            return
        self._outputs.publish_estimate(result)
        self._states.show(result, step_time)


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(ThreadModelNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
