"""The needle's own filter."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.errors import InvalidInputError, SolverError
from magnetosuture_thread.geometry.obstacles import Disc, Polygon, Surroundings
from magnetosuture_thread.model.needle import NeedleFilter
from magnetosuture_thread.model.program import Residuals, Solver
from magnetosuture_thread.model.solvers import BandedSolver, OsqpSolver

DISC = Disc((0.0, 0.0), 2e-3)
CORNER = Polygon(((0.0, 0.0), (0.01, 0.0), (0.01, 0.01), (0.005, 0.01), (0.005, 0.005), (0.0, 0.005)))  # an L


def filtered(
    obstacles: tuple[Disc | Polygon, ...], position: list[float], commanded: list[float], solver: Solver | None = None
) -> np.ndarray:
    """Return the safe velocity."""
    needle = NeedleFilter(Surroundings(obstacles, 5e-3), 2e-4, 20.0, solver or BandedSolver())
    return needle.safe_velocity(np.array(position), np.array(commanded))


def test_far_from_obstacles_the_needle_goes_where_it_is_told():
    np.testing.assert_allclose(filtered((DISC,), [9e-3, 0.0], [-5e-3, 1e-3]), [-5e-3, 1e-3], atol=1e-12)
    np.testing.assert_allclose(filtered((), [0.0, 0.0], [-5e-3, 1e-3]), [-5e-3, 1e-3], atol=1e-12)
    np.testing.assert_allclose(filtered((), [0.0, 0.0], [-5e-3, 1e-3], OsqpSolver()), [-5e-3, 1e-3], atol=1e-9)


def test_towards_an_obstacle_it_slows_down_and_slides_along():
    """H = 0.3 mm and alpha = 20 /s allow 6 mm/s inwards; on the surface nothing but sliding is allowed."""
    np.testing.assert_allclose(filtered((DISC,), [2.5e-3, 0.0], [-20e-3, 3e-3]), [-6e-3, 3e-3], atol=1e-9)
    np.testing.assert_allclose(filtered((DISC,), [2.2e-3, 0.0], [-20e-3, 3e-3]), [0.0, 3e-3], atol=1e-9)
    np.testing.assert_allclose(filtered((DISC,), [2.2e-3, 0.0], [20e-3, 3e-3]), [20e-3, 3e-3], atol=1e-9)


def test_in_a_concave_corner_it_stops():
    position = [0.005 - 2e-4, 0.005 + 2e-4]
    np.testing.assert_allclose(filtered((CORNER,), position, [5e-3, -5e-3]), [0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(filtered((CORNER,), position, [-5e-3, 5e-3]), [-5e-3, 5e-3], atol=1e-9)


@pytest.mark.parametrize("position", [[1.5e-3, 0.0], [2.1e-3, 0.0], [0.0, -1e-3]])
def test_from_outside_of_the_safe_set_it_comes_back(position: list[float]):
    """A needle inside of the obstacle, or too near to it, recovers whatever it is told."""
    where = np.array(position)
    inwards = -5e-3 * where / np.linalg.norm(where)
    for _ in range(200):
        where = where + 0.01 * filtered((DISC,), where.tolist(), inwards.tolist())
    assert np.linalg.norm(where) == pytest.approx(2.2e-3, abs=1e-6)


def test_driven_at_an_obstacle_for_long_it_never_enters():
    where = np.array([6e-3, 1e-4])
    for _ in range(2000):
        where = where + 0.005 * filtered((DISC,), where.tolist(), [-10e-3, 0.0])
        assert np.linalg.norm(where) > 2.2e-3 - 1e-9


def test_held_between_two_obstacles_that_overlap_it_does_not_fail():
    velocity = filtered((Disc((-1e-3, 0.0), 1.5e-3), Disc((1e-3, 0.0), 1.5e-3)), [0.0, 0.0], [0.0, 1e-3])
    assert np.isfinite(velocity).all()


def test_bad_input_and_bad_solutions_are_refused():
    with pytest.raises(InvalidInputError, match="needle velocity"):
        filtered((DISC,), [0.01, 0.0], [float("nan"), 0.0])
    with pytest.raises(InvalidInputError, match="needle position"):
        filtered((DISC,), [float("inf"), 0.0], [0.0, 0.0])

    class Lying(BandedSolver):
        def solve(self, *arguments):
            return super().solve(*arguments)._replace(residuals=Residuals(1.0, 0.0, 0.0))

    with pytest.raises(SolverError):
        NeedleFilter(Surroundings((DISC,), 5e-3), 0.0, 20.0, Lying()).safe_velocity(np.zeros(2), np.zeros(2))
