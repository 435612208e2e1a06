"""Settings of the forecasts that the node `thread_model` publishes, which are among its own."""

from __future__ import annotations

from dataclasses import dataclass

from magnetosuture_thread.configuration import Configuration, quantity
from magnetosuture_thread.shared_parameters import shared_parameter


@dataclass(frozen=True)
class ForecastSettings(Configuration):
    """How far the estimated thread is forecast under the present command, and the needle that is moved."""

    forecast_horizon: float = quantity(
        0.0,
        "how far ahead thread/forecast looks from every estimate, the present command held; 0 for none",
        unit="s",
        minimum=0.0,
        maximum=30.0,
    )
    forecast_step: float = quantity(0.03, "duration of its steps", unit="s", minimum=0.001, maximum=0.5)
    forecast_period: float = quantity(
        0.0,
        "time between estimates that are forecast; 0 for every estimate, as far as there is time",
        unit="s",
        minimum=0.0,
        maximum=10.0,
    )
    friction_feedback: str = shared_parameter("friction_feedback")
    keep_out: float = shared_parameter("keep_out")
    pose_margin: float = shared_parameter("pose_margin")
    needle_length: float = shared_parameter("needle_length")
    needle_curvature: float = shared_parameter("needle_curvature")
