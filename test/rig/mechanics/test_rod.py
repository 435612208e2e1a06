"""The terms of the discrete rod, its contacts and its banded solver."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.rig.contact import Shapes, Surface
from magnetosuture_thread.rig.dynamics import Bodies, Needle, add_clamp, add_needle
from magnetosuture_thread.rig.rod import (
    WIDTH,
    Rod,
    StepTerms,
    System,
    add_bending,
    add_contact,
    add_stretching,
    find_contacts,
)

Vector = NDArray[np.float64]
Term = Callable[[Vector, Vector, Vector, bool], float]
SEGMENTS, D = 7, 1e-3
ROD = Rod(D, 5.0, 1.3e-9, 0.97, 0.48, 3e-5)


def bent_state(seed: int = 0, turn: float = 0.3) -> Vector:
    """Return a heading and nodes of segments near the length D, each turned from the one before."""
    random = np.random.default_rng(seed)
    angle = math.pi + np.cumsum(random.normal(turn, 0.2, SEGMENTS))
    steps = D * (1.0 + random.normal(0.0, 1e-3, SEGMENTS))[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    nodes = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
    return np.concatenate([[0.1], nodes.ravel()])


def full(band: Vector) -> Vector:
    """Return the symmetric matrix of a band."""
    size = len(band)
    matrix = np.zeros((size, size))
    for i in range(size):
        for k in range(min(WIDTH, i + 1)):
            matrix[i, i - k] = matrix[i - k, i] = band[i, k]
    return matrix


def evaluated(term: Term, q: Vector, convex: bool = False) -> tuple[float, Vector, Vector]:
    gradient, band = np.zeros(len(q)), np.zeros((len(q), WIDTH))
    energy = term(q, gradient, band, convex)
    return energy, gradient, full(band)


def check_derivatives(term: Term, q: Vector, step: float = 1e-9) -> None:
    """Compare gradient and second derivatives with central differences; the convex part with its definiteness."""
    _, gradient, second = evaluated(term, q)
    assert gradient.any()
    steps = step * np.concatenate([[1e2], np.ones(len(q) - 1)])
    slope, slopes = np.zeros(len(q)), np.zeros((len(q), len(q)))
    for i in range(len(q)):
        move = np.zeros(len(q))
        move[i] = steps[i]
        (e1, g1, _), (e0, g0, _) = evaluated(term, q + move), evaluated(term, q - move)
        slope[i], slopes[i] = (e1 - e0) / (2.0 * steps[i]), (g1 - g0) / (2.0 * steps[i])
    # The heading's row is a torque; scale it to compare.
    scale = np.concatenate([[D], np.ones(len(q) - 1)])
    np.testing.assert_allclose(gradient / scale, slope / scale, atol=2e-5 * np.abs(gradient / scale).max())
    size = np.abs(second / np.outer(scale, scale)).max()
    np.testing.assert_allclose(second / np.outer(scale, scale), slopes / np.outer(scale, scale), atol=2e-5 * size)
    _, same, convex = evaluated(term, q, convex=True)
    np.testing.assert_array_equal(same, gradient)
    assert np.linalg.eigvalsh(convex / np.outer(scale, scale)).min() > -1e-9 * size


def contact_term(shapes: Shapes) -> Term:
    rows = np.zeros((50, 6))

    def term(q: Vector, gradient: Vector, band: Vector, convex: bool) -> float:
        return add_contact(q, shapes.stiffness, rows[: find_contacts(q, ROD, shapes, rows)], gradient, band, convex)

    return term


def test_stretching_and_bending_have_their_derivatives():
    check_derivatives(lambda q, g, b, c: add_stretching(q, ROD, g, b, c), bent_state())
    check_derivatives(lambda q, g, b, c: add_bending(q, ROD, g, b), bent_state(), 1e-7)


def test_the_needles_terms_have_their_derivatives():
    resistance = np.array([[3e-7, 2e-6, 4e-5], [2e-6, 2e-2, 1e-3], [4e-5, 1e-3, 3e-2]])
    outline = np.column_stack([np.linspace(0.0, 7e-3, 9), np.zeros(9)])
    needle = Needle(resistance, np.array([7e-3, 1e-4]), 0.13, outline, 2e-4, 1.3)
    shapes = Surface((Disc((4e-3, 1.6e-3), 1.1e-3),), wall_radius=7.1e-3).packed()
    q, field, empty, rows = bent_state(), np.array([[1e-2, -2e-2], [2e-2, -3e-2]]), np.zeros(0), np.zeros((3, 6))
    rest = q - np.concatenate([[1e-2], np.full(len(q) - 1, 1e-5)])
    bodies, terms = Bodies(needle, ROD, shapes), StepTerms(q, rest, rows, 500.0 * resistance, field, 0.0, rows)
    check_derivatives(lambda q, g, b, c: add_needle(q, bodies, terms, System(g, b, empty, rows), c), q)
    check_derivatives(lambda q, g, b, c: add_clamp(q, needle, D, g, b, c), q, 1e-7)


def test_contact_of_a_disc_the_wall_and_corners_has_its_derivatives():
    q = bent_state()
    nodes = q[1:].reshape(-1, 2)
    away = np.array([nodes[2, 1] - nodes[3, 1], nodes[3, 0] - nodes[2, 0]]) / D
    middle = 0.4 * nodes[2] + 0.6 * nodes[3]
    beside = Disc(tuple(middle + 1.95e-3 * away), 2e-3)
    check_derivatives(contact_term(Surface((beside,)).packed()), q)
    on_node = Disc(tuple(nodes[4] + [1e-3, 1e-3]), 1.43e-3)
    check_derivatives(contact_term(Surface((on_node,)).packed()), q)
    check_derivatives(contact_term(Surface(wall_radius=float(np.hypot(*nodes.T).max()) - 2e-5).packed()), q)
    # A corner that has cut through the segment, and one that is just within the thread's radius.
    for depth in (4e-5, -1e-5):
        corner = middle - depth * away
        wedge = np.array([corner, corner + 2e-3 * away + 5e-4 * away[::-1], corner + 2e-3 * away - 5e-4 * away[::-1]])
        check_derivatives(contact_term(Surface(polygons=(Polygon(tuple(map(tuple, wedge))),)).packed()), q)
