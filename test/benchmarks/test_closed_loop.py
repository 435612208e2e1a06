"""The benchmark of the thread in closed loop: its figures for a short loop, and how those of the pull are computed."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.closed_loop import SETTLING, compare_pulls, measure_closed_loop


def test_figures_of_pulls_that_are_off_in_turns():
    times = (SETTLING + np.arange(31) / 60.0).tolist()
    expected = [np.array([1e-5, 0.0])] * 30 + [np.array([0.0, 2e-5])]
    pulls = [true + (-1.0) ** k * np.array([0.0, 1e-6]) for k, true in enumerate(expected)]
    figures = compare_pulls([0.0, *times], [np.zeros(2), *pulls], [np.zeros(2), *expected])
    assert figures["peak_n"] == 2e-5
    assert figures["rms_percent"] == pytest.approx(5.0)
    assert figures["median_percent"] == pytest.approx(5.0)
    assert figures["max_percent"] == pytest.approx(5.0)
    assert figures["averaged_rms_percent"] == pytest.approx(0.0, abs=1e-9)  # six frames in 0.1 s


def test_a_short_loop():
    (found,) = measure_closed_loop((("petri_35mm_polyamide_post", 25),), duration=6.0)
    assert 1e-5 < found["peak_n"] < 2e-4
    assert found["rms_percent"] < 5.6  # of a peak that this loop has not reached yet; the poses' noise is most of it
    assert found["averaged_rms_percent"] < 2.8
    assert 0.0 < found["estimate"]["mean_percent"] < 0.1
    assert found["estimate"]["mean_percent"] <= found["estimate"]["max_percent"] < 0.5
    assert 0.0 < found["prediction"]["mean_percent"] < 0.3
