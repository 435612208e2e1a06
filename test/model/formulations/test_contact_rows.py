"""Rows of contacts and friction: which of them push at first, when they need not be looked for again, and the slip."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely

from magnetosuture_thread.geometry.obstacles import Disc, Polygon, Workspace
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.formulations.contact_rows import DEPTH_TOLERANCE, contact_rows, stays_clear
from magnetosuture_thread.model.formulations.friction_rows import friction_of, friction_rows, keep_grips
from magnetosuture_thread.model.formulations.step_buffers import StepBuffers

NODES, UNIT, RADIUS = 20, 1e-3, 5e-5
ROUNDED = Polygon(
    tuple(map(tuple, shapely.normalize(shapely.box(-0.008, -0.011, 0.008, -0.003).buffer(0.003)).exterior.coords[:-1]))
)
WORKSPACE = Workspace((ROUNDED, Disc((0.0, 0.009), 0.007)), UNIT, wall_radius=0.03).data
NONE_KNOWN = np.zeros(NODES, dtype=np.bool_)


def rows_about(buffers: StepBuffers, about: Points) -> tuple[int, float]:
    return contact_rows(buffers, 0, WORKSPACE, about, about, NONE_KNOWN, 1.0, UNIT, RADIUS, True)


def thread_between(rng: np.random.Generator) -> Points:
    """Return a chain in units of its segments, in the gap between polygon and disc or beyond it."""
    turns = np.cumsum(rng.normal(0.0, 0.03, NODES - 1)) + rng.uniform(-0.03, 0.03)
    steps = np.column_stack([np.cos(turns), np.sin(turns)])
    start = np.array([-9.5, rng.uniform(0.1, 0.6)])
    return np.vstack([start, start + np.cumsum(steps, axis=0)])


def test_contacts_are_found_to_be_shallow_only_where_they_are():
    """After small motions the answer is that of all contacts, looked for again."""
    rng, buffers, again = np.random.default_rng(7), StepBuffers.of(NODES, 2, 0, 400), StepBuffers.of(NODES, 2, 0, 400)
    clear, deep = 0, 0
    for _ in range(600):
        before = thread_between(rng)
        found, depth = rows_about(buffers, before)
        assert found >= 0
        about = before + rng.normal(0.0, 10.0 ** rng.uniform(-4.0, -1.0), before.shape)
        # Most are far too deep or not at all: those in the polygon's side are moved to where it is close.
        _, depth = rows_about(again, about)
        about[:, 1] += (depth - DEPTH_TOLERANCE * rng.uniform(0.0, 2.0)) / UNIT
        _, depth = rows_about(again, about)
        assert stays_clear(buffers, WORKSPACE, before, about, NONE_KNOWN, UNIT, RADIUS) == (depth <= DEPTH_TOLERANCE)
        clear, deep = clear + (depth <= DEPTH_TOLERANCE), deep + (depth > DEPTH_TOLERANCE)
    assert min(clear, deep) > 100


def test_what_is_known_of_clearances_leaves_out_no_contact():
    rng, buffers, blind = np.random.default_rng(8), StepBuffers.of(NODES, 2, 0, 400), StepBuffers.of(NODES, 2, 0, 400)
    wide = Workspace((ROUNDED, Disc((0.0, 0.009), 0.007)), 20 * UNIT, wall_radius=0.03).data
    total = 0
    for _ in range(200):
        about = thread_between(rng)
        found, _ = rows_about(buffers, about)
        chords = {(buffers.node[c], round(buffers.place[c], 9)) for c in range(found) if buffers.place[c] > 0.0}
        # With a reach of 20 segments no chord is left out, and more are contacts; those that are near are the same.
        count, _ = contact_rows(blind, 0, wide, about, about, NONE_KNOWN, 1.0, UNIT, RADIUS, True)
        near = {
            (blind.node[c], round(blind.place[c], 9))
            for c in range(count)
            if blind.place[c] > 0.0 and blind.value[c] * UNIT + RADIUS <= 0.05 * UNIT
        }
        assert near <= chords
        total += len(near)
    assert total > 100


def test_of_many_corners_beside_a_chord_the_nearest_pushes_first():
    buffers = StepBuffers.of(NODES, 2, 0, 400)
    about = np.column_stack([np.arange(NODES) - 9.5, np.full(NODES, 0.05)])  # on the flat side of the polygon
    corner = np.array([8.0, -3.0]) + 3.0 * math.sqrt(0.5)  # then around its rounded corner
    about[-2:] = corner + 0.035 + 0.5 * np.array([[-1.0, 1.0], [1.0, -1.0]]) * math.sqrt(0.5)
    buffers.push[1, NODES - 2] = 7.0
    found, _ = rows_about(buffers, about)
    rows = [c for c in range(found) if buffers.node[c] == NODES - 2 and buffers.place[c] > 0.0]
    assert len(rows) > 1
    pushing = [c for c in rows if buffers.multipliers[c] > 0.0]
    assert pushing == [min(rows, key=lambda c: buffers.value[c])]
    assert buffers.multipliers[pushing[0]] == 7.0


def test_friction_beside_the_needle_is_of_the_slip_that_its_own_motion_makes():
    """A disc above pushes the first chord down at 0.4 of it; the needle's tail has moved by 0.05 D along x."""
    rough = Workspace((Disc((-0.4 * UNIT, 1e-3 + RADIUS), 1e-3),), UNIT, friction=(0.3,)).data
    buffers, nodes = StepBuffers.of(6, 2, 0, 100), np.column_stack([-np.arange(6.0), np.zeros(6)])
    known, before, interval = np.arange(6) == 0, nodes.copy(), 0.5
    before[0, 0] -= 0.05

    def contacts() -> int:
        return contact_rows(buffers, 0, rough, nodes, nodes, known, interval, UNIT, RADIUS, True)[0]

    count = contacts()
    pushed = int(np.flatnonzero(np.isclose(buffers.place[:count], 0.4) & (buffers.node[:count] == 0))[0])
    np.testing.assert_allclose(buffers.gradient[pushed], [(0.0, 0.0), (0.0, -0.4), (0.0, 0.0)], atol=1e-12)
    assert buffers.compliance[pushed] > 0.0  # its ends may be held on both sides of a shape
    keep_grips(buffers, 2.0 * np.eye(count)[pushed], 0, rough)
    assert contacts() == count
    assert friction_rows(buffers, 0, count, rough, before, nodes, known, interval) == (1, 1.0)
    # The tangent, to the left of the normal (0, -1), is along x; the place of contact moves by 0.6 of the tail.
    assert buffers.limit[count] == pytest.approx(0.3 * 2.0)
    assert buffers.lower[count] == buffers.upper[count] == pytest.approx(-0.6 * 0.05 / interval)
    np.testing.assert_allclose(buffers.gradient[count], [(0.0, 0.0), (0.4, 0.0), (0.0, 0.0)], atol=1e-12)
    keep_grips(buffers, np.append(2.0 * np.eye(count)[pushed], -0.3), 0, rough)
    friction, use = friction_of(buffers.grip)
    np.testing.assert_allclose(friction, [0.6 * 0.3, 0.4 * 0.3, 0.0, 0.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(use, [0.5, 0.5, 0.0, 0.0, 0.0, 0.0])
    contacts()
    assert friction_rows(buffers, 0, count, rough, before, nodes, known, interval) == (1, 0.0)
    assert buffers.multipliers[count] == pytest.approx(-0.3)
    # A shape that pushes no more rubs no more, which is a change.
    assert friction_rows(buffers, 0, 0, rough, before, nodes, known, interval) == (0, 1.0)


def test_a_chord_beside_the_needle_that_gets_too_deep_is_noticed():
    post = Workspace((Disc((-0.4 * UNIT, 0.45 * UNIT), 0.2 * UNIT),), UNIT).data
    buffers, nodes, known = (
        StepBuffers.of(6, 2, 0, 100),
        np.column_stack([-np.arange(6.0), np.zeros(6)]),
        np.arange(6) == 0,
    )
    contact_rows(buffers, 0, post, nodes, nodes, known, 1.0, UNIT, RADIUS, True)
    turned = nodes + np.array([(0.0, 0.0), (0.0, 0.8), *[(0.0, 1.2)] * 4])
    assert not stays_clear(buffers, post, nodes, turned, known, UNIT, RADIUS)
    contact_rows(buffers, 0, post, nodes, nodes, known, 1.0, UNIT, RADIUS, True)
    assert stays_clear(buffers, post, nodes, nodes - 0.1, known, UNIT, RADIUS)
    contact_rows(buffers, 0, post, nodes, nodes, np.arange(6) < 2, 1.0, UNIT, RADIUS, True)
    assert stays_clear(buffers, post, nodes, turned, np.arange(6) < 2, UNIT, RADIUS)  # which nothing can push
