"""Forecast: where needle and thread will be while a command is held, or a sequence of commands is followed."""

from magnetosuture_thread.forecast.drag import NeedleDrag
from magnetosuture_thread.forecast.forecast import Forecast, ForecastContact, ForecastMargin
from magnetosuture_thread.forecast.forecaster import ThreadForecaster
from magnetosuture_thread.forecast.making import make_forecaster
from magnetosuture_thread.forecast.start import ForecastStart

__all__ = [
    "Forecast",
    "ForecastContact",
    "ForecastMargin",
    "ForecastStart",
    "NeedleDrag",
    "ThreadForecaster",
    "make_forecaster",
]
