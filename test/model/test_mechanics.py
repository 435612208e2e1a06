"""Drag and bending."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.model.mechanics import bending_bands, bending_gradient, drag_metric


def energy(positions: np.ndarray, heading: np.ndarray | None) -> float:
    """Return the bending energy over EI / D, straight from its formula."""
    bend = positions[2:] - 2.0 * positions[1:-1] + positions[:-2]
    glue = 0.0 if heading is None else float(((positions[1] - positions[0] + heading) ** 2).sum())
    return 0.5 * float((bend**2).sum()) + glue


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("glued", [False, True])
def test_gradient_and_hessian_are_those_of_the_energy(dimension: int, glued: bool):
    random = np.random.default_rng(0)
    positions = random.normal(size=(8, dimension))
    heading = random.normal(size=dimension) if glued else None
    gradient = bending_gradient(positions, heading)
    diagonal, first, second = bending_bands(7, glued)
    hessian = np.diag(diagonal) + sum(np.diag(band, k) + np.diag(band, -k) for k, band in ((1, first), (2, second)))
    for node in range(8):
        for axis in range(dimension):
            step = np.zeros_like(positions)
            step[node, axis] = 1e-5
            slope = (energy(positions + step, heading) - energy(positions - step, heading)) / 2e-5
            assert gradient[node, axis] == pytest.approx(slope, abs=1e-8)
            change = (bending_gradient(positions + step, heading) - bending_gradient(positions - step, heading)) / 2e-5
            np.testing.assert_allclose(change[:, axis], hessian[:, node], atol=1e-8)


def test_a_straight_thread_has_no_bending_force():
    positions = np.arange(6.0)[:, None] * np.array([0.6, 0.8])
    np.testing.assert_allclose(bending_gradient(positions, None), 0.0, atol=1e-14)
    np.testing.assert_allclose(bending_gradient(positions, -np.array([0.6, 0.8])), 0.0, atol=1e-14)


def test_drag_is_half_along_the_thread_and_half_at_its_end():
    positions = np.column_stack([np.arange(4.0), np.zeros(4)])
    metric = drag_metric(positions, 0.5)
    np.testing.assert_allclose(metric[1], np.diag([0.5, 1.0]))
    np.testing.assert_allclose(metric[3], np.diag([0.25, 0.5]))


def test_drag_turns_with_the_thread():
    positions = np.random.default_rng(2).normal(size=(5, 2))
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    np.testing.assert_allclose(
        drag_metric(positions @ turn.T, 0.5), turn @ drag_metric(positions, 0.5) @ turn.T, atol=1e-14
    )
