"""The benchmark of forecasts: that its figures are there and make sense; none of them is held to a time."""

from __future__ import annotations

import pytest

from benchmarks import forecast


@pytest.mark.parametrize(("loop", "limit", "withheld"), [("hernia_ring", 0.5, 0), ("dead_end", 0.3, 3)])
def test_forecasts_of_a_loop_are_compared_with_what_then_happened(
    loop: str, limit: float, withheld: int, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(forecast, "MAX_DURATION", 4.0)
    found = forecast.measure_accuracy(loop, 0.2, 0.5, seed=2)
    assert 0.0 < found["error_median_percent"] <= found["error_p95_percent"]
    assert found["error_mean_percent"] < min(limit, found["still_mean_percent"]), "the forecast knows where it goes"
    assert found["forecasts"] - found["published"] <= withheld
