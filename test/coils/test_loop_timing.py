"""Jitter of a periodic loop."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.coils.coil_system import LoopTiming


def test_jitter_is_the_deviation_from_the_period():
    timing = LoopTiming(0.005)
    assert np.isnan(timing.jitter_ms).all()
    at = 10.0
    for k in range(1000):
        timing.tick(at)
        at += 0.005 if k != 500 else 0.025
    assert timing.jitter_ms == pytest.approx((0.0, 0.0, 20.0), abs=1e-6)


def test_jitter_is_given_by_median_99th_percentile_and_maximum():
    """Deviations of 0 to 100 ms, each once."""
    timing, at = LoopTiming(0.2), 10.0
    timing.tick(at)
    for deviation in range(101):
        at += 0.2 + 1e-3 * deviation
        timing.tick(at)
    assert timing.jitter_ms == pytest.approx((50.0, 99.0, 100.0), abs=1e-6)
