"""Prediction of a suture thread behind a magnetically steered needle, and safety filter of that needle.

    from magnetosuture_thread import Disc, NeedlePose, Scene, ThreadPredictor

What this module offers is imported when it is first used, so that a command that needs none of it starts quickly.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # under an alias, so that type checkers take each name for one that is offered
    from magnetosuture_thread.calibration.bags import calibrate_bags as calibrate_bags
    from magnetosuture_thread.coils.filter import FilteredCommand as FilteredCommand
    from magnetosuture_thread.coils.filter import NeedleSafetyFilter as NeedleSafetyFilter
    from magnetosuture_thread.estimator.estimator import EstimatorOptions as EstimatorOptions
    from magnetosuture_thread.estimator.estimator import EstimatorSession as EstimatorSession
    from magnetosuture_thread.estimator.estimator import ThreadEstimate as ThreadEstimate
    from magnetosuture_thread.estimator.estimator import ThreadEstimator as ThreadEstimator
    from magnetosuture_thread.evaluation.replay import replay_offline as replay_offline
    from magnetosuture_thread.forecast.forecaster import Forecast as Forecast
    from magnetosuture_thread.forecast.forecaster import ForecastStart as ForecastStart
    from magnetosuture_thread.forecast.forecaster import ThreadForecaster as ThreadForecaster
    from magnetosuture_thread.geometry.barrier import Barrier as Barrier
    from magnetosuture_thread.geometry.barrier import Gradient as Gradient
    from magnetosuture_thread.geometry.barrier import check_gradient as check_gradient
    from magnetosuture_thread.geometry.obstacles import Disc as Disc
    from magnetosuture_thread.geometry.obstacles import Polygon as Polygon
    from magnetosuture_thread.geometry.obstacles import Workspace as Workspace
    from magnetosuture_thread.geometry.scene import Dish as Dish
    from magnetosuture_thread.geometry.scene import Scene as Scene
    from magnetosuture_thread.geometry.scene import SceneShape as SceneShape
    from magnetosuture_thread.geometry.scene_files import read_scene as read_scene
    from magnetosuture_thread.settings.errors import ConfigurationError as ConfigurationError
    from magnetosuture_thread.settings.errors import InvalidInputError as InvalidInputError
    from magnetosuture_thread.settings.errors import MagnetosutureError as MagnetosutureError
    from magnetosuture_thread.settings.errors import SolverError as SolverError
    from magnetosuture_thread.thread.margins import BarrierMargins as BarrierMargins
    from magnetosuture_thread.thread.margins import Margins as Margins
    from magnetosuture_thread.thread.material import MATERIALS as MATERIALS
    from magnetosuture_thread.thread.material import Attachment as Attachment
    from magnetosuture_thread.thread.material import Material as Material
    from magnetosuture_thread.thread.material import Medium as Medium
    from magnetosuture_thread.thread.material import Thread as Thread
    from magnetosuture_thread.thread.paper import PaperOptions as PaperOptions
    from magnetosuture_thread.thread.prediction import NeedlePose as NeedlePose
    from magnetosuture_thread.thread.prediction import Prediction as Prediction
    from magnetosuture_thread.thread.predictor import ThreadPredictor as ThreadPredictor

__version__ = "0.2.0"  # as in pyproject.toml, both files package.xml, CITATION.cff and CHANGELOG.md

_HOME = {
    "geometry.barrier": ("Barrier", "Gradient", "check_gradient"),
    "settings.errors": ("ConfigurationError", "InvalidInputError", "MagnetosutureError", "SolverError"),
    "forecast.forecaster": ("Forecast", "ForecastStart", "ThreadForecaster"),
    "geometry.obstacles": ("Disc", "Polygon", "Workspace"),
    "calibration.bags": ("calibrate_bags",),
    "evaluation.replay": ("replay_offline",),
    "estimator.estimator": ("EstimatorOptions", "EstimatorSession", "ThreadEstimate", "ThreadEstimator"),
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

__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    """Import what the package offers when it is first asked for."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value
