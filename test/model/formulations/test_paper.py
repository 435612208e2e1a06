"""The formulation `paper`: what is printed, and what follows from it."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from magnetosuture_thread.errors import SolverError
from magnetosuture_thread.geometry.obstacles import Disc, Polygon, Workspace
from magnetosuture_thread.model.barriers import Connectivity, EnhancedConnectivity, Stiffness
from magnetosuture_thread.model.formulations import PaperFormulation, PaperOptions, ThreadState
from magnetosuture_thread.model.program import ChainProgram, Residuals, Solution, Vector, WideRows
from magnetosuture_thread.model.solvers import BandedSolver
from test.model.formulations.scenes import (
    DT,
    TOLERANCE,
    east,
    followed,
    formulated,
    lead,
    polyamide,
    silk,
    straight,
    stretch,
)


class Listening:
    """Solves, and keeps the programs."""

    name = "listening"

    def __init__(self) -> None:
        self.programs: list[ChainProgram] = []
        self._solver = BandedSolver()

    def solve(
        self, program: ChainProgram, velocities: np.ndarray, multipliers: Vector, wide: WideRows | None = None
    ) -> Solution:
        """Solve a program."""
        copied = copy.deepcopy(program)
        self.programs.append(copied)
        return self._solver.solve(program, velocities, multipliers, wide)


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


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_straight_thread_at_rest_stays_and_a_pulled_one_follows(dimension: int):
    thread = polyamide()
    for name_options in (PaperOptions(), PaperOptions.tuned(1.0)):
        formulation = formulated(thread, name="paper", dimension=dimension, paper=name_options)
        start = straight(thread, dimension)
        still = followed(formulation, start, lambda _: np.zeros(dimension), 5)[-1]
        np.testing.assert_allclose(still.state.positions, start, atol=1e-9)
        pulled = followed(formulation, start, lambda k: k * DT * 5e-3 * east(dimension), 200)[-1]
        behind = straight(thread, dimension) + 200 * DT * 5e-3 * east(dimension)
        assert np.linalg.norm(pulled.state.positions - behind, axis=1).max() < 0.1 * thread.length


def first_segment(options: PaperOptions) -> float:
    """Return how much the first segment is stretched while the needle moves at 5 mm/s."""
    thread = polyamide()
    steps = followed(
        formulated(thread, name="paper", paper=options), straight(thread), lambda k: k * DT * 5e-3 * east(), 100
    )
    positions = steps[-1].state.positions
    return float(np.linalg.norm(positions[1] - positions[0])) / thread.segment_length - 1.0


def test_the_needles_own_motion_is_missed_unless_it_is_fed_forward_or_the_gain_is_high():
    """With alpha = 20 /s the first segment stretches by a tenth or more; with the others by a few percent."""
    assert first_segment(PaperOptions(gain=20.0)) > 0.1
    assert first_segment(PaperOptions(gain=1.0 / DT)) < 0.5 * first_segment(PaperOptions(gain=20.0))
    assert first_segment(PaperOptions(gain=1.0 / DT, lead_ahead=True)) < 0.03


def test_a_needle_that_leapt_out_of_the_safe_set_is_followed_back_into_it():
    thread = silk()
    formulation = formulated(thread, name="paper", paper=PaperOptions.tuned(1.0))
    jump = np.array([3.0 * thread.segment_length, 0.0])
    steps = followed(formulation, straight(thread), lambda _: jump, 200)
    margins = [formulation.margins(done.state.positions, east())[0].clearance.min() for done in steps]
    assert margins[0] < -0.2 * thread.segment_length
    assert margins[-1] > -1e-3 * thread.segment_length
    assert stretch(thread, steps[-1].state.positions) < 2e-3


@pytest.mark.parametrize(
    "obstacle", [Disc((-0.009, 0.0025), 0.0015), Polygon(((-0.012, 0.001), (-0.006, 0.001), (-0.009, 0.004)))]
)
def test_no_node_enters_an_obstacle_and_one_inside_is_pushed_out(obstacle: Disc | Polygon):
    thread = polyamide()
    formulation = formulated(thread, (obstacle,), name="paper", paper=PaperOptions.tuned(0.01))

    def least(positions: np.ndarray) -> float:
        rows = formulation.margins(positions, east())[-2]
        assert rows.name == "obstacle"
        return float(rows.value[rows.nodes[:, 0] > 0].min(initial=np.inf))

    touched = False
    for done in followed(formulation, straight(thread), lambda k: k * 4e-5 * np.array([0.0, 1.0]), 300):
        assert least(done.state.positions) > -5e-6
        touched = touched or least(done.state.positions) < 2e-5
    assert touched
    inside = straight(thread) + np.array([0.0, 0.0016])
    assert least(inside) < -4e-4
    last = followed(formulation, inside, lambda _: inside[0], 100)[-1]
    assert least(last.state.positions) > -5e-6


@pytest.mark.parametrize("interval", [1.0 / 30.0, 0.1])
def test_a_long_step_does_not_overshoot_a_barrier(interval: float):
    """A gain above 1 / dt would ask for more than the way to the barrier."""
    thread = polyamide()
    formulation = formulated(thread, (Disc((-0.009, 0.0025), 0.0015),), name="paper", paper=PaperOptions.tuned(0.01))
    way = 4e-5 / DT * interval * np.array([0.0, 1.0])
    for done in followed(formulation, straight(thread), lambda k: k * way, int(300 * DT / interval), interval):
        rows = formulation.margins(done.state.positions, east())[-2]
        assert rows.value[rows.nodes[:, 0] > 0].min(initial=1.0) > -5e-6
        assert stretch(thread, done.state.positions) < 0.3


def test_no_gain_is_higher_than_one_over_the_step_and_the_walls_barrier_is_linear():
    thread, solver, wall = polyamide(), Listening(), 0.01
    workspace = Workspace((), 0.01, 2, wall)
    options = PaperOptions(gain=30.0, stiffness_gain=20.0)
    formulation = PaperFormulation(thread, workspace, solver, TOLERANCE, options)
    unit, radius = thread.segment_length, 0.5 * thread.diameter
    positions = straight(thread) + np.array([0.0095, 0.0])
    positions[3:6, 1] += 1e-4
    formulation.step(ThreadState.at_rest(positions), lead(positions[0]), 0.1)
    program, x = solver.programs[0], positions / unit
    rows = [Connectivity(1.0).rows(x), EnhancedConnectivity(1.0).rows(x), Stiffness(np.full(24, 2.0)).rows(x)]
    values = np.concatenate([each.value for each in rows])
    np.testing.assert_allclose(program.lower[:73], -10.0 * values, atol=1e-9)
    away = np.linalg.norm(positions[1:], axis=1)
    near = np.flatnonzero(wall - away < unit)
    assert len(program.lower) - 73 == len(near) == 1
    np.testing.assert_allclose(program.lower[73:], -10.0 * (wall - radius - away[near]) / unit, rtol=1e-9)


class Lazy(Listening):
    """Finds every program solved by a thread that stays where it is."""

    def solve(
        self, program: ChainProgram, velocities: np.ndarray, multipliers: Vector, wide: WideRows | None = None
    ) -> Solution:
        """Return no motion."""
        still = np.zeros_like(velocities), np.zeros(len(program.first))
        return Solution(*still, self.name, "solved", 1, Residuals(0.0, 0.0, 0.0))


def test_a_step_that_does_not_take_a_node_out_of_an_obstacle_has_not_converged():
    thread, options = polyamide(), PaperOptions(gain=1.0 / DT)
    formulation = PaperFormulation(thread, Workspace((Disc((-0.009, 0.0), 0.001),), 0.01), Lazy(), TOLERANCE, options)
    done = formulation.step(ThreadState.at_rest(straight(thread)), lead(np.zeros(2)), DT)
    assert not done.converged


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


class Lying(Listening):
    """Says that it solved what it did not."""

    def solve(
        self, program: ChainProgram, velocities: np.ndarray, multipliers: Vector, wide: WideRows | None = None
    ) -> Solution:
        """Return a solution with a bad residual."""
        return super().solve(program, velocities, multipliers, wide)._replace(residuals=Residuals(1.0, 0.0, 0.0))


def test_a_solution_is_refused_by_its_residual():
    thread = polyamide()
    formulation = PaperFormulation(thread, Workspace((), 0.01), Lying(), TOLERANCE)
    with pytest.raises(SolverError):
        formulation.step(ThreadState.at_rest(straight(thread)), lead(np.zeros(2)), DT)
