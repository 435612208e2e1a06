"""The benchmark measures what it says it does; how long anything takes is not tested."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.general_solvers import PEERS, PeerSolver
from benchmarks.solver import measure, run_case, timed
from benchmarks.track import SEGMENT, case
from magnetosuture_thread.geometry.obstacles import Disc, Polygon, Workspace, triangulate
from magnetosuture_thread.thread.solvers import BandedSolver


def test_rows_have_every_field_and_small_residuals():
    parts: list[float] = []
    rows = measure((12,), 12, 0.05, False, parts.append)
    assert json.loads(json.dumps(rows, allow_nan=False)) == rows
    names = {f"rod {part}, {name}" for part in ("step", "solve") for name in ("banded", "osqp")}
    names.add("predictor step with margins")
    systems = {(row["system"], row["n"], row["d"], row["obstacles"]) for row in rows}
    assert systems == {(name, 12, d, obstacles) for name in names for d in (2, 3) for obstacles in (0, 3)}
    for row in rows:
        assert 0.0 < row["median_s"] <= row["p99_s"]
        assert row["max_residual"] < (1e-4 if row["system"].endswith("osqp") else 1e-6)
    assert (parts[0], parts[-1]) == (0.0, 1.0)
    assert parts == sorted(parts)


@pytest.mark.parametrize("dimension", [2, 3])
def test_obstacles_have_200_triangles_and_are_met_by_the_thread_but_not_by_the_needle(dimension: int):
    motion = case(25, dimension, True, 60)
    assert len(motion.shapes) == 3
    for shape in motion.shapes:
        assert isinstance(shape, (Disc, Polygon))
        assert isinstance(shape, Disc) or len(triangulate(shape)) == 200
    workspace = Workspace(motion.shapes, 5e-3, dimension)
    assert workspace.near(motion.tails).distance.min() > 1e-4
    spy, positions = run_case(motion, BandedSolver())
    assert spy.pushed >= 30
    assert workspace.near(positions.reshape(-1, dimension)).distance.min() < motion.thread.diameter


@pytest.mark.parametrize("dimension", [2, 3])
def test_motion_is_of_the_speed_and_the_thread_of_the_length_that_it_should_be(dimension: int):
    motion = case(30, dimension, False, 40)
    steps = np.linalg.norm(np.diff(motion.tails, axis=0), axis=1)
    assert steps / motion.interval == pytest.approx(10e-3, rel=1e-3)
    np.testing.assert_allclose(np.linalg.norm(motion.headings, axis=1), 1.0)
    chords = np.linalg.norm(np.diff(motion.start, axis=0), axis=1)
    assert (chords <= SEGMENT * (1.0 + 1e-9)).all()
    assert (chords > 0.99 * SEGMENT).all()
    assert case(2000, dimension, False, 1).thread.length == pytest.approx(2.0)


@pytest.mark.parametrize("name", PEERS)
def test_general_solvers_agree_with_the_banded_one(name: str):
    pytest.importorskip(name)
    spy, _ = run_case(case(12, 2, True, 8), BandedSolver())
    for one in spy.captured:
        found, expected = PeerSolver(name).solve(*one), BandedSolver().solve(*one)
        assert found.residuals.largest < 1e-6
        np.testing.assert_allclose(found.velocities, expected.velocities, atol=1e-4)


def test_a_budget_ends_what_is_timed():
    assert len(timed([list] * 5, 10.0)[0]) == 5
    assert len(timed([list] * 5, -1.0)[1]) == 1
