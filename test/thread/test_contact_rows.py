"""Rows of contacts and friction: which of them push at first, when they need not be looked for again, and the slip."""

from __future__ import annotations

import numpy as np
import shapely

from magnetosuture_thread.geometry.obstacles import Disc, Polygon, Workspace
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread.contact_rows import (
    DEPTH_TOLERANCE,
    contact_rows,
    stays_clear,
)
from magnetosuture_thread.thread.program import StepBuffers

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
