"""Forecasters by the settings of the thread model."""

from __future__ import annotations

from typing import Any

from magnetosuture_thread.forecast.forecaster import ThreadForecaster
from magnetosuture_thread.model.settings import ThreadModelSettings
from magnetosuture_thread.safety import NeedleSafetyFilter
from magnetosuture_thread.scene import Scene


def make_forecaster(
    settings: ThreadModelSettings, scene: Scene, safety: NeedleSafetyFilter | None = None, **options: Any
) -> ThreadForecaster:
    """Return a forecaster of the thread of a thread model, with its friction law.

    The thread takes one step in each of the forecast, however long: what shorter ones change is small beside what the
    needle does otherwise than forecast.

    Args:
        settings: of the thread model.
        scene: dish and shapes.
        safety: the needle's filter; None for one with the settings' needle, `keep_out` and `pose_margin`.
        options: further arguments of `ThreadForecaster`, by name; they come before those of the settings.

    Raises:
        ConfigurationError: see `ThreadForecaster`.
    """
    if safety is None:
        safety = NeedleSafetyFilter(
            scene,
            keep_out=settings.keep_out + settings.pose_margin,
            needle_length=settings.needle_length,
            needle_curvature=settings.needle_curvature,
        )
    step = options.get("step", settings.forecast_step)
    chosen: dict[str, Any] = {
        "law": settings.friction_law(),
        "friction_averaging": settings.friction_averaging,
        "attachment_offset": settings.attachment_offset,
        "step": step,
        "margin_range": settings.margin_range,
        "contact_tolerance": settings.contact_tolerance,
        "residual_tolerance": settings.residual_tolerance,
        "max_step": max(settings.max_step, 1.001 * step),  # against rounding
        "fixed_nodes": settings.fixed_nodes,
    }
    return ThreadForecaster(settings.thread(), scene, safety, **{**chosen, **options})
