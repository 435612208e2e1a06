"""The formulation `rod`: closed forms, symmetry, obstacles, honesty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from magnetosuture_thread.errors import SolverError
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.model.barriers import BarrierKind
from magnetosuture_thread.model.formulations import RodFormulation
from magnetosuture_thread.model.program import QuadraticProgram, Solution
from magnetosuture_thread.model.solvers import OsqpSolver
from magnetosuture_thread.model.thread import MATERIALS, Attachment, Thread

DT = 1.0 / 66.0
EAST = np.array([1.0, 0.0])


def polyamide(attachment: Attachment = Attachment.PINNED, segments: int = 25) -> Thread:
    """Return the paper's polyamide thread."""
    return Thread.of(MATERIALS["polyamide_7_0"], length=0.019, segments=segments, attachment=attachment)


def rod(thread: Thread, discs: tuple[Disc, ...] = (), dimension: int = 2) -> RodFormulation:
    """Return the formulation with OSQP."""
    return RodFormulation(thread, discs, OsqpSolver(), 1e-5, dimension)


def straight(thread: Thread, dimension: int = 2) -> np.ndarray:
    """Return a thread that lies straight behind a needle at the origin which points east."""
    positions = np.zeros((thread.segments + 1, dimension))
    positions[:, 0] = -thread.segment_length * np.arange(thread.segments + 1)
    return positions


def heading(dimension: int) -> np.ndarray:
    """Return east in any dimension."""
    return np.eye(dimension)[0]


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("attachment", list(Attachment))
def test_a_straight_thread_at_rest_stays(attachment: Attachment, dimension: int):
    thread = polyamide(attachment)
    start = straight(thread, dimension)
    done = rod(thread, dimension=dimension).step(start, np.zeros(dimension), heading(dimension), DT)
    np.testing.assert_allclose(done.positions, start, atol=1e-12)


def test_a_pulled_thread_follows_without_stretching():
    thread = polyamide()
    formulation, positions = rod(thread), straight(thread)
    for step in range(1, 67):
        positions = formulation.step(positions, step * DT * 5e-3 * EAST, EAST, DT).positions
    np.testing.assert_allclose(positions, straight(thread) + 5e-3 * EAST, atol=1e-7)


@pytest.mark.parametrize("attachment", list(Attachment))
def test_rotating_the_scene_rotates_the_answer(attachment: Attachment):
    thread, discs = polyamide(attachment), (Disc((-0.008, 0.0021), 0.002),)
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned = (Disc(tuple(turn @ discs[0].centre), 0.002),)
    one, other = rod(thread, discs), rod(thread, turned)
    first, second = straight(thread), straight(thread) @ turn.T
    for step in range(1, 40):
        tail = step * 8e-5 * np.array([0.0, 1.0])
        first = one.step(first, tail, EAST, DT).positions
        second = other.step(second, turn @ tail, turn @ EAST, DT).positions
    np.testing.assert_allclose(first @ turn.T, second, atol=2e-8)


def test_a_bent_free_thread_straightens_and_keeps_its_length():
    thread = polyamide()
    formulation, positions = rod(thread), straight(thread)
    angles = np.linspace(0.0, 1.0, thread.segments)
    positions[1:] = -np.cumsum(thread.segment_length * np.column_stack([np.cos(angles), np.sin(angles)]), axis=0)

    def bent(shape: np.ndarray) -> float:
        return float(np.linalg.norm(shape[2:] - 2 * shape[1:-1] + shape[:-2], axis=1).sum())

    before = bent(positions)
    for _ in range(200):
        positions = formulation.step(positions, np.zeros(2), EAST, DT).positions
        lengths = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        np.testing.assert_allclose(lengths, thread.segment_length, rtol=5e-3)
    assert bent(positions) < 0.02 * before


def test_a_clamped_thread_under_uniform_drag_bends_as_beam_theory_says():
    """A glued thread pulled sideways at speed V ends up as a cantilever under the load zeta_perp V.

    Its end then lags by zeta_perp V L^4 / (8 EI), for small deflections.
    """
    thread = polyamide(Attachment.GLUED, segments=50)
    speed = 0.02 * thread.length * 8.0 * thread.bending_stiffness / (thread.drag_across * thread.length**4)
    formulation, positions = rod(thread), straight(thread)
    sideways = np.array([0.0, 1.0])
    time, steps = 60.0, 900  # 7 times the slowest mode
    for step in range(1, steps + 1):
        positions = formulation.step(positions, step / steps * time * speed * sideways, EAST, time / steps).positions
    lag = positions[0, 1] - positions[-1, 1]
    assert lag == pytest.approx(0.02 * thread.length, rel=0.02)


def test_a_thread_pushed_onto_a_disc_stays_outside_of_it():
    thread, disc = polyamide(), Disc((-0.009, 0.002), 0.0015)
    formulation, positions = rod(thread, (disc,)), straight(thread)
    touched = False
    for step in range(1, 200):
        positions = formulation.step(positions, step * 4e-5 * np.array([0.0, 1.0]), EAST, DT).positions
        rows = formulation.margins(positions)[BarrierKind.OBSTACLE]
        assert rows.clearance.min() > -1e-6
        touched = touched or bool(rows.clearance.min() < 1e-7)
    assert touched


def test_a_node_that_starts_inside_is_pushed_out():
    thread, disc = polyamide(), Disc((-0.01, 0.0005), 0.001)
    formulation, positions = rod(thread, (disc,)), straight(thread)
    assert formulation.margins(positions)[BarrierKind.OBSTACLE].clearance.min() < -4e-4
    for _ in range(20):
        positions = formulation.step(positions, np.zeros(2), EAST, DT).positions
    assert formulation.margins(positions)[BarrierKind.OBSTACLE].clearance.min() > -1e-6


def test_margins_are_in_si_units():
    thread = polyamide()
    positions = straight(thread) * 1.1
    stretch, compression, obstacle = rod(thread, (Disc((0.0, 0.01), 0.004),)).margins(positions)
    unit = thread.segment_length
    np.testing.assert_allclose(stretch.clearance, -0.1 * unit)
    np.testing.assert_allclose(compression.value, 0.5 * 0.21 * unit**2)
    expected = np.hypot(positions[1:, 0], 0.01) - 0.004 - 0.5 * thread.diameter
    np.testing.assert_allclose(obstacle.value, expected)


class LyingSolver:
    """Says that it solved a program that it did not solve."""

    name = "liar"

    def solve(self, program: QuadraticProgram) -> Solution:
        """Return the truth, a little off, and its honest residual."""
        solution = OsqpSolver().solve(program)
        return replace(solution, solver=self.name, status="solved", residual=2e-5)


def test_a_solution_is_refused_by_its_residual_whatever_the_solver_says():
    thread = polyamide()
    formulation = RodFormulation(thread, (), LyingSolver(), 1e-5)
    with pytest.raises(SolverError, match=r"liar ended with status 'solved' and residual 2\.0e-05"):
        formulation.step(straight(thread), np.zeros(2), EAST, DT)
