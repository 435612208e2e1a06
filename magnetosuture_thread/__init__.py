"""Prediction of a suture thread behind a magnetically steered needle, and safety filter of that needle.

    from magnetosuture_thread import Disc, NeedlePose, Scene, ThreadPredictor

What this module offers is imported when it is first used, so that a command that needs none of it starts quickly.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from magnetosuture_thread.calibration.bags import calibrate_bags
    from magnetosuture_thread.coils.filter import FilteredCommand, NeedleSafetyFilter
    from magnetosuture_thread.estimator import EstimatorOptions, EstimatorSession, ThreadEstimate, ThreadEstimator
    from magnetosuture_thread.evaluation.replay import replay_offline
    from magnetosuture_thread.forecast import Forecast, ForecastStart, ThreadForecaster
    from magnetosuture_thread.geometry.barrier import Barrier, Gradient, check_gradient
    from magnetosuture_thread.geometry.obstacles import Disc, Polygon, Workspace
    from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape
    from magnetosuture_thread.geometry.scene_files import read_scene
    from magnetosuture_thread.settings.errors import (
        ConfigurationError,
        InvalidInputError,
        MagnetosutureError,
        SolverError,
    )
    from magnetosuture_thread.thread.margins import BarrierMargins, Margins
    from magnetosuture_thread.thread.material import MATERIALS, Attachment, Material, Medium, Thread
    from magnetosuture_thread.thread.paper import PaperOptions
    from magnetosuture_thread.thread.prediction import NeedlePose, Prediction
    from magnetosuture_thread.thread.predictor import ThreadPredictor

__version__ = "0.2.0"  # as in pyproject.toml, both files package.xml, CITATION.cff and CHANGELOG.md

_HOME = {
    "geometry.barrier": ("Barrier", "Gradient", "check_gradient"),
    "settings.errors": ("ConfigurationError", "InvalidInputError", "MagnetosutureError", "SolverError"),
    "forecast": ("Forecast", "ForecastStart", "ThreadForecaster"),
    "geometry.obstacles": ("Disc", "Polygon", "Workspace"),
    "calibration.bags": ("calibrate_bags",),
    "evaluation.replay": ("replay_offline",),
    "estimator": ("EstimatorOptions", "EstimatorSession", "ThreadEstimate", "ThreadEstimator"),
    "thread.margins": ("BarrierMargins", "Margins"),
    "thread.paper": ("PaperOptions",),
    "thread.prediction": ("NeedlePose", "Prediction"),
    "thread.predictor": ("ThreadPredictor",),
    "thread.material": ("MATERIALS", "Attachment", "Material", "Medium", "Thread"),
    "coils.filter": ("FilteredCommand", "NeedleSafetyFilter"),
    "geometry.scene": ("Dish", "Scene", "SceneShape"),
    "geometry.scene_files": ("read_scene",),
}
_MODULES = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "MATERIALS",
    "Attachment",
    "Barrier",
    "BarrierMargins",
    "ConfigurationError",
    "Disc",
    "Dish",
    "EstimatorOptions",
    "EstimatorSession",
    "FilteredCommand",
    "Forecast",
    "ForecastStart",
    "Gradient",
    "InvalidInputError",
    "MagnetosutureError",
    "Margins",
    "Material",
    "Medium",
    "NeedlePose",
    "NeedleSafetyFilter",
    "PaperOptions",
    "Polygon",
    "Prediction",
    "Scene",
    "SceneShape",
    "SolverError",
    "Thread",
    "ThreadEstimate",
    "ThreadEstimator",
    "ThreadForecaster",
    "ThreadPredictor",
    "Workspace",
    "calibrate_bags",
    "check_gradient",
    "read_scene",
    "replay_offline",
]


def __getattr__(name: str) -> Any:
    """Import what the package offers when it is first asked for."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value
