"""The program and its residual."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from magnetosuture_thread.model.program import QuadraticProgram, SparsePattern, optimality_residual


def small_program() -> QuadraticProgram:
    """Return: minimise x^2 + y^2 - 2 x - 4 y with x + y <= 1 and x >= 0; solved by x = 0, y = 1."""
    return QuadraticProgram(
        P=sp.csc_matrix(np.diag([2.0, 2.0])),
        q=np.array([-2.0, -4.0]),
        A=sp.csc_matrix(np.array([[1.0, 1.0], [1.0, 0.0]])),
        lower=np.array([-np.inf, 0.0]),
        upper=np.array([1.0, np.inf]),
    )


def test_a_pattern_adds_up_what_falls_on_one_place():
    rows, columns = np.array([0, 2, 0, 1]), np.array([1, 0, 1, 1])
    pattern = SparsePattern(rows, columns, (3, 2))
    for seed in range(3):
        entries = np.random.default_rng(seed).normal(size=4)
        expected = sp.coo_matrix((entries, (rows, columns)), shape=(3, 2)).toarray()
        np.testing.assert_allclose(pattern.matrix(entries).toarray(), expected)
    assert pattern.matrix(np.ones(4)).has_sorted_indices


def test_the_residual_vanishes_at_the_solution():
    assert optimality_residual(small_program(), np.array([0.0, 1.0]), np.array([2.0, 0.0])) < 1e-15


def test_a_far_bound_does_not_make_light_of_the_others():
    near = small_program()
    far = QuadraticProgram(
        near.P,
        near.q,
        sp.csc_matrix(np.vstack([near.A.toarray(), [0.0, 1.0]])),
        np.append(near.lower, -1e5),
        np.append(near.upper, np.inf),
    )
    outside = np.array([0.1, 1.0])
    expected = optimality_residual(near, outside, np.array([2.0, 0.0]))
    assert optimality_residual(far, outside, np.array([2.0, 0.0, 0.0])) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("u", "multipliers"),
    [
        ([0.1, 1.0], [2.0, 0.0]),  # outside
        ([-0.1, 1.1], [2.0, 0.0]),  # outside of the other
        ([0.0, 1.0], [1.0, 0.0]),  # forces out of balance
        ([0.0, 0.5], [3.0, -1.0]),  # pushes without touching
        ([float("nan"), 1.0], [2.0, 0.0]),
        ([0.0, 1.0], [float("inf"), 0.0]),
    ],
)
def test_the_residual_sees_every_fault(u: list[float], multipliers: list[float]):
    assert optimality_residual(small_program(), np.array(u), np.array(multipliers)) > 0.03
