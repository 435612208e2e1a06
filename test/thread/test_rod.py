"""The formulation `rod`: closed forms, symmetry, obstacles, honesty."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from magnetosuture_thread.geometry.obstacles import Disc, Workspace
from magnetosuture_thread.geometry.polyline import Vector
from magnetosuture_thread.settings.errors import SolverError
from magnetosuture_thread.thread.material import Attachment, Thread
from magnetosuture_thread.thread.program import ChainProgram, Residuals, Solution
from magnetosuture_thread.thread.rod import RodFormulation
from magnetosuture_thread.thread.solvers import BandedSolver
from magnetosuture_thread.thread.step import PrescribedMotion, ThreadState
from test.thread.scenes import DT, TOLERANCE, east, followed, formulated, lead, polyamide, silk, straight, stretch


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_pulled_thread_follows_without_stretching(dimension: int):
    thread = polyamide()
    steps = followed(
        formulated(thread, dimension=dimension),
        straight(thread, dimension),
        lambda k: k * DT * 5e-3 * east(dimension),
        66,
    )
    np.testing.assert_allclose(
        steps[-1].state.positions, straight(thread, dimension) + 5e-3 * east(dimension), atol=1e-7
    )
    assert steps[-1].solves == 1


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("attachment", list(Attachment))
def test_rotating_the_scene_rotates_the_answer(attachment: Attachment, dimension: int):
    thread = polyamide(attachment, rest_curvature=20.0)
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(dimension, dimension)))[0]
    if np.linalg.det(turn) < 0.0:
        turn[:, 0] *= -1.0  # a reflection would turn the rest shape over
    centre = np.array([-0.008, 0.0021, 0.0])[:dimension]
    here, there = Disc(tuple(centre), 0.002), Disc(tuple(turn @ centre), 0.002)
    way = np.array([1e-5, 8e-5, 2e-5])[:dimension]
    bent = straight(thread, dimension)
    bent[:, 1] += 1e-5 * np.arange(26) ** 1.5
    one = followed(formulated(thread, (here,), dimension=dimension), bent, lambda k: k * way, 40)
    other = followed(
        formulated(thread, (there,), dimension=dimension),
        bent @ turn.T,
        lambda k: k * turn @ way,
        40,
        DT,
        turn @ east(dimension),
    )
    for first, second in zip(one, other, strict=True):
        np.testing.assert_allclose(first.state.positions @ turn.T, second.state.positions, atol=2e-8)


def bent(thread: Thread, turn: float = 0.04) -> np.ndarray:
    """Return a thread that is bent into an arc."""
    angles = turn * np.arange(thread.segments)
    steps = -thread.segment_length * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])


def turns(positions: np.ndarray) -> np.ndarray:
    """Return the angle by which a thread turns at each inner node, positive to the left."""
    along = np.diff(positions, axis=0)
    angles = np.arctan2(along[:, 1], along[:, 0])
    return (np.diff(angles) + math.pi) % (2.0 * math.pi) - math.pi


@pytest.mark.parametrize("curvature", [-60.0, 60.0])
def test_a_free_thread_goes_to_its_rest_shape_and_stays_there(curvature: float):
    thread = polyamide(rest_curvature=curvature)
    done = followed(formulated(thread), straight(thread), lambda _: np.zeros(2), 900)
    expected = curvature * thread.segment_length
    np.testing.assert_allclose(turns(done[-1].state.positions), expected, rtol=2e-2)
    moved = np.abs(done[-1].state.velocities).max()
    assert moved < 2e-6


@pytest.mark.parametrize("segments", [25, 50])
def test_a_clamped_thread_under_uniform_drag_bends_as_beam_theory_says(segments: int):
    """A clamped thread pulled sideways at speed V ends up as a cantilever under the load zeta_perp V.

    Its end then lags by zeta_perp V L^4 / (8 EI), for small deflections.
    """
    thread = polyamide(Attachment.CLAMPED, segments)
    lag = 0.01 * thread.length
    speed = lag * 8.0 * thread.bending_stiffness / (thread.medium.drag_across * thread.length**4)
    time, steps = 60.0, 900  # 7 times the slowest mode
    way = time * speed * np.array([0.0, 1.0])
    last = followed(formulated(thread), straight(thread), lambda k: k / steps * way, steps, time / steps)[-1]
    found = last.state.positions[0, 1] - last.state.positions[-1, 1]
    assert found == pytest.approx(lag, rel=1e-3)


def test_a_short_step_and_a_long_one_lead_to_the_same_place():
    thread = polyamide(Attachment.CLAMPED)
    positions = {}
    for steps in (40, 80, 160):
        path = 4e-3 * np.array([[k / steps, math.sin(2.0 * k / steps)] for k in range(steps + 1)])
        ends = followed(formulated(thread), straight(thread), path.__getitem__, steps, 0.6 / steps)
        positions[steps] = ends[-1].state.positions
    coarse = np.abs(positions[40] - positions[160]).max()
    fine = np.abs(positions[80] - positions[160]).max()
    assert fine < 0.4 * coarse  # of second order: a quarter, less what the finest is wrong by
    assert coarse < 2e-5


def test_a_thread_pulled_hard_needs_no_more_than_a_few_solves():
    """Without the constraints' curvature the solves of a taut soft thread swing from side to side."""
    thread = silk()

    def way(k: int) -> np.ndarray:
        return np.array([5e-3 * math.sin(2.0 * k * DT), 8e-3 * (1.0 - math.cos(2.0 * k * DT))])

    steps = followed(formulated(thread), straight(thread), way, 60)
    assert max(done.solves for done in steps) <= 3
    assert np.mean([done.solves for done in steps]) < 1.2
    assert max(stretch(thread, done.state.positions) for done in steps) < 1e-3


def test_held_nodes_stay_and_driven_nodes_go_where_they_are_told():
    thread = polyamide()
    formulation = formulated(thread)
    state = ThreadState.at_rest(straight(thread))
    held = state.positions[12].copy()
    for step in range(1, 60):
        tail = np.array([-4e-5 * step, 3e-5 * step])
        end = state.positions[25] + np.array([1e-5, -3e-5])
        drive = PrescribedMotion((0, 12, 25), np.array([tail, held, end]), east())
        done = formulation.step(state, drive, DT)
        state = done.state
        np.testing.assert_allclose(state.positions[[0, 12, 25]], [tail, held, end], atol=1e-15)
        assert done.residuals.largest < TOLERANCE
        assert stretch(thread, state.positions) < 5e-3


def test_a_step_that_does_not_converge_says_so():
    """The needle is put half a thread away within one step, through a disc that cannot be passed."""
    thread = polyamide()
    formulation = formulated(thread, tuple(Disc((-0.005 + 0.0005 * k, 0.004), 0.001) for k in range(12)))
    done = formulation.step(ThreadState.at_rest(straight(thread)), lead(np.array([0.0, 0.0185])), 1e-3)
    assert not done.converged
    assert "not converged in 8 linearisations" in done.status


class LyingSolver:
    """Says that it solved a program that it did not solve."""

    name = "liar"

    def solve(self, program: ChainProgram, velocities: np.ndarray, multipliers: Vector) -> Solution:
        """Return the truth, a little off, and its honest residual."""
        solution = BandedSolver().solve(program, velocities, multipliers)
        return solution._replace(solver=self.name, residuals=Residuals(0.0, 2e-5, 0.0))


def test_a_solution_is_refused_by_its_residual_whatever_the_solver_says():
    thread = polyamide()
    formulation = RodFormulation(thread, Workspace((), 0.01), LyingSolver(), 1e-5)
    with pytest.raises(SolverError, match=r"liar ended with status 'solved' and residual 2\.0e-05"):
        formulation.step(ThreadState.at_rest(straight(thread)), lead(np.zeros(2)), DT)


@pytest.mark.parametrize("attachment", list(Attachment))
def test_a_flow_is_what_the_thread_sees_from_a_frame_that_moves_against_it(attachment: Attachment):
    """In a flow w behind a needle of velocity v a thread moves as in still liquid behind one of v - w, plus w t."""
    flow, velocity, turn = np.array([4e-4, -7e-4]), np.array([1.2e-3, 3e-4]), 0.8
    still = polyamide(attachment)
    moving = replace(still, medium=replace(still.medium, flow=tuple(flow)))
    first = straight(still)
    found = []
    for thread, carried in ((moving, np.zeros(2)), (still, flow)):
        formulation = formulated(thread)
        state = ThreadState(first, np.tile(-carried, (len(first), 1)), DT)  # at rest in the dish
        for step in range(1, 120):
            time = step * DT
            tail = first[0] + (velocity - carried) * time
            heading = np.array([np.cos(turn * time), np.sin(turn * time)])
            state = formulation.step(state, PrescribedMotion((0,), tail[None], heading), DT).state
        found.append(state.positions + carried * 119 * DT)
    np.testing.assert_allclose(found[0], found[1], atol=1e-8)
    assert np.abs(found[0] - first).max() > 1e-3
