"""The formulation `paper`: what is printed, and what follows from it."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from magnetosuture_thread.geometry.obstacles import Disc, Polygon, Workspace
from magnetosuture_thread.geometry.polyline import Vector
from magnetosuture_thread.thread.barriers import Connectivity, EnhancedConnectivity, Stiffness
from magnetosuture_thread.thread.paper import PaperFormulation, PaperOptions
from magnetosuture_thread.thread.program import ChainProgram, Solution
from magnetosuture_thread.thread.solvers import BandedSolver
from magnetosuture_thread.thread.step import ThreadState
from test.thread.scenes import DT, TOLERANCE, east, followed, formulated, lead, polyamide, straight


class Listening:
    """Solves, and keeps the programs."""

    name = "listening"

    def __init__(self) -> None:
        self.programs: list[ChainProgram] = []
        self._solver = BandedSolver()

    def solve(self, program: ChainProgram, velocities: np.ndarray, multipliers: Vector) -> Solution:
        """Solve a program."""
        copied = copy.deepcopy(program)
        self.programs.append(copied)
        return self._solver.solve(program, velocities, multipliers)


def test_the_program_is_the_printed_one():
    """P = I, q = -kappa v, rows grad h' u >= -alpha h with the weights' inverses as compliances."""
    thread, solver = polyamide(), Listening()
    options = PaperOptions(gain=30.0, stiffness_gain=7.0, stiffness_weight=0.5)
    formulation = PaperFormulation(thread, Workspace((), 0.01), solver, TOLERANCE, options)
    random = np.random.default_rng(2)
    unit = thread.segment_length
    state = ThreadState(straight(thread) + 1e-4 * random.normal(size=(26, 2)), 1e-3 * random.normal(size=(26, 2)))
    formulation.step(state, lead(np.array([1e-4, 0.0])), DT)
    program = solver.programs[0]
    np.testing.assert_allclose(program.blocks, np.tile(np.eye(2), (26, 1, 1)))
    np.testing.assert_array_equal(program.couplings, 0.0)
    np.testing.assert_allclose(program.linear, -0.95 * state.velocities / unit)
    np.testing.assert_array_equal(program.known, np.arange(26) == 0)
    x = state.positions / unit  # as printed, the needle's own motion is not ahead
    expected = [
        (Connectivity(1.0).rows(x), 30.0, 1e-5),
        (EnhancedConnectivity(1.0).rows(x), 30.0, 1e-5),
        (Stiffness(np.full(24, 2.0)).rows(x), 7.0, 2.0),
    ]
    row = 0
    for rows, gain, compliance in expected:
        for k in range(len(rows.value)):
            full = np.zeros((26, 2))
            full[program.first[row] : program.first[row] + 3] = program.gradient[row]
            wanted = np.zeros((26, 2))
            wanted[rows.nodes[k]] = rows.gradient[k]
            np.testing.assert_allclose(full, wanted, atol=1e-12)
            assert program.lower[row] == pytest.approx(-gain * rows.value[k])
            assert program.upper[row] == np.inf
            assert program.compliance[row] == pytest.approx(compliance)
            row += 1
    assert row == len(program.first) == 3 * 25 - 2


@pytest.mark.parametrize(
    "obstacle", [Disc((-0.009, 0.0025), 0.0015), Polygon(((-0.012, 0.001), (-0.006, 0.001), (-0.009, 0.004)))]
)
def test_no_node_enters_an_obstacle_and_one_inside_is_pushed_out(obstacle: Disc | Polygon):
    thread = polyamide()
    formulation = formulated(thread, (obstacle,), name="paper", paper=PaperOptions.tuned(0.01))

    def least(positions: np.ndarray) -> float:
        rows = formulation.margins(positions, east())[-2]
        assert rows.barrier == "obstacle"
        return float(rows.value[rows.node > 0].min(initial=np.inf))

    touched = False
    for done in followed(formulation, straight(thread), lambda k: k * 4e-5 * np.array([0.0, 1.0]), 300):
        assert least(done.state.positions) > -5e-6
        touched = touched or least(done.state.positions) < 2e-5
    assert touched
    inside = straight(thread) + np.array([0.0, 0.0016])
    assert least(inside) < -4e-4
    last = followed(formulation, inside, lambda _: inside[0], 100)[-1]
    assert least(last.state.positions) > -5e-6


def test_a_step_that_ends_deep_in_an_obstacle_says_so():
    """As printed, a step is judged at its start: a leap lands beyond an edge that was not near then."""
    thread = polyamide()
    formulation = formulated(thread, (Disc((-0.0007, 0.0025), 0.0006),), name="paper", paper=PaperOptions.tuned(0.01))
    calm = formulation.step(ThreadState.at_rest(straight(thread)), lead(np.array([1e-5, 0.0])), DT)
    assert calm.converged
    assert calm.status == "solved"
    leap = formulation.step(ThreadState.at_rest(straight(thread)), lead(np.array([0.0, 0.0043])), DT)
    assert not leap.converged
    assert "not converged, a node is" in leap.status


def test_a_thread_that_its_slacks_let_grow_is_not_converged():
    thread = polyamide()
    soft = replace(PaperOptions.tuned(0.01), connectivity_weight=1e-6)
    formulation = formulated(thread, name="paper", paper=soft)
    done = followed(formulation, straight(thread), lambda k: k * 4e-4 * east(), 100)[-1]
    assert not done.converged
    assert "times as long as it is" in done.status
