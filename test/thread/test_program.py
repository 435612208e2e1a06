"""The program, its residuals, and the solvers, judged by residuals that are computed apart from them."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.geometry.polyline import Vector
from magnetosuture_thread.thread.program import (
    ChainProgram,
    Residuals,
    Solution,
    Solver,
    no_far_rows,
    residuals_of,
)
from magnetosuture_thread.thread.solvers import BandedSolver, FallbackSolver, OsqpSolver


def one_node() -> ChainProgram:
    """Return: minimise x^2 + y^2 - 2 x - 4 y with x + y <= 1 and x >= 0; solved by x = 0, y = 1."""
    gradient = np.zeros((2, 3, 2))
    gradient[0, 0], gradient[1, 0] = (1.0, 1.0), (1.0, 0.0)
    return ChainProgram(
        blocks=np.tile(2.0 * np.eye(2), (3, 1, 1)),
        couplings=np.zeros((3, 3)),
        linear=np.array([[-2.0, -4.0], [0.0, 0.0], [0.0, 0.0]]),
        known=np.array([False, True, True]),
        first=np.zeros(2, dtype=np.int64),
        gradient=gradient,
        lower=np.array([-np.inf, 0.0]),
        upper=np.array([1.0, np.inf]),
        compliance=np.zeros(2),
        limit=np.full(2, np.inf),
        far_nodes=np.zeros((0, 1), np.int64),
        far_gradient=np.zeros((0, 1, 2)),
    )


def at(x: float, y: float) -> np.ndarray:
    """Return velocities of the one node."""
    return np.array([[x, y], [0.0, 0.0], [0.0, 0.0]])


def test_the_residuals_vanish_at_the_solution():
    assert residuals_of(one_node(), at(0.0, 1.0), np.array([-2.0, 0.0])).largest < 1e-15


@pytest.mark.parametrize(
    ("u", "multipliers", "which"),
    [
        (at(0.1, 1.0), [-2.0, 0.0], "primal"),  # outside
        (at(0.0, 1.0), [-1.0, 0.0], "dual"),  # forces out of balance
        (at(0.0, 0.5), [-3.0, 1.0], "complementarity"),  # pushes without touching
        (at(0.0, 1.0), [2.0, 0.0], "complementarity"),  # pushes on a bound that does not exist
        (at(float("nan"), 1.0), [-2.0, 0.0], "primal"),
        (at(0.0, 1.0), [float("inf"), 0.0], "primal"),
    ],
)
def test_the_residuals_see_every_fault(u: np.ndarray, multipliers: list[float], which: str):
    assert getattr(residuals_of(one_node(), u, np.array(multipliers)), which) > 0.03


def far_bound(compliance: float = 0.0) -> ChainProgram:
    """Return `one_node` with its bound x + y <= 1 as a row over the nodes 0 and 2."""
    program, infinite = one_node(), np.full(2, np.inf)
    return program._replace(
        lower=np.array([-np.inf, 0.0, -1.0]),
        upper=np.append(infinite, np.inf),
        compliance=np.array([0.0, 0.0, compliance]),
        limit=np.append(infinite, np.inf),
        far_nodes=np.array([[0, 2]]),
        far_gradient=np.array([[(-1.0, -1.0), (0.0, 0.0)]]),
    )


def test_residuals_of_a_row_over_nodes_far_apart_are_those_of_any_other():
    hard, soft = far_bound(), far_bound(0.5)
    assert residuals_of(hard, at(0.0, 1.0), np.array([0.0, 0.0, 2.0])).largest < 1e-15
    gives_way = at(1.0 / 3.0, 4.0 / 3.0), np.array([0.0, 0.0, 4.0 / 3.0])
    assert residuals_of(soft, *gives_way).largest < 1e-15
    assert residuals_of(hard, *gives_way).primal > 0.3
    assert residuals_of(hard, at(0.1, 1.0), np.array([0.0, 0.0, 2.0])).primal == pytest.approx(0.1 / 1.1)
    untouched = residuals_of(hard, at(0.0, 0.5), np.array([0.0, 1.0, 3.0]))
    assert untouched.dual < 1e-15
    assert untouched.complementarity > 0.3
    assert residuals_of(hard, at(1.0, 2.0), np.array([0.0, 0.0, -1.0])).complementarity > 0.3


def rubbing(limit: float, pull: float) -> ChainProgram:
    """Return: minimise x^2 + y^2 - pull x - 6 y with y <= 0, so N = 6, and friction of at most `limit` on x."""
    gradient = np.zeros((2, 3, 2))
    gradient[0, 0], gradient[1, 0] = (0.0, 1.0), (1.0, 0.0)
    return one_node()._replace(
        linear=np.array([[-pull, -6.0], [0.0, 0.0], [0.0, 0.0]]),
        gradient=gradient,
        lower=np.array([-np.inf, 0.0]),
        upper=np.zeros(2),
        limit=np.array([np.inf, limit]),
    )


@pytest.mark.parametrize("pull", [-4.0, -1.0, 1.0, 4.0])
def test_residuals_vanish_where_friction_holds_and_where_it_slides(pull: float):
    """The balance on x is 2 x - pull = F: F = -pull holds the node, else it slides against mu N = 1.8."""
    force = -float(np.clip(pull, -1.8, 1.8))
    found = residuals_of(rubbing(0.3 * 6.0, pull), at(0.5 * (pull + force), 0.0), np.array([-6.0, force]))
    assert found.largest < 1e-15


@pytest.mark.parametrize("excess", [1e-5, 0.1, 2.0])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_multiplier_beyond_the_friction_cone_is_a_dual_residual(excess: float, sign: float):
    """Friction beyond mu N holds the node with all forces in balance and no bound missed: only the cone tells."""
    limit = 0.3 * 6.0
    pull = sign * (limit + excess)
    multipliers = np.array([-6.0, -pull])
    assert residuals_of(rubbing(abs(pull), pull), at(0.0, 0.0), multipliers).largest < 1e-15
    found = residuals_of(rubbing(limit, pull), at(0.0, 0.0), multipliers)
    assert found.dual == pytest.approx(excess / 6.0, rel=1e-6)  # of the largest multiplier
    assert (found.primal, found.complementarity) == (0.0, 0.0)


@pytest.mark.parametrize("bound", ["lower", "upper"])
def test_a_bound_that_is_no_number_is_never_met(bound: str):
    program = one_node()
    broken = program._replace(**{bound: np.array([1.0, np.nan])})
    assert residuals_of(broken, at(0.0, 0.0), np.zeros(2)).largest == np.inf


def random_program(seed: int, dimension: int = 2, soft: bool = False) -> ChainProgram:
    """Return a feasible program with segments that are equations and contacts that are bounds."""
    random, nodes = np.random.default_rng(seed), 9
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
