"""The benchmark of forecasts: that its figures are there and make sense; none of them is held to a time."""

from __future__ import annotations

from benchmarks.forecast.timing import BATCH, measure_times


def test_times_of_one_forecast_and_of_a_batch():
    times = measure_times(repeats=1, workers=2)
    assert times["batch_size"] == BATCH
    assert 0.0 < times["single_ms"]["minimum"] <= times["single_ms"]["median"]
    assert times["batch_ms"]["median"] > times["single_ms"]["minimum"] > 0.0
