"""The needle's own filter."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.errors import InvalidInputError, SolverError
from magnetosuture_thread.geometry.arc import needle_points
from magnetosuture_thread.geometry.obstacles import Disc, Polygon, Surroundings
from magnetosuture_thread.model.needle import NeedleFilter
from magnetosuture_thread.model.program import Residuals, Solver
from magnetosuture_thread.model.solvers import BandedSolver, OsqpSolver

DISC = Disc((0.0, 0.0), 2e-3)
EAST = np.array([1.0, 0.0])
CORNER = Polygon(((0.0, 0.0), (0.01, 0.0), (0.01, 0.01), (0.005, 0.01), (0.005, 0.005), (0.0, 0.005)))  # an L


def filtered(
    obstacles: tuple[Disc | Polygon, ...], position: list[float], commanded: list[float], solver: Solver | None = None
) -> np.ndarray:
    """Return the safe velocity."""
    needle = NeedleFilter(Surroundings(obstacles, 5e-3), 2e-4, 20.0, solver or BandedSolver())
    return needle.safe_velocity(np.array(position), EAST, np.array(commanded))


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
    """A needle inside of the obstacle, or too near to it, leaves at a tenth of the speed, whatever way it is told."""
    where = np.array(position)
    inwards = -5e-3 * where / np.linalg.norm(where)
    assert np.linalg.norm(filtered((DISC,), position, inwards.tolist())) == pytest.approx(5e-4, rel=0.02)
    for _ in range(400):
        where = where + 0.01 * filtered((DISC,), where.tolist(), inwards.tolist())
    assert np.linalg.norm(where) == pytest.approx(2.2e-3, abs=1e-6)


def test_it_leaves_no_faster_than_it_would_approach():
    """0.01 mm too near: 20 / s times that, and not a tenth of 20 mm/s; a thousandth of the speed is given way."""
    found = filtered((DISC,), [2.19e-3, 0.0], [-20e-3, 0.0])
    np.testing.assert_allclose(found, [2e-4, 0.0], atol=1.01e-3 * 20e-3)


@pytest.mark.parametrize("position", [[1.5e-3, 0.0], [2.1e-3, 0.0], [2.2e-3, 0.0], [2.5e-3, 0.0]])
def test_nobody_but_a_command_moves_the_needle(position: list[float]):
    np.testing.assert_array_equal(filtered((DISC,), position, [0.0, 0.0]), [0.0, 0.0])


@pytest.mark.parametrize("curvature", [0.0, 150.0, -150.0])
def test_no_point_of_a_needle_enters(curvature: float):
    """Driven and turned at random for long, next to a disc and in the corner of an L."""
    random = np.random.default_rng(5)
    surroundings = Surroundings((Disc((0.0, 9.5e-3), 1e-3), CORNER), 5e-3)
    needle = NeedleFilter(surroundings, 2e-4, 20.0, BandedSolver(), length=4e-3, curvature=curvature)
    body = needle_points(4e-3, curvature, 2.5e-4)
    tail, angle, least = np.array([-2e-3, 7e-3]), 0.0, np.inf
    asked = np.zeros(2)
    for k in range(3000):
        if k % 40 == 0:
            asked = random.uniform(-8e-3, 8e-3, 2) + (np.array([2e-3, 7e-3]) - tail)
        heading = np.array([np.cos(angle), np.sin(angle)])
        velocity = needle.safe_velocity(tail, heading, asked)
        points, turning, chord = body.turned(heading)
        across = np.array([-chord[1], chord[0]])
        turned = (velocity @ across) / (0.5 * np.linalg.norm(points[-1]))
        tail = tail + 2e-3 * ((velocity @ chord) * chord + (velocity @ across) * turning[0])
        angle += 2e-3 * turned
        least = min(least, float(surroundings.near(tail + body.turned(heading)[0]).distance.min(initial=1.0)))
    assert 0.0 < least < 3e-4  # it came near, and kept off


@pytest.mark.parametrize("length", [0.0, 2.5e-3, 7e-3])
def test_it_never_goes_faster_than_it_is_told_nor_away_from_where_it_is_safe(length: float):
    """In a channel of two walls and before a disc, wherever it lies, in them too."""
    walls = tuple(Polygon(((-0.01, y), (0.01, y), (0.01, y + 4e-3), (-0.01, y + 4e-3))) for y in (-5e-3, 1e-3))
    surroundings = Surroundings((*walls, Disc((0.012, 0.0), 2e-3)), 5e-3)
    needle = NeedleFilter(surroundings, 2e-4, 20.0, BandedSolver(), length=length, curvature=100.0)
    random = np.random.default_rng(3)
    unsafe = 0
    for _ in range(600):
        angle, tail, asked = random.uniform(0.0, 7.0), random.uniform(-0.014, 0.014, 2), random.uniform(-0.02, 0.02, 2)
        heading = np.array([np.cos(angle), np.sin(angle)])
        passed = needle.safe_velocity(tail, heading, asked)
        assert np.linalg.norm(passed) <= np.linalg.norm(asked) * (1.0 + 1e-9)
        points = tail + needle_points(length, 100.0, 5e-4).turned(heading)[0] if length else tail[None]
        if surroundings.near(points).distance.min(initial=1.0) < 2e-4:
            unsafe += 1
        else:
            assert passed @ asked >= -1e-12
    assert 100 < unsafe < 500


def test_where_leaving_one_is_entering_another_it_only_goes_no_deeper():
    """What asks to leave may be more than the program can be solved with; what forbids never is."""

    class Overcharged(BandedSolver):
        def solve(self, program, *start):
            solution = super().solve(program, *start)
            return solution._replace(residuals=Residuals(1.0, 0.0, 0.0)) if program.compliance.any() else solution

    position = [0.0, 1.5e-3]
    np.testing.assert_allclose(filtered((DISC,), position, [2e-3, -3e-3], Overcharged()), [2e-3, 0.0], atol=1e-9)
    np.testing.assert_allclose(filtered((DISC,), position, [2e-3, 3e-3], Overcharged()), [2e-3, 3e-3], atol=1e-9)


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
        NeedleFilter(Surroundings((DISC,), 5e-3), 0.0, 20.0, Lying()).safe_velocity(np.zeros(2), EAST, np.zeros(2))
