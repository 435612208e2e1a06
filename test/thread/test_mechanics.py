"""Bending, chords and tension."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.thread import mechanics


def energy(positions: np.ndarray, heading: np.ndarray, clamped: bool) -> float:
    """Return the bending energy over EI / D, straight from its formula."""
    turns = positions[2:] - 2.0 * positions[1:-1] + positions[:-2]
    first = 2.0 * (positions[1] - positions[0] + heading) if clamped else np.zeros(positions.shape[1])
    every = np.vstack([first, turns, np.zeros_like(first)])
    slopes = (np.diff(every, axis=0) ** 2).sum(axis=1)
    slopes[0] *= 1.5 if clamped else 1.0
    return 0.5 * float((turns**2).sum()) + 0.25 * float((first**2).sum()) + float(slopes.sum()) / 12.0


def gradient_of(
    positions: np.ndarray, heading: np.ndarray, clamped: bool, rest: np.ndarray | None = None
) -> np.ndarray:
    """Return the compiled gradient."""
    rest = np.zeros(len(positions) - 2) if rest is None else rest
    gradient = np.empty_like(positions)
    mechanics.bending_gradient(positions, heading, clamped, rest, np.empty((2, *positions.shape)), gradient)
    return gradient


def full(bands: np.ndarray) -> np.ndarray:
    """Return a symmetric matrix from its bands."""
    nodes = bands.shape[1]
    matrix = np.diag(bands[0])
    for apart in range(1, 4):
        band = bands[apart, : nodes - apart]
        matrix += np.diag(band, apart) + np.diag(band, -apart)
    return matrix


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("clamped", [False, True])
def test_gradient_and_hessian_are_those_of_the_energy(dimension: int, clamped: bool):
    random = np.random.default_rng(0)
    positions, heading = random.normal(size=(8, dimension)), random.normal(size=dimension)
    gradient = gradient_of(positions, heading, clamped)
    hessian = full(mechanics.bending_bands(7, clamped))
    for node in range(8):
        for axis in range(dimension):
            step = np.zeros_like(positions)
            step[node, axis] = 1e-5
            slope = (energy(positions + step, heading, clamped) - energy(positions - step, heading, clamped)) / 2e-5
            assert gradient[node, axis] == pytest.approx(slope, abs=1e-8)
            ahead, behind = (gradient_of(positions + s * step, heading, clamped) for s in (1.0, -1.0))
            np.testing.assert_allclose((ahead - behind)[:, axis] / 2e-5, hessian[:, node], atol=1e-8)


@pytest.mark.parametrize("clamped", [False, True])
def test_tension_is_the_slope_of_its_energy(clamped: bool):
    random = np.random.default_rng(4)
    positions = np.cumsum(random.normal(size=(7, 2)) * 0.1 + [1.0, 0.0], axis=0)
    heading, tension, interval = np.array([-1.0, 0.1]), random.uniform(1.0, 2.0, 6), 0.3

    def stretched(at: np.ndarray) -> float:
        chords = np.empty(6)
        mechanics.chord_lengths(at, heading, clamped, chords)
        return float(-(tension * chords).sum())

    blocks, couplings, linear = np.zeros((7, 2, 2)), np.zeros((3, 7)), np.zeros((7, 2))
    mechanics.tension_stiffness(positions, heading, clamped, tension, -1.0, interval, (blocks, couplings, linear))
    for node in range(7):
        step = np.zeros_like(positions)
        step[node, 1] = 1e-6
        slope = (stretched(positions + step) - stretched(positions - step)) / 2e-6
        # -sum T chord has the slope of the energy where the turns are resolved.
        assert linear[node, 1] == pytest.approx(slope, abs=2e-3)
    hessian = np.vstack([np.diag(blocks[:, 0, 0]), np.zeros((0, 7))])
    for apart in range(1, 4):
        hessian += np.diag(couplings[apart - 1, :-apart], apart) + np.diag(couplings[apart - 1, :-apart], -apart)
    assert np.linalg.eigvalsh(hessian).min() > -1e-12
    np.testing.assert_allclose(hessian.sum(axis=1)[2:], 0.0, atol=1e-12)
