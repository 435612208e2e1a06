"""The benchmark of forecasts: that its figures are there and make sense; none of them is held to a time."""

from __future__ import annotations

import pytest

from benchmarks import forecast


def test_forecasts_of_a_loop_are_compared_with_what_then_happened(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(forecast, "MAX_DURATION", 3.0)
    found = forecast.measure_accuracy("hernia_ring", 10, 0.5, seed=2)
    assert 0.0 < found["error_median_percent"] <= found["error_p95_percent"] < 0.5
    assert found["needle_error_mean_percent"] < 0.5 < found["moved_mean_percent"], "the forecast knows where it goes"
