"""The node `thread_model`: predicts the thread from needle poses, estimates it by the camera, and forecasts it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from magnetosuture_msgs.msg import ThreadMaterial

from magnetosuture_thread import (
    Forecast,
    ForecastStart,
    InvalidInputError,
    MagnetosutureError,
    NeedlePose,
    Scene,
    ThreadForecaster,
)
from magnetosuture_thread.bags import reading
from magnetosuture_thread.bags.packing import (
    estimate_outputs,
    packed_forecast,
    packed_forecast_markers,
    packed_thread_markers,
    prediction_outputs,
)
from magnetosuture_thread.coils.needle_motion import NeedleKinematics
from magnetosuture_thread.estimator.settings import FIXED, ThreadModelSettings, parse_material
from magnetosuture_thread.estimator.thread_session import WAITING, PredictionResult, ThreadSession
from magnetosuture_thread.forecast.forecaster import make_forecaster
from magnetosuture_thread.forecast.published import PublishedForecasts
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.node import Health, ManagedNode, SceneFollower
from magnetosuture_thread.nodes.processes import leave_priority
from magnetosuture_thread.planning.follower import PathFollower, PathFollowerSettings, prepare_paths
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.configuration import to_mapping
from magnetosuture_thread.thread.prediction import STARTED
from magnetosuture_thread.thread.program import SOLVED

if TYPE_CHECKING:
    from magnetosuture_thread.vision.tracker import Track


class ThreadModelNode(ManagedNode[ThreadModelSettings]):
    """Predicts and estimates the thread at every needle pose.

    Activated again, it starts from the next measured thread. Parameters that are not `FIXED` can be changed in any
    state.

    Args:
        tracker: node in the same process; it hands over what it sees, unless topics of these nodes are renamed.
        options: for rclpy's node.
    """

    def __init__(self, *, tracker: Any = None, **options: Any) -> None:
        super().__init__("thread_model", ThreadModelSettings, fixed=FIXED, **options)
        self._scene = SceneFollower(self, self.on_scene)
        self._states = ThreadHealth(self.health)
        self._forecasts: ThreadForecasts | None = None
        self._observed = False
        topics.MATERIAL.subscribe(self, self.on_material)
        shared = (topics.NEEDLE_POSE.name, topics.THREAD_OBSERVATION.name)
        self._is_handed = tracker is not None and all(
            tracker.resolve_topic_name(name) == self.resolve_topic_name(name) for name in shared
        )
        if self._is_handed:
            tracker.follower = self.on_tracked
        self.start()

    def allocate(self, settings: ThreadModelSettings) -> None:
        """Make the model, and load its kernels."""
        scene = self._scene.load(settings.scene)
        with self.health.load("the model's kernels"):
            self._session = ThreadSession(settings, scene)
            self._forecasts = ThreadForecasts(self, self._session) if settings.forecast_horizon > 0.0 else None
        self._publish = topics.publishing(self, topics.PREDICTED_THREAD, topics.ESTIMATED_THREAD, topics.MARGINS)
        self._markers = topics.THREAD_MARKERS.publisher(self)
        self._last_margins = 0  # stamp of those that were published [ns]
        if not self._is_handed:
            observation, measured = self.on_observation_message, self.on_measured_thread_message
            topics.THREAD_OBSERVATION.subscribe(self, self.while_active(observation), raw=True)
            topics.MEASURED_THREAD.subscribe(self, self.while_active(measured), raw=True)
            topics.NEEDLE_POSE.subscribe(self, self.while_active(self.on_pose))
        where = f"{len(scene.shapes)} shapes in a dish" if scene is not None else "no scene yet"
        model = f"{where}, {settings.formulation} by {settings.solver}"
        self.get_logger().info(f"ready: {settings.segments} segments of {settings.material}, {model}")

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
        self._forecasts = None

    def on_material(self, message: ThreadMaterial) -> None:
        """Set the parameters that a message names."""
        try:
            self.change(parse_material(message))
        except MagnetosutureError as error:
            self.refuse(error)

    def on_scene(self, scene: Scene) -> None:
        """Change the scene; one that the thread's segments do not resolve raises `ConfigurationError`."""
        self._session.change(self._session.settings, scene)

    def on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Step the thread to a needle pose, or report why that is impossible."""
        self._step(message.header.stamp, reading.needle_pose(message))

    def on_tracked(self, stamp: Time, track: Track) -> None:
        """Handle what a tracker in the same process sees in a frame, as its messages would be."""
        if not self.is_active:
            return
        # Before the pose, so that the thread is estimated once, at the pose of its frame.
        self._report_all(self._session.on_observation(reading.nanoseconds(stamp), track.observation))
        try:
            pose = reading.tracked_pose(stamp, track.tail, track.heading, track.covariance)
        except InvalidInputError as error:
            self.refuse(error)
        else:
            self._step(stamp, pose)

    def _step(self, stamp: Time, pose: NeedlePose) -> None:
        began = time.perf_counter()
        result = self._session.predict(reading.nanoseconds(stamp), pose)
        step_time = time.perf_counter() - began
        self._publish_prediction(result, step_time)  # at once, as it is waited for
        result = self._session.estimate(result)
        self._report(result, step_time)
        if self._forecasts is not None:
            self._forecasts.request(result, pose)

    def on_measured_thread_message(self, data: bytes) -> None:
        """Take a centreline, where no tracker tells whether it is all of the thread, as in older bags."""
        name = self.resolve_topic_name(topics.THREAD_OBSERVATION.name)
        self._observed = self._observed or self.count_publishers(name) > 0
        if not self._observed:
            self._take(data, topics.MEASURED_THREAD, reading.path_points, self._session.on_measured_thread)

    def on_observation_message(self, data: bytes) -> None:
        """Take what the camera sees of the thread."""
        self._observed = True
        self._take(data, topics.THREAD_OBSERVATION, reading.thread_observation, self._session.on_observation)

    def _take(self, data: bytes, topic: topics.Topic, read: Callable[[Any], Any], take: Callable[..., Any]) -> None:
        """Take a message about the thread; without an estimate most are not needed, and only their stamp is read."""
        stamp = reading.header_stamp(data) or 0
        if self._session.estimates or self._session.needs_measured_thread(stamp):
            topic.decoded(self, data, lambda message: self._report_all(take(stamp, read(message))))

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
        self._publish(prediction_outputs(result, self._session.settings.material, step_time))

    def _report(self, result: PredictionResult, step_time: float) -> None:
        """Publish estimate and margins of a pose or of a late observation, or why there are none."""
        if result.refused is not None:
            self.refuse(result.refused)
            return
        is_newest = result.stamp >= self._last_margins or not result.late
        outputs = estimate_outputs(result)  # margins of an earlier frame are of no use any more
        self._publish(output for output in outputs if output[0] is not interface.MARGINS or is_newest)
        if is_newest and (result.estimate is not None or not result.late):
            self._last_margins = result.stamp
            if self._markers.get_subscription_count() and (result.prediction or result.estimate):
                shown = (result.prediction, result.margins, self._session.thread.diameter, result.estimate)
                self._markers.publish(packed_thread_markers(result.stamp, *shown))
        self._states.show(result, step_time, self._forecasts.problem if self._forecasts is not None else "")

    def prepare(self, settings: ThreadModelSettings) -> Callable[[], None]:
        """Return what puts other settings in force, from the next pose on."""
        before, after = to_mapping(self._session.settings), to_mapping(settings)
        put_in_force = self._session.prepare(settings, self._session.scene)

        def change() -> None:
            put_in_force()
            self.get_logger().info(f"changed: {', '.join(name for name in after if after[name] != before[name])}")

        return change


class ThreadHealth:
    """Puts prediction and estimate into words: what is wrong, and what the model does not know of.

    Args:
        health: of the node.
    """

    def __init__(self, health: Health) -> None:
        self._health = health
        self._waiting = True  # for a thread from which the prediction can start
        self._disturbance: tuple[float, str] | None = None  # when it was put into words [s], and these
        self._refused_pieces = 0

    def show(self, result: PredictionResult, step_time: float, no_forecast: str) -> None:
        """Report what came of a pose or an observation, how long the prediction took [s], and why there is no forecast.

        No forecast for no reason is none that is asked for.
        """
        if isinstance(result.estimate_problem, InvalidInputError):
            self._health.refuse(result.estimate_problem)
            return
        prediction, estimate = result.prediction, result.estimate
        self._waiting = self._waiting if result.late else result.waiting
        figures: dict[str, object] = {}
        if prediction is not None:
            figures = {"residual": f"{prediction.residual:.1e}", "step_time": f"{step_time * 1e6:.0f} µs"}
        if estimate is not None:
            self._refused_pieces += len(estimate.problems)
            figures["measured"] = f"{100.0 * (1.0 - estimate.hidden):.0f} %"
            figures["deviation"] = f"{1e3 * float(estimate.deviation.max()):.3f} mm"
            figures["refused_pieces"] = self._refused_pieces
            if estimate.problems:
                figures["last_refused_piece"] = estimate.problems[0]
        if result.problem is not None:
            self._health.error(str(result.problem), **figures)
        elif self._waiting:
            self._health.warn(WAITING if estimate is None else f"estimating; the prediction is {WAITING}", **figures)
        elif trouble := [*self._troubles(result), *([f"no forecast: {no_forecast}"] if no_forecast else [])]:
            self._health.warn(f"predicting, but {'; '.join(trouble)}", **figures)
        else:
            self._health.ok("predicting", **figures)

    def _troubles(self, result: PredictionResult) -> list[str]:
        """Return what is wrong with prediction and estimate; figures in it change once a second at the most."""
        troubles, prediction, estimate = [], result.prediction, result.estimate
        if prediction is not None and prediction.status not in (SOLVED, STARTED):
            troubles.append(prediction.status)
        if result.estimate_problem is not None:
            troubles.append(f"not estimating: {result.estimate_problem}")
        if estimate is None:
            return troubles
        if not estimate.converged:
            troubles.append(result.reason)
        if not estimate.disturbances:
            self._disturbance = None
        elif self._disturbance is None or abs(estimate.stamp - self._disturbance[0]) >= 1.0:
            self._disturbance = (estimate.stamp, "; ".join(map(str, estimate.disturbances)))
        if self._disturbance is not None:
            troubles.append(self._disturbance[1])
        if estimate.unmeasured_for >= 1.0:
            why = f" ({estimate.problems[0]})" if estimate.problems else ""
            troubles.append(f"the estimate is only a prediction since {math.floor(estimate.unmeasured_for)} s{why}")
        return troubles


class ThreadForecasts:
    """Publishes a forecast of every estimate, where the parameter `forecast_horizon` asks for it.

    A worker makes it, so that the node does not wait for it. While a forecast is made, only the newest estimate is kept
    for the next one. A service answers what would happen along a path instead.
    The needle follows `procedure/plan`, or the command that the coil bridge follows, of `needle/filter_state`; without
    one it rests. See `PublishedForecasts`.

    Attributes:
        problem: why forecasts are made and not published; empty if they are.

    Args:
        node: of the thread model; it reports what cannot be forecast.
        session: whose settings and scene are used.
    """

    def __init__(self, node: ManagedNode[ThreadModelSettings], session: ThreadSession) -> None:
        self._node, self._session = node, session
        self._last: tuple[PredictionResult, NeedlePose] | None = None
        self._started = -math.inf  # stamp of the last estimate that is forecast [ns]
        self._made: tuple[ThreadModelSettings, Scene | None, ThreadForecaster | None] | None = None
        self._choice = PublishedForecasts(_kinematics(session.settings))
        self.problem, self._generation = "", 0  # the latter of the forecasts that are still wanted
        self._forecaster()
        self._published, self._markers = topics.FORECAST.publisher(node), topics.THREAD_MARKERS.publisher(node)
        topics.FILTER_STATE.subscribe(node, node.while_active(self.on_filter_state))
        topics.PROCEDURE_PLAN.subscribe(node, self.on_plan)
        node.serve(interface.Service.FORECAST_PATH, self.on_path)
        self._worker = ThreadPoolExecutor(1, "forecasts", leave_priority)
        self._error: Exception | None = None

    def close(self) -> None:
        """Publish no more; to be called before the publishers are destroyed."""
        self._worker.shutdown(cancel_futures=True)

    def reset(self) -> None:
        """Publish nothing until there is another estimate, nor what is being made."""
        self._last, self.problem = None, ""
        self._choice.reset()
        self._generation += 1

    def on_filter_state(self, message: object) -> None:
        """Remember the command that the bridge follows."""
        stamp, commanded, filtered, source = reading.filtered_command(message)
        self._choice.on_command(1e-9 * stamp, commanded, filtered, source)

    def on_plan(self, message: object) -> None:
        """Remember where the needle planner takes the needle."""
        self._choice.on_plan(reading.path_poses(message, topics.PROCEDURE_PLAN.name))

    def request(self, result: PredictionResult, pose: NeedlePose) -> None:
        """Queue the forecast from an estimate; a worker makes and publishes it.

        Args:
            result: of the pose.
            pose: of the needle's tail, as tracked.

        Raises:
            Exception: an unexpected one that ended an earlier forecast, as in any callback.
        """
        if self._error is not None:
            raise self._error
        if result.estimate is None or not result.estimate.converged:
            return
        forecaster, settings = self._forecaster(), self._session.settings
        self._last = result, pose
        elapsed = 1e-9 * abs(result.stamp - self._started)  # time may be set back
        if forecaster is None or elapsed < settings.forecast_period:
            self._choice.update(pose, settings.forecast_horizon)
            return
        self._started = result.stamp
        self.problem = self._choice.judge(result.estimate)
        slowed = settings.friction_feedback == "all"
        make = self._choice.prepare(forecaster, result.estimate, pose, settings.forecast_horizon, slowed=slowed)
        self._worker.submit(self._publish, result.stamp, self._generation, make)

    def _publish(self, stamp: int, generation: int, make: Callable[[], Forecast]) -> None:
        if stamp != self._started:
            return  # a newer estimate waits
        try:
            forecast = make()
        except MagnetosutureError as error:
            self._node.get_logger().warning(f"no forecast: {error}", throttle_duration_sec=5.0)
            return
        except Exception as error:
            self._error = error
            return
        if generation == self._generation and not self.problem:
            self._published.publish(packed_forecast(stamp, forecast))
            if self._markers.get_subscription_count():
                self._markers.publish(packed_forecast_markers(stamp, forecast))

    def on_path(self, request: Any) -> dict[str, Any]:
        """Return what happens while the needle's tip follows a path, from the last estimate; nothing moves.

        Raises:
            MagnetosutureError: path, speed or horizon are out of bounds, nothing is estimated yet, or the node is not
                active.
        """
        self._node.require_active()
        settings = self._session.settings
        follower = make_path_follower(request, settings)
        forecaster = self._forecaster()
        if self._last is None or forecaster is None:
            raise InvalidInputError("forecast", "no estimate yet", "a thread that is estimated, in a scene")
        result, pose = self._last
        assert result.estimate is not None

        def command(time: float, tail: np.ndarray, heading: np.ndarray) -> np.ndarray:
            return follower.compute_command(time, tail, heading).velocity

        start, slowed = ForecastStart.of_estimate(result.estimate, pose), settings.friction_feedback == "all"
        forecast = forecaster.forecast(start, command, request.horizon, slowed=slowed)
        return {"forecast": topics.FORECAST.decode(packed_forecast(result.stamp, forecast))}

    def _forecaster(self) -> ThreadForecaster | None:
        """Return the forecaster of the settings and the scene in force; None without a scene."""
        settings, scene = self._session.settings, self._session.scene
        if self._made is None or self._made[0] is not settings or self._made[1] is not scene:
            self.reset()
            self._choice.on_needle(_kinematics(settings))
            self._made = settings, scene, None  # also where this fails: once is enough
            if scene is not None:
                forecaster = make_forecaster(settings, scene)
                forecaster.warm_up()
                prepare_paths()
                self._made = settings, scene, forecaster
        return self._made[2]


def _kinematics(settings: ThreadModelSettings) -> NeedleKinematics:
    return NeedleKinematics(settings.needle_length, settings.needle_curvature)


def make_path_follower(request: Any, settings: ThreadModelSettings) -> PathFollower:
    """Return the controller that takes the tip along the path of a request, as the node `path_follower` does.

    Raises:
        InvalidInputError: path, speed or horizon are out of bounds.
    """
    points = np.array([(point.x, point.y) for point in request.path]).reshape(-1, 2)
    for is_valid, name, value, expectation in (
        (0 < len(points) <= 1000, "path", f"{len(points)} points", "1 to 1000"),
        ((np.abs(points) <= 0.5).all(), "path", "a point that is not finite or far away", "within 0.5 m"),
        (1e-5 <= request.speed <= 0.1, "speed", request.speed, "1e-05 to 0.1 m/s"),
        # The node does nothing else while it is computed.
        (0.0 < request.horizon <= 10.0, "horizon", request.horizon, "above 0 and at most 10 s"),
    ):
        if not is_valid:
            raise InvalidInputError(name, value, expectation)
    arc: dict[str, Any] = {"needle_length": settings.needle_length, "needle_curvature": settings.needle_curvature}
    path: dict[str, Any] = {"waypoints": tuple(points.ravel().tolist()), "speed": request.speed, "settle": 0.0}
    # Without the integral: the forecast knows all drag that there is.
    return PathFollowerSettings(**path, **arc, integral_gain=0.0).follower()
