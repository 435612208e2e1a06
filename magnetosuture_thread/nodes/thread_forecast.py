"""Forecasts of the node `thread_model`: of the estimated thread while the present command is held."""

from __future__ import annotations

import numpy as np

from magnetosuture_thread import (
    Forecast,
    ForecastStart,
    InvalidInputError,
    MagnetosutureError,
    NeedlePose,
    Scene,
    ThreadForecaster,
)
from magnetosuture_thread.forecast import make_forecaster
from magnetosuture_thread.messages import reading
from magnetosuture_thread.messages.forecasts import forecast_markers, forecast_message
from magnetosuture_thread.model.session import PredictionResult, ThreadSession
from magnetosuture_thread.model.settings import ThreadModelSettings
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.messages import MESSAGES
from magnetosuture_thread.nodes.node import PackageNode

MAX_COMMAND_AGE = 500_000_000  # ns; a command is held no longer when none follows


class ThreadForecasts:
    """Publishes a forecast with every estimate, where the parameter `forecast_horizon` asks for it.

    What is held is the command that the coil bridge follows, of `needle/filter_state`; without one the needle rests.

    Args:
        node: of the thread model; it reports what cannot be forecast.
        session: whose settings and scene are used.
    """

    def __init__(self, node: PackageNode, session: ThreadSession) -> None:
        self._node, self._session = node, session
        self._made: tuple[ThreadModelSettings, Scene | None, ThreadForecaster | None] | None = None
        self._command: tuple[int, np.ndarray, np.ndarray] | None = None  # stamp, commanded, filtered
        self._published = topics.FORECAST.publisher(node)
        self._markers = topics.THREAD_MARKERS.publisher(node)
        topics.FILTER_STATE.subscribe(node, self.on_filter_state)
        self._forecaster()

    def on_filter_state(self, message: object) -> None:
        """Remember the command that the bridge follows."""
        try:
            self._command = reading.filtered_command(message)
        except InvalidInputError as error:
            self._node.refuse(error)

    def publish(self, result: PredictionResult, pose: NeedlePose) -> None:
        """Publish the forecast from an estimate.

        Args:
            result: of the pose.
            pose: of the needle's tail, as tracked.
        """
        if result.estimate is None or not result.estimate.converged:
            return
        try:
            forecast = self._forecast(result, pose)
        except MagnetosutureError as error:
            self._node.get_logger().warning(f"no forecast: {error}", throttle_duration_sec=5.0)
            return
        if forecast is None:
            return
        when = MESSAGES.time(result.stamp)
        self._published.publish(forecast_message(MESSAGES, when, forecast))
        if self._markers.get_subscription_count():
            self._markers.publish(forecast_markers(MESSAGES, when, forecast))

    def _forecast(self, result: PredictionResult, pose: NeedlePose) -> Forecast | None:
        forecaster = self._forecaster()
        if forecaster is None or result.estimate is None:
            return None
        commanded, filtered = np.zeros(2), None
        if self._command is not None and abs(result.stamp - self._command[0]) <= MAX_COMMAND_AGE:
            _, commanded, filtered = self._command
        start = ForecastStart(pose, result.estimate.positions, tip_velocity=filtered)
        return forecaster.forecast(start, commanded, self._session.settings.forecast_horizon)

    def _forecaster(self) -> ThreadForecaster | None:
        """Return the forecaster of the settings and the scene in force; None without a scene."""
        settings, scene = self._session.settings, self._session.scene
        if self._made is not None and self._made[0] is settings and self._made[1] is scene:
            return self._made[2]
        self._made, forecaster = (settings, scene, None), None
        if scene is not None:
            forecaster = make_forecaster(settings, scene, workers=1)
            forecaster.warm_up()
        self._made = settings, scene, forecaster
        return forecaster
