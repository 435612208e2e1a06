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
