"""Rows of contacts: when they need not be looked for again, and more of them than there is room for."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from magnetosuture_thread import NeedlePose, Scene, SceneShape, SolverError, ThreadForecaster, ThreadPredictor
from magnetosuture_thread.estimator.association import MeasuredPoints
from magnetosuture_thread.estimator.correction import Corrector, Prior
from magnetosuture_thread.geometry.obstacles import Disc, Polygon, Workspace
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.scene import Dish
from magnetosuture_thread.thread.contact_rows import (
    DEPTH_TOLERANCE,
    contact_rows,
    stays_clear,
)
from magnetosuture_thread.thread.program import CONTACTS_PER_NODE, StepBuffers
from magnetosuture_thread.thread.rod import RodFormulation
from test.thread.scenes import polyamide

NODES, UNIT, RADIUS = 20, 1e-3, 5e-5
EAST = np.array([1.0, 0.0])
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
    rng, buffers, again = np.random.default_rng(7), StepBuffers.of(NODES, 2, 0), StepBuffers.of(NODES, 2, 0)
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


CROWD = [Disc((-0.0095, 0.1001), 0.1)] * 100  # whose surfaces are within a segment of each node of the thread


def test_more_contacts_than_there_is_room_for_are_refused_and_the_thread_stays_where_it_was():
    """A step, a forecast and a correction have room for `CONTACTS_PER_NODE` a node; margins take any number."""
    thread = polyamide()
    predictor = ThreadPredictor(thread, Workspace(CROWD, UNIT))
    start = NeedlePose(0.0, np.zeros(2), EAST)
    before = predictor.start(start)
    assert len(before.margins["obstacle"]) == 100 * (thread.segments + 1) > CONTACTS_PER_NODE * (thread.segments + 1)
    moved = NeedlePose(0.02, 1e-5 * EAST, EAST)
    with pytest.raises(SolverError, match=f"more than {CONTACTS_PER_NODE * (thread.segments + 1)} contacts at once"):
        predictor.step(moved)
    assert predictor.pose is start
    assert predictor.state is not None
    np.testing.assert_array_equal(predictor.state.positions, before.positions)

    few = ThreadPredictor(thread, Workspace(CROWD[:10], UNIT))
    few.start(start)
    assert few.step(moved).converged

    scene = Scene(Dish(0.5), tuple(SceneShape(f"shape_{k}", "tissue", disc) for k, disc in enumerate(CROWD)))
    forecaster = ThreadForecaster(thread, scene)
    found = forecaster.forecast(forecaster.straight(start), 1e-3 * EAST, 0.1)
    assert "contacts at once" in found.problem
    assert len(found.vertices) == 1

    crowded = ThreadPredictor(thread, scene)
    assert isinstance(crowded.formulation, RodFormulation)
    density = np.full(thread.segments + 1, 1e-4)
    prior = Prior(before.positions / thread.segment_length, EAST, density, density, 2.0, 1.0)
    points = MeasuredPoints(np.arange(1.0, 20.0), *np.full((2, 19), 1e-3), *np.ones((2, 19)))
    refused = Corrector(crowded, crowded.formulation).solve(prior, points)
    assert f"more than {CONTACTS_PER_NODE} contacts a node" in refused.problem
