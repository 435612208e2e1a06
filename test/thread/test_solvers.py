"""The solvers, judged by residuals that are computed apart from them, and against each other."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.thread.program import ChainProgram, Residuals, Solution, Solver, Vector, no_far_rows
from magnetosuture_thread.thread.solvers import BandedSolver, FallbackSolver, OsqpSolver
from test.thread.test_program import one_node


def random_program(seed: int, nodes: int = 9, dimension: int = 2, soft: bool = False) -> ChainProgram:
    """Return a feasible program with segments that are equations and contacts that are bounds."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(nodes, dimension, dimension))
    blocks = root @ root.transpose(0, 2, 1) + 8.0 * np.eye(dimension)
    couplings = random.uniform(-1.0, 1.0, (3, nodes))
    rows = 2 * nodes
    gradient = random.normal(size=(rows, 3, dimension))
    gradient[nodes:, 1:] = 0.0
    first = np.concatenate([np.arange(nodes), random.permutation(nodes)]).clip(0, nodes - 3)
    inside = random.normal(size=(nodes, dimension))
    known = np.arange(nodes) % 7 == 0
    inside[known] = 0.0
    image = np.einsum("rkd,rkd->r", gradient, inside[first[:, None] + np.arange(3)])
    lower, upper = image - random.uniform(0.0, 1.0, rows), np.full(rows, np.inf)
    lower[:3] = upper[:3] = image[:3]
    upper[3:6] = image[3:6] + 0.1
    compliance = np.where(np.arange(rows) % 2 == 0, 1e-3, 0.0) if soft else np.zeros(rows)
    linear = 10.0 * random.normal(size=(nodes, dimension))
    limit = np.full(rows, np.inf)
    return ChainProgram(
        blocks, couplings, linear, known, first, gradient, lower, upper, compliance, limit, *no_far_rows(dimension)
    )


def solved(solver: Solver, program: ChainProgram) -> Solution:
    """Return the solution from a cold start."""
    return solver.solve(program, np.zeros_like(program.linear), np.zeros(len(program.lower)))


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("soft", [False, True])
def test_both_solvers_agree(dimension: int, soft: bool):
    for seed in range(20):
        program = random_program(seed, dimension=dimension, soft=soft)
        banded, osqp = solved(BandedSolver(), program), solved(OsqpSolver(), program)
        assert banded.status == osqp.status == "solved"
        assert banded.residuals.largest < 1e-7
        assert osqp.residuals.largest < 1e-5
        np.testing.assert_allclose(banded.velocities, osqp.velocities, atol=1e-4)
        assert (banded.velocities[program.known] == 0.0).all()


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("compliance", [0.0, 0.05])
def test_rows_over_nodes_far_apart_are_solved_as_by_a_general_solver(dimension: int, compliance: float):
    """They forbid the solution without them, and allow that of other forces."""
    nodes, pushed = np.array([[1, 4, 8], [2, 3, 5], [8, 6, 2]]), 0
    for seed in range(10):
        program, random = random_program(seed, dimension=dimension), np.random.default_rng(seed)
        other = program._replace(linear=10.0 * random.normal(size=program.linear.shape))
        gradient = random.normal(size=(3, 3, dimension))
        here, there = (
            np.einsum("rkd,rkd->r", gradient, solved(BandedSolver(), each).velocities[nodes])
            for each in (program, other)
        )
        side, more = np.sign(there - here), np.full(3, np.inf)
        far = program._replace(
            lower=np.append(program.lower, side * (0.1 * here + 0.9 * there)),
            upper=np.append(program.upper, more),
            compliance=np.append(program.compliance, np.full(3, compliance)),
            limit=np.append(program.limit, more),
            far_nodes=nodes,
            far_gradient=side[:, None, None] * gradient,
        )
        found, expected = solved(BandedSolver(), far), solved(OsqpSolver(), far)
        assert found.status == expected.status == "solved"
        assert found.residuals.largest < 1e-7
        assert expected.residuals.largest < 1e-5
        np.testing.assert_allclose(found.velocities, expected.velocities, atol=1e-4)
        pushed += int((found.multipliers[-3:] > 1e-3).sum())
    assert pushed > 15


def test_a_bad_guess_is_as_good_as_none():
    program, random = random_program(5, nodes=40), np.random.default_rng(0)
    solver = BandedSolver()
    expected = solved(solver, program)
    for _ in range(20):
        guess = 1e3 * random.normal(size=program.linear.shape)
        push = 1e4 * random.normal(size=len(program.first)) * random.integers(0, 2, len(program.first))
        found = solver.solve(program, guess, push)
        assert found.residuals.largest < 1e-6
        np.testing.assert_allclose(found.velocities, expected.velocities, atol=1e-5)


def infeasible() -> ChainProgram:
    """Return a program that asks for x >= 1 and x <= 0."""
    program = one_node()
    gradient = program.gradient.copy()
    gradient[:, 0] = (1.0, 0.0)
    return program._replace(gradient=gradient, lower=np.array([1.0, -np.inf]), upper=np.array([np.inf, 0.0]))


def nothing() -> ChainProgram:
    """Return a program with a NaN."""
    program = one_node()
    return program._replace(linear=np.full_like(program.linear, np.nan))


def indefinite() -> ChainProgram:
    """Return a program without a least value."""
    program = one_node()
    return program._replace(blocks=-program.blocks, lower=np.full(2, -np.inf), upper=np.full(2, np.inf))


@pytest.mark.parametrize("solver", [BandedSolver(), OsqpSolver()], ids=lambda solver: solver.name)
@pytest.mark.parametrize("program", [infeasible(), nothing(), indefinite()])
def test_what_cannot_be_solved_is_said_so_and_the_next_program_is_solved(
    solver: Solver, program: ChainProgram, capfd: pytest.CaptureFixture[str]
):
    bad = solved(solver, program)
    assert bad.status != "solved"
    assert bad.residuals.largest > 1e-2
    assert solved(solver, random_program(2)).residuals.largest < 1e-5


class Named:
    """A solver that gives what it is told to."""

    def __init__(self, name: str, status: str, residual: float) -> None:
        self.name, self._status, self._residual = name, status, residual
        self.guesses: list[float] = []

    def solve(self, program: ChainProgram, velocities: np.ndarray, multipliers: Vector) -> Solution:
        """Return a solution with the residual."""
        self.guesses.append(float(np.abs(velocities).max()))
        residuals = Residuals(self._residual, 0.0, 0.0)
        return Solution(velocities, multipliers, self.name, self._status, 1, residuals)


def attempt(*solvers: Named) -> Solution:
    """Solve with a warm start."""
    program = one_node()
    return FallbackSolver(solvers, 1e-6).solve(program, np.ones_like(program.linear), np.ones(2))


def test_a_failed_check_falls_back_to_a_cold_start_then_to_the_next_solver_and_says_so():
    first, second = Named("first", "iteration limit", 1e-3), Named("second", "solved", 1e-9)
    found = attempt(first, second)
    assert found.solver == "second"
    assert found.status == "solved, after first: iteration limit, first from a cold start: iteration limit"
    assert first.guesses == [1.0, 0.0]
    assert second.guesses == [0.0]
