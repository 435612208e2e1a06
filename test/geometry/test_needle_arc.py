"""Arcs that needles lie along."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.geometry.needle_arc import needle_axis

LENGTH = 0.007


@pytest.mark.parametrize("curvature", [0.0, 1e-9, 200.0, -440.0])
def test_an_arc_has_its_length_its_tangents_and_its_curvature(curvature: float):
    at = np.linspace(0.0, 1.0, 2001)
    points, tangents = needle_axis(np.array([0.001, -0.002]), 0.7, LENGTH, curvature, at)
    steps = np.diff(points, axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1).sum(), LENGTH, rtol=1e-6)
    np.testing.assert_allclose(steps / (LENGTH / 2000), 0.5 * (tangents[1:] + tangents[:-1]), atol=1e-6)
    turned = np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0]))
    assert turned[0] == pytest.approx(0.7)
    assert (turned[-1] - turned[0]) / LENGTH == pytest.approx(curvature, abs=1e-6)
