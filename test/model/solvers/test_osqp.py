"""OSQP as a solver, judged by residuals that are computed apart from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from magnetosuture_thread.model.program import QuadraticProgram
from magnetosuture_thread.model.solvers import OsqpSolver


def random_program(seed: int) -> QuadraticProgram:
    """Return a feasible program; all seeds share one pattern."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(6, 6))
    hessian = root @ root.T + np.eye(6)
    rows = random.normal(size=(8, 6))
    inside = rows @ random.normal(size=6)
    lower = inside - random.uniform(0.0, 0.2, 8)
    upper = inside + random.uniform(0.0, 0.2, 8)
    lower[:2] = upper[:2] = inside[:2]
    upper[6:] = np.inf
    return QuadraticProgram(sp.csc_matrix(np.triu(hessian)), random.normal(size=6), sp.csc_matrix(rows), lower, upper)


def test_programs_of_one_pattern_are_solved_one_after_the_other():
    solver = OsqpSolver()
    for seed in range(20):
        solution = solver.solve(random_program(seed))
        assert solution.status == "solved"
        assert solution.residual < 1e-6


def test_another_pattern_is_set_up_anew():
    solver = OsqpSolver()
    solver.solve(random_program(0))
    small = QuadraticProgram(
        sp.csc_matrix(np.eye(2)), np.zeros(2), sp.csc_matrix(np.eye(2)), np.ones(2), np.full(2, np.inf)
    )
    assert solver.solve(small).u == pytest.approx([1.0, 1.0])


def test_what_osqp_refuses_is_no_solution_and_the_next_program_is_solved():
    solver, broken = OsqpSolver(), random_program(0)
    solver.solve(random_program(1))
    absurd = QuadraticProgram(broken.P, broken.q, broken.A, broken.upper + 1.0, broken.lower)  # bounds swapped
    refused = solver.solve(absurd)
    assert refused.residual > 0.1
    nothing = replace(broken, q=np.full(6, np.nan))
    assert solver.solve(nothing).residual == np.inf
    assert solver.solve(random_program(2)).residual < 1e-6


def test_an_infeasible_program_has_no_small_residual():
    rows = sp.csc_matrix(np.array([[1.0], [1.0]]))
    infeasible = QuadraticProgram(
        sp.csc_matrix(np.eye(1)), np.zeros(1), rows, np.array([1.0, -np.inf]), np.array([np.inf, 0.0])
    )
    assert OsqpSolver().solve(infeasible).residual > 1e-2
