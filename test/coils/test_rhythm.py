"""How evenly a loop runs."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.coils.rhythm import Rhythm


def test_it_says_how_far_intervals_are_off_the_period():
    rhythm = Rhythm(0.005)
    assert np.isnan(rhythm.milliseconds).all()
    at = 10.0
    for k in range(1000):
        rhythm.tick(at)
        at += 0.005 if k != 500 else 0.025
    assert rhythm.milliseconds == pytest.approx((0.0, 0.0, 20.0), abs=1e-6)
