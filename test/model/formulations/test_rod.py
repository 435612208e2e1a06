"""The formulation `rod`: closed forms, symmetry, obstacles, honesty."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from magnetosuture_thread.errors import ConfigurationError, SolverError
from magnetosuture_thread.geometry.obstacles import Disc, Polygon, Workspace
from magnetosuture_thread.model.formulations import (
    Formulation,
    PrescribedMotion,
    RodFormulation,
    StepResult,
    ThreadState,
)
from magnetosuture_thread.model.formulations.rod_step import MotionBuffers, StepInput, init_step
from magnetosuture_thread.model.formulations.step_buffers import StepBuffers
from magnetosuture_thread.model.program import ChainProgram, Residuals, Solution, Solver, Vector, WideRows
from magnetosuture_thread.model.solvers import BandedSolver, FallbackSolver
from magnetosuture_thread.model.thread import Attachment, Thread
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

OBSTACLE = 2  # the place of the obstacles among the margins


def clearance(formulation: Formulation, positions: np.ndarray) -> float:
    """Return the least distance of a node but the needle's from an obstacle."""
    rows = formulation.margins(positions, east(positions.shape[1]))[OBSTACLE]
    return float(rows.value[rows.nodes[:, 0] > 0].min(initial=np.inf))


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("attachment", list(Attachment))
def test_a_straight_thread_at_rest_stays(attachment: Attachment, dimension: int):
    thread = polyamide(attachment)
    start = straight(thread, dimension)
    for done in followed(formulated(thread, dimension=dimension), start, lambda _: np.zeros(dimension), 3):
        np.testing.assert_allclose(done.state.positions, start, atol=1e-12)
        assert done.residuals.largest < TOLERANCE


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


def test_a_bent_free_thread_straightens_and_keeps_its_length():
    thread = polyamide()
    for done in followed(formulated(thread), bent(thread), lambda _: np.zeros(2), 300):
        assert abs(stretch(thread, done.state.positions)) < 2e-3
    assert np.abs(turns(done.state.positions)).max() < 0.02 * 0.04


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


def test_the_first_guess_goes_on_as_before_unless_that_is_noise_or_too_far():
    unit, lead_node, end = polyamide().segment_length, np.array([0]), np.array([[1e-4, 2e-4]])
    start, velocities = straight(polyamide()), np.full((26, 2), 3.0 * unit)
    onwards, still = MotionBuffers.of(26, 2), MotionBuffers.of(26, 2)
    init_step(onwards, StepInput(start, velocities, lead_node, end, east(), DT, DT), unit)
    np.testing.assert_allclose(onwards.about[1:], start[1:] / unit + 3.0 * DT)
    np.testing.assert_array_equal(onwards.about[0], end[0] / unit)
    np.testing.assert_array_equal(onwards.known, np.arange(26) == 0)
    for last_interval, speeds in ((0.0, velocities), (0.1 * DT, velocities), (DT, 100.0 * velocities)):
        init_step(still, StepInput(start, speeds, lead_node, end, east(), DT, last_interval), unit)
        np.testing.assert_array_equal(still.about, still.start)
        np.testing.assert_array_equal(still.start[1:], start[1:] / unit)


def test_a_thread_pulled_hard_needs_no_more_than_a_few_solves():
    """Without the constraints' curvature the solves of a taut soft thread swing from side to side."""
    thread = silk()

    def way(k: int) -> np.ndarray:
        return np.array([5e-3 * math.sin(2.0 * k * DT), 8e-3 * (1.0 - math.cos(2.0 * k * DT))])

    steps = followed(formulated(thread), straight(thread), way, 60)
    assert max(done.solves for done in steps) <= 3
    assert np.mean([done.solves for done in steps]) < 1.2
    assert max(stretch(thread, done.state.positions) for done in steps) < 1e-3


SQUARE = Polygon(((-0.012, 0.001), (-0.008, 0.001), (-0.008, 0.005), (-0.012, 0.005)))
NOTCHED = Polygon(  # with a concave corner that the thread is drawn into
    ((-0.014, 0.004), (-0.010, 0.002), (-0.006, 0.004), (-0.006, 0.008), (-0.014, 0.008))
)


@pytest.mark.parametrize(
    "obstacles",
    [
        (Disc((-0.009, 0.0025), 0.0015),),
        (SQUARE,),
        (NOTCHED.smoothed(2e-4),),
        (Disc((-0.006, 0.003), 0.001), Disc((-0.0085, 0.0025), 0.001), SQUARE),
    ],
)
def test_a_thread_pushed_onto_obstacles_stays_outside_and_bears_on_them(obstacles: tuple[Disc | Polygon, ...]):
    thread = polyamide()
    formulation = formulated(thread, obstacles)
    touched = False
    for done in followed(formulation, straight(thread), lambda k: k * 4e-5 * np.array([0.0, 1.0]), 300):
        least = clearance(formulation, done.state.positions)
        assert least > -1e-6
        assert done.residuals.largest < TOLERANCE
        assert stretch(thread, done.state.positions) < 5e-3
        touched = touched or least < 1e-7
    assert touched


def test_in_space_a_thread_stays_outside_of_a_ball():
    thread, obstacle = polyamide(), Disc((-0.009, 0.003, 0.0002), 0.0015)
    formulation = formulated(thread, (obstacle,), dimension=3)
    touched = False
    way = np.array([0.0, 4e-5, 0.0])
    for done in followed(formulation, straight(thread, 3), lambda k: k * way, 200):
        least = clearance(formulation, done.state.positions)
        assert least > -1e-6
        touched = touched or least < 1e-7
    assert touched


@pytest.mark.parametrize("obstacle", [Disc((-0.01, 0.0005), 0.001), SQUARE.smoothed(2e-4)])
def test_nodes_that_start_inside_are_pushed_out(obstacle: Disc | Polygon):
    thread = polyamide()
    formulation = formulated(thread, (obstacle,))
    start = straight(thread) + np.array([0.0, 0.0015 if isinstance(obstacle, Polygon) else 0.0])
    assert clearance(formulation, start) < -4e-4
    last = followed(formulation, start, lambda _: start[0], 40)[-1]
    assert clearance(formulation, last.state.positions) > -1e-6
    assert stretch(thread, last.state.positions) < 5e-3


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


def test_two_neighbours_that_are_held_do_not_pull_at_the_others():
    """Nothing can change the length between them, so no tension may try: it would straighten what is near."""
    thread = polyamide(rest_curvature=300.0)
    start = bent(thread, 300.0 * thread.segment_length)
    moved = {}
    for held in ((12,), (12, 13)):
        formulation, state = formulated(thread), ThreadState.at_rest(start)
        drive = PrescribedMotion((0, *held), start[[0, *held]], east())
        for _ in range(60):
            state = formulation.step(state, drive, DT).state
        moved[held] = np.abs(state.positions - start).max()
    assert moved[(12, 13)] < 2.0 * moved[(12,)] + 1e-6


def test_a_thread_among_hundreds_of_obstacles_keeps_its_length():
    """More contacts than there is room for at first, and more of them while a step is solved."""
    thread = polyamide()
    beads = tuple(
        Disc((-0.001 - 0.0008 * i, sign * (0.00045 + 0.0001 * k)), 0.0004)
        for i in range(24) for sign in (-1.0, 1.0) for k in range(3)
    )  # fmt: skip
    formulation = formulated(thread, beads)
    for done in followed(formulation, straight(thread), lambda k: np.array([4e-5 * k, 0.0]), 60):
        lengths = np.linalg.norm(np.diff(done.state.positions, axis=0), axis=1) / thread.segment_length
        assert np.abs(lengths - 1.0).max() < 1e-2
        assert clearance(formulation, done.state.positions) > -1e-6


def test_memory_that_grows_keeps_the_chords_and_the_multipliers():
    memory = StepBuffers.of(6, 2, 5, 3)
    memory.chords[:], memory.multipliers[:], memory.push[:] = 0.9, 7.0, 3.0
    larger = memory.enlarged()
    assert len(larger.node) == 6
    np.testing.assert_array_equal(larger.chords, 0.9)
    np.testing.assert_array_equal(larger.multipliers[:5], 7.0)
    np.testing.assert_array_equal(larger.push, 3.0)


def test_a_thread_that_starts_anew_knows_nothing_of_the_last():
    thread = polyamide(Attachment.CLAMPED)
    used, fresh = formulated(thread), formulated(thread)
    state = ThreadState.at_rest(straight(thread))
    for step in range(1, 20):
        state = used.step(
            state, PrescribedMotion((0, 25), np.array([[1e-4 * step, 0.0], [-thread.length, 0.0]]), east()), DT
        ).state
    for formulation in (used, fresh):
        steps = followed(formulation, bent(thread), lambda k: k * 2e-5 * east(), 5)
        if formulation is used:
            again = steps
    for one, other in zip(again, steps, strict=True):
        np.testing.assert_array_equal(one.state.positions, other.state.positions)


def test_a_step_that_does_not_converge_says_so():
    """The needle is put half a thread away within one step, through a disc that cannot be passed."""
    thread = polyamide()
    formulation = formulated(thread, tuple(Disc((-0.005 + 0.0005 * k, 0.004), 0.001) for k in range(12)))
    done = formulation.step(ThreadState.at_rest(straight(thread)), lead(np.array([0.0, 0.0185])), 1e-3)
    assert not done.converged
    assert "not converged in 8 linearisations" in done.status


def test_ends_pulled_apart_by_more_than_the_thread_are_survived():
    """No thread is that long; what is published is the least stretch, and the margins say so."""
    thread = polyamide()
    formulation = formulated(thread)
    state = ThreadState.at_rest(straight(thread))
    for step in range(1, 30):
        drive = PrescribedMotion((0, 25), np.array([[1e-4 * step, 0.0], [-thread.length, 0.0]]), east())
        state = formulation.step(state, drive, DT).state
    lengths = np.linalg.norm(np.diff(state.positions, axis=0), axis=1)
    np.testing.assert_allclose(lengths, lengths.mean(), rtol=1e-3)
    assert formulation.margins(state.positions, east())[0].clearance.max() < 0.0


def test_margins_are_in_si_units():
    thread = polyamide()
    positions = straight(thread) * 1.1
    found, short, obstacle, _ = formulated(thread, (Disc((0.0, 0.01), 0.004),)).margins(positions, east())
    unit = thread.segment_length
    np.testing.assert_allclose(found.clearance, -0.1 * unit)
    np.testing.assert_allclose(short.value, 0.5 * 0.21 * unit**2)
    expected = np.hypot(positions[:, 0], 0.01) - 0.004 - 0.5 * thread.diameter
    np.testing.assert_allclose(obstacle.value, expected)
    np.testing.assert_array_equal(obstacle.nodes[:, 0], np.arange(26))


@pytest.mark.parametrize("solver", ["banded", "osqp"])
def test_both_solvers_step_alike(solver: str):
    thread = polyamide(Attachment.CLAMPED)
    obstacles = (Disc((-0.009, 0.0025), 0.0015),)

    def way(k: int) -> np.ndarray:
        return k * 6e-5 * np.array([0.3, 1.0])

    expected = followed(formulated(thread, obstacles), straight(thread), way, 60)[-1]
    found = followed(formulated(thread, obstacles, solver=solver), straight(thread), way, 60)[-1]
    assert found.solver == solver
    np.testing.assert_allclose(found.state.positions, expected.state.positions, atol=1e-8)


class LyingSolver:
    """Says that it solved a program that it did not solve."""

    name = "liar"

    def solve(
        self, program: ChainProgram, velocities: np.ndarray, multipliers: Vector, wide: WideRows | None = None
    ) -> Solution:
        """Return the truth, a little off, and its honest residual."""
        solution = BandedSolver().solve(program, velocities, multipliers, wide)
        return solution._replace(solver=self.name, residuals=Residuals(0.0, 2e-5, 0.0))


def test_a_solution_is_refused_by_its_residual_whatever_the_solver_says():
    thread = polyamide()
    formulation = RodFormulation(thread, Workspace((), 0.01), LyingSolver(), 1e-5)
    with pytest.raises(SolverError, match=r"liar ended with status 'solved' and residual 2\.0e-05"):
        formulation.step(ThreadState.at_rest(straight(thread)), lead(np.zeros(2)), DT)


class Hidden:
    """Solves with another solver, where compiled code cannot see it; under a name of its own, if it has one."""

    def __init__(self, solver: Solver, name: str = "") -> None:
        self._solver, self.name = solver, name or solver.name
        self._renames = bool(name)

    def solve(
        self, program: ChainProgram, velocities: np.ndarray, multipliers: Vector, wide: WideRows | None = None
    ) -> Solution:
        """Solve one program; see `Solver`."""
        solution = self._solver.solve(program, velocities, multipliers, wide)
        return solution._replace(solver=self.name) if self._renames else solution


def among_discs(solver: Solver) -> RodFormulation:
    """Return a formulation of a clamped thread with two discs beside it."""
    discs = tuple(Disc((-0.009 + 0.006 * k, 0.0025), 0.0015) for k in range(2))
    return RodFormulation(polyamide(Attachment.CLAMPED), Workspace(discs, 0.05), solver, TOLERANCE)


def assert_same(one: StepResult, other: StepResult) -> None:
    """Assert that two steps are the same to the last bit."""
    np.testing.assert_array_equal(one.state.positions, other.state.positions)
    np.testing.assert_array_equal(one.state.velocities, other.state.velocities)
    assert replace(one, state=other.state) == other


@pytest.mark.parametrize(("coarse", "strict"), [(BandedSolver(iterations=1), 1.0), (BandedSolver(0.1), 1e-4)])
def test_a_step_goes_on_with_the_other_solvers_where_compiled_code_leaves_it(coarse: BandedSolver, strict: float):
    """It fails now and then, or is good enough for the step, but not for who would ask the others."""
    thread = polyamide(Attachment.CLAMPED)
    both = FallbackSolver((coarse, Hidden(BandedSolver(), "second")), strict * TOLERANCE)
    steps, expected = (
        followed(among_discs(solver), straight(thread), lambda k: k * 6e-5 * np.array([0.3, 1.0]), 60)
        for solver in (both, Hidden(both))
    )
    for one, other in zip(steps, expected, strict=True):
        assert_same(one, other)
    helped = [done for done in steps if done.solver == "second"]
    assert 0 < len(helped) < len(steps)
    assert all("solved, after banded: " in done.status for done in helped)
    # Where contacts change, its first guess may be worse than none.
    alone = {done.status for done in steps if done.solver == "banded"}
    assert "solved" in alone
    assert alone <= {"solved", "solved, after banded: iteration limit"}


@pytest.mark.parametrize("hides", [False, True])
def test_a_step_that_failed_leaves_nothing_to_the_next(hides: bool):
    state = followed(among_discs(BandedSolver()), straight(polyamide()), lambda k: k * 6e-5 * east(), 20)[-1].state
    hasty = BandedSolver(iterations=2)
    used, fresh = (among_discs(Hidden(hasty) if hides else hasty) for _ in range(2))
    with pytest.raises(SolverError, match="banded ended with status 'iteration limit'"):
        used.step(state, lead(state.positions[0] + np.array([0.0, 3e-3])), DT)
    onwards = lead(state.positions[0] + 6e-5 * east())
    assert_same(used.step(state, onwards, DT), fresh.step(state, onwards, DT))


def test_a_step_that_needs_more_room_is_none_the_worse():
    thread, hundreds = polyamide(), tuple(Disc((-0.0004 * k, 0.0012), 0.0009) for k in range(80))
    grown, fresh = formulated(thread, hundreds), formulated(thread, hundreds)
    state = ThreadState.at_rest(straight(thread))
    room = vars(fresh)["_buffers"].node.size
    grown.step(state, lead(np.zeros(2)), DT)
    expected = grown.step(state, lead(np.array([6e-5, 0.0])), DT)
    assert_same(fresh.step(state, lead(np.array([6e-5, 0.0])), DT), expected)
    assert vars(fresh)["_buffers"].node.size > room


def test_a_step_keeps_its_memory_to_itself():
    """States that were given out or in stay as they are, whatever their layout."""
    formulation, thread = among_discs(BandedSolver()), polyamide()
    start = straight(thread)
    given = ThreadState(np.asfortranarray(start), np.asfortranarray(np.zeros_like(start)), DT)
    first = formulation.step(given, lead(np.array([6e-5, 0.0])), DT)
    kept = first.state.positions.copy(), first.state.velocities.copy()
    formulation.step(first.state, lead(np.array([2e-4, 0.0])), DT)
    np.testing.assert_array_equal(given.positions, start)
    np.testing.assert_array_equal(first.state.positions, kept[0])
    np.testing.assert_array_equal(first.state.velocities, kept[1])
    given = ThreadState(start, np.zeros_like(start), DT)
    assert_same(among_discs(BandedSolver()).step(given, lead(np.array([6e-5, 0.0])), DT), first)


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


def test_a_flow_must_have_a_value_for_each_dimension():
    thread = polyamide()
    with pytest.raises(ConfigurationError, match="2 values, or none"):
        formulated(replace(thread, medium=replace(thread.medium, flow=(1e-3, 0.0, 0.0))))
