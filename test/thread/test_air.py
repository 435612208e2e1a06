"""The formulation `rod` in air: inertia, weight and damping."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j0

from magnetosuture_thread.thread.step import PrescribedMotion, ThreadState
from test.thread.scenes import east, followed, formulated, in_air, straight

G = 9.81


@pytest.mark.parametrize(("segments", "within"), [(3, 0.03), (20, 0.005)])
def test_a_hanging_chain_swings_with_its_period(segments: int, within: float):
    """The slowest mode of a hanging chain has the period 4 pi / j_0 sqrt(L / g), j_0 = 2.4048.

    A chain of a few heavy links is close to it already.
    """
    length = 0.5
    thread = in_air(length, segments, (0.0, -G))
    at = np.linspace(0.0, 1.0, segments + 1)
    shape = np.column_stack([0.01 * length * j0(2.404826 * np.sqrt(1.0 - at)), -length * at])  # the slowest mode
    links = np.diff(shape, axis=0)
    shape[1:] = np.cumsum(length / segments * links / np.linalg.norm(links, axis=1)[:, None], axis=0)
    dt = 5e-4
    steps = followed(formulated(thread), shape, lambda _: np.zeros(2), 3999, dt)
    values = np.array([done.state.positions[-1, 0] for done in steps])
    rising = np.flatnonzero((values[:-1] < 0.0) & (values[1:] >= 0.0))
    falling = np.flatnonzero((values[:-1] > 0.0) & (values[1:] <= 0.0))
    half = dt * (rising[0] - falling[0])
    assert 2.0 * half == pytest.approx(4.0 * math.pi / 2.404826 * math.sqrt(length / G), rel=within)


def test_bending_damping_takes_the_energy_out_of_a_spring():
    """An elastic thread that is clamped and plucked swings on in vacuum, and not with a damped bending."""
    thread = in_air(0.1, 20, (0.0, 0.0), stiffness=1e-3)
    swings = {}
    for damping in (0.0, 0.02):
        damped = replace(thread, medium=replace(thread.medium, bending_damping=damping))
        formulation = formulated(damped)
        state = ThreadState.at_rest(straight(thread))
        state.velocities[:, 1] = 0.05 * np.linspace(0.0, 1.0, 21) ** 2
        hold = PrescribedMotion((0, 1), state.positions[:2].copy(), east())
        moved = []
        for _ in range(600):
            state = formulation.step(state, hold, 2e-4).state
            moved.append(abs(state.positions[-1, 1]))
        swings[damping] = max(moved[-200:])
    assert swings[0.02] < 0.3 * swings[0.0]
