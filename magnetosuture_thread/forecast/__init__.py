"""Forecast: where needle and thread will be while a command is held."""

from magnetosuture_thread.forecast.forecaster import (
    Forecast,
    ForecastContact,
    ForecastMargin,
    ForecastStart,
    NeedleDrag,
    ThreadForecaster,
    make_forecaster,
)

__all__ = [
    "Forecast",
    "ForecastContact",
    "ForecastMargin",
    "ForecastStart",
    "NeedleDrag",
    "ThreadForecaster",
    "make_forecaster",
]
