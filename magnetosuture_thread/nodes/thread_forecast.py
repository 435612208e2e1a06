"""Forecasts of the node `thread_model`: while the present command is held, and along a path that a client sends."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from queue import SimpleQueue
from threading import Thread
from typing import Any

import numpy as np
from magnetosuture_msgs.srv import ForecastPath

from magnetosuture_thread import (
    ForecastStart,
    InvalidInputError,
    MagnetosutureError,
    NeedlePose,
    Scene,
    ThreadForecaster,
)
from magnetosuture_thread.forecast import Forecast, make_forecaster
from magnetosuture_thread.interface import FORECAST_PATH
from magnetosuture_thread.messages import reading
from magnetosuture_thread.messages.markers import packed_forecast_markers
from magnetosuture_thread.messages.packing import packed_forecast
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.lifecycle import StandbyNode
from magnetosuture_thread.planning.follower import PathFollower, PathFollowerSettings, prepare_paths
from magnetosuture_thread.thread_model.session import PredictionResult, ThreadSession
from magnetosuture_thread.thread_model.settings import ThreadModelSettings

MAX_COMMAND_AGE = 500_000_000  # ns; a command is held no longer when none follows


class ThreadForecasts:
    """Publishes a forecast of every estimate, where the parameter `forecast_horizon` asks for it.

    It is made in a thread of its own, so that the node does not wait for it. While a forecast is made, only the newest
    estimate is kept for the next one. A service answers what would happen along a path instead.
    What is held is the command that the coil bridge follows, of `needle/filter_state`; without one the needle rests.

    Args:
        node: of the thread model; it reports what cannot be forecast.
        session: whose settings and scene are used.
    """

    def __init__(self, node: StandbyNode[ThreadModelSettings], session: ThreadSession) -> None:
        self._node, self._session = node, session
        self._last: tuple[PredictionResult, NeedlePose] | None = None
        self._started: int | None = None  # stamp of the last estimate that is forecast [ns]
        self._made: tuple[ThreadModelSettings, Scene | None, ThreadForecaster | None] | None = None
        self._command: tuple[int, np.ndarray, np.ndarray, str] | None = None  # stamp, commanded, filtered, input
        self._forecaster()
        self._generation = 0  # of the forecasts that are still wanted
        self._published = node.held(topics.FORECAST.publisher(node))
        self._markers = node.held(topics.THREAD_MARKERS.publisher(node))
        node.held(topics.FILTER_STATE.subscribe(node, node.while_active(self.on_filter_state)))
        node.held(node.create_service(ForecastPath, FORECAST_PATH, self.on_path))
        # Stamp of the message [ns], generation, and what makes the forecast; None at the end.
        self._waiting: SimpleQueue[tuple[int, int, Callable[[], Forecast]] | None] = SimpleQueue()
        self._error: Exception | None = None
        self._worker = Thread(target=self._work, name="forecasts", daemon=True)
        self._worker.start()

    def close(self) -> None:
        """Publish no more; to be called before the publishers are destroyed."""
        self._waiting.put(None)
        self._worker.join()

    def reset(self) -> None:
        """Publish nothing until there is another estimate, nor what is being made."""
        self._last, self._command = None, None
        self._generation += 1

    def on_filter_state(self, message: object) -> None:
        """Remember the command that the bridge follows."""
        try:
            self._command = reading.filtered_command(message)
        except InvalidInputError as error:
            self._node.refuse(error)

    def request(self, result: PredictionResult, pose: NeedlePose) -> None:
        """Queue the forecast from an estimate; the worker thread makes and publishes it.

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
        elapsed = (
            math.inf if self._started is None else 1e-9 * abs(result.stamp - self._started)
        )  # time may be set back
        if forecaster is None or elapsed < settings.forecast_period:
            return
        self._started = result.stamp
        commanded, filtered, source = np.zeros(2), None, ""
        if self._command is not None and abs(result.stamp - self._command[0]) <= MAX_COMMAND_AGE:
            _, commanded, filtered, source = self._command
        start = ForecastStart.of_estimate(result.estimate, pose, filtered)
        slowed = source == "operator" or settings.friction_feedback == "all"
        make = partial(forecaster.forecast, start, commanded, settings.forecast_horizon, slowed=slowed)
        self._waiting.put((result.stamp, self._generation, make))

    def _work(self) -> None:
        while self._error is None and (task := self._waiting.get()) is not None:
            try:
                if self._waiting.empty():
                    self._publish(*task)
            except Exception as error:
                self._error = error

    def _publish(self, stamp: int, generation: int, make: Callable[[], Forecast]) -> None:
        try:
            forecast = make()
        except MagnetosutureError as error:
            self._node.get_logger().warning(f"no forecast: {error}", throttle_duration_sec=5.0)
            return
        if generation != self._generation:
            return
        self._published.publish(packed_forecast(stamp, forecast))
        if self._markers.get_subscription_count():
            self._markers.publish(packed_forecast_markers(stamp, forecast))

    def on_path(self, request: Any, answer: Any) -> Any:
        """Answer what happens while the needle's tip follows a path, from the last estimate; nothing moves.

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
        answer.success = True
        answer.forecast = topics.FORECAST.decode(packed_forecast(result.stamp, forecast))
        return answer

    def _forecaster(self) -> ThreadForecaster | None:
        """Return the forecaster of the settings and the scene in force; None without a scene."""
        settings, scene = self._session.settings, self._session.scene
        if self._made is not None and self._made[0] is settings and self._made[1] is scene:
            return self._made[2]
        self._made, self._last, forecaster = (settings, scene, None), None, None
        if scene is not None:
            forecaster = make_forecaster(settings, scene)
            forecaster.warm_up()
            prepare_paths()
        self._made = settings, scene, forecaster
        return forecaster


def make_path_follower(request: Any, settings: ThreadModelSettings) -> PathFollower:
    """Return the controller that takes the tip along the path of a request, as the node `path_follower` does.

    Raises:
        InvalidInputError: path, speed or horizon are out of bounds.
    """
    points = np.array([(point.x, point.y) for point in request.path]).reshape(-1, 2)
    if not 0 < len(points) <= 1000:
        raise InvalidInputError("path", f"{len(points)} points", "1 to 1000")
    if not (np.abs(points) <= 0.5).all():
        raise InvalidInputError("path", "a point that is not finite or far away", "within 0.5 m")
    if not 1e-5 <= request.speed <= 0.1:
        raise InvalidInputError("speed", request.speed, "1e-05 to 0.1 m/s")
    if not 0.0 < request.horizon <= 10.0:  # s; the node does nothing else while it is computed
        raise InvalidInputError("horizon", request.horizon, "above 0 and at most 10 s")
    chosen = PathFollowerSettings(
        waypoints=tuple(points.ravel().tolist()),
        speed=request.speed,
        settle=0.0,
        integral_gain=0.0,  # the forecast knows all drag that there is
        needle_length=settings.needle_length,
        needle_curvature=settings.needle_curvature,
    )
    return chosen.follower()
