"""The benchmark measures what it says it does; how long anything takes is not tested."""

from __future__ import annotations

import gc
import io
import json
import math
import sys

import numpy as np
import pytest
from rich.console import Console

from benchmarks.baselines.general_solvers import SOLVERS, converted, residuals_of_general
from benchmarks.baselines.simulators import error
from benchmarks.baselines.xpbd import XpbdRope
from benchmarks.solver.cases import SEGMENT, case
from benchmarks.solver.measurements import SIMULATORS, Plan, SolverReport, SolverRow, measure_solver
from benchmarks.solver.table import solver_lines, solver_table
from benchmarks.solver.timing import run, time_solves, timed
from magnetosuture_thread.geometry.obstacles import Disc, Workspace, triangulate
from magnetosuture_thread.model.solvers import OsqpSolver
from magnetosuture_thread.model.solvers.banded import BandedSolver

SMALL = Plan(segments=(12,), steps=12, budget=0.1, passes=2, simulated=(12,))
FIELDS = ("system", "n", "d", "obstacles", "median_s", "p99_s", "max_residual")


@pytest.fixture(scope="module")
def report() -> SolverReport:
    return measure_solver(with_baselines=False, progress=lambda part: None, plan=SMALL)


def test_rows_have_every_field_and_json_can_be_read_back(report: SolverReport):
    mapping = json.loads(json.dumps(report.to_json(), allow_nan=False))
    assert set(mapping) == {"rows"}
    assert len(mapping["rows"]) == len(report.rows)
    for row in mapping["rows"]:
        assert set(FIELDS) <= set(row)
        assert 0.0 < row["median_s"] <= row["p99_s"]
        assert row["obstacles"] in (0, 3)
    systems = {(row.system, row.n, row.d, row.obstacles) for row in report.rows}
    names = ("rod step, banded", "rod solve, banded", "rod step, osqp", "rod solve, osqp")
    assert systems == {(name, 12, d, obstacles) for name in names for d in (2, 3) for obstacles in (0, 3)}


def test_banded_residuals_are_small(report: SolverReport):
    for row in report.rows:
        if row.system.endswith("banded"):
            assert row.max_residual is not None
            assert row.max_residual < 1e-6


def test_progress_goes_from_none_to_all():
    parts: list[float] = []
    measure_solver(
        with_baselines=False, progress=parts.append, plan=Plan(segments=(5,), dimensions=(2,), steps=3, budget=0.01)
    )
    assert parts[0] == 0.0
    assert parts[-1] == 1.0
    assert parts == sorted(parts)


@pytest.mark.parametrize("dimension", [2, 3])
def test_obstacles_have_200_triangles_and_are_met_by_the_thread_but_not_by_the_needle(dimension: int):
    motion = case(25, dimension, True, 60)
    assert len(motion.shapes) == 3
    for shape in motion.shapes:
        assert isinstance(shape, Disc) or len(triangulate(shape).triangles) == 200
    workspace = Workspace(motion.shapes, 5e-3, dimension)
    assert workspace.near(motion.tails).distance.min() > 1e-4
    walked = run(motion, BandedSolver())
    assert walked.contact_steps >= 30
    assert workspace.near(walked.positions.reshape(-1, dimension)).distance.min() < motion.thread.diameter


@pytest.mark.parametrize("dimension", [2, 3])
def test_motion_is_of_the_speed_and_the_thread_of_the_length_that_it_should_be(dimension: int):
    motion = case(30, dimension, False, 40)
    assert motion.thread.segment_length == pytest.approx(SEGMENT)
    steps = np.linalg.norm(np.diff(motion.tails, axis=0), axis=1)
    assert steps / motion.interval == pytest.approx(10e-3, rel=1e-3)
    np.testing.assert_allclose(np.linalg.norm(motion.headings, axis=1), 1.0)
    chords = np.linalg.norm(np.diff(motion.start, axis=0), axis=1)
    # Chords of the track's arcs; the thread's own differ by the curvature's square only.
    assert (chords <= SEGMENT * (1.0 + 1e-9)).all()
    assert (chords > 0.99 * SEGMENT).all()


def test_captured_programs_solve_again_to_the_same():
    motion = case(15, 2, True, 20)
    walked = run(motion, BandedSolver())
    _, again = time_solves(walked.captured, BandedSolver(), 10.0)
    _, others = time_solves(walked.captured, OsqpSolver(), 10.0)
    assert len(again) == len(others) == walked.solves >= 20
    for one, banded, osqp in zip(walked.captured, again, others, strict=True):
        assert banded.residuals.largest < 1e-6
        assert osqp.residuals.largest < 1e-5
        free = ~one.program.known
        np.testing.assert_allclose(banded.velocities[free], osqp.velocities[free], atol=1e-4)


@pytest.mark.parametrize("name", SOLVERS)
def test_general_solvers_agree_with_the_banded_one(name: str):
    pytest.importorskip(name)
    for dimension in (2, 3):
        walked = run(case(12, dimension, True, 8), BandedSolver())
        solver = SOLVERS[name]()
        for one in walked.captured:
            form = converted(one.program, solver)
            x, multipliers = solver.read(form, solver.solve(form))
            assert residuals_of_general(one.program, form, x, multipliers).largest < 1e-6
            ours = BandedSolver().solve(*one)
            np.testing.assert_allclose(
                x[: len(form.general.unknown)], ours.velocities.ravel()[form.general.unknown], atol=1e-4
            )


def test_a_missing_baseline_gives_one_line_and_stops_no_other(monkeypatch: pytest.MonkeyPatch):
    for package in ("clarabel", "piqp", "mujoco", "elastica"):
        monkeypatch.setitem(sys.modules, package, None)
    plan = Plan(segments=(6,), dimensions=(2,), steps=4, budget=0.01, simulated=(6, 8))
    found = measure_solver(with_baselines=True, progress=lambda part: None, plan=plan)
    assert [remark.split(":")[0] for remark in found.remarks] == ["clarabel", "piqp", "mujoco", "pyelastica"]
    for remark in found.remarks:
        assert "pip install 'magnetosuture_thread[peers]'" in remark
        assert "\n" not in remark
        assert remark in solver_lines(found)
    assert [row.n for row in found.rows if row.system == "xpbd"] == [6, 8]


def test_xpbd_rope_keeps_its_length_and_stays_near_the_rod():
    motion = case(12, 3, False, 60, straight=True)
    rope = XpbdRope(motion)
    positions = np.array([rope.advance(tail) for tail in motion.tails])
    lengths = np.linalg.norm(np.diff(positions, axis=1), axis=2).sum(axis=1)
    np.testing.assert_allclose(lengths, motion.thread.length, rtol=0.05)
    np.testing.assert_allclose(positions[:, 0], motion.tails, atol=1e-12)
    assert error(motion, positions, run(motion, BandedSolver()).positions) < 0.05


@pytest.mark.parametrize(("name", "package"), [("mujoco", "mujoco"), ("pyelastica", "elastica")])
def test_simulators_follow_the_rod(name: str, package: str):
    pytest.importorskip(package)
    motion = case(6, 3, False, 20, straight=True)
    simulator = SIMULATORS[name](motion)
    positions = np.array([simulator.advance(tail) for tail in motion.tails])
    assert positions.shape == (20, 7, 3)
    assert error(motion, positions, run(motion, BandedSolver()).positions) < 0.05


def test_simulators_refuse_what_they_were_not_set_up_for():
    for motion in (case(6, 2, False, 2, straight=True), case(6, 3, True, 2, straight=True), case(6, 3, False, 2)):
        with pytest.raises(ValueError, match="straight thread in space without obstacles"):
            XpbdRope(motion)


def test_nothing_is_collected_while_timed_and_the_budget_ends_it():
    timing, found = timed([gc.isenabled] * 5, budget=10.0)
    assert found == [False] * 5
    assert len(timing.wall) == len(timing.cpu) == 5
    assert gc.isenabled()
    _, found = timed([gc.isenabled] * 5, budget=-1.0, least=2)
    assert len(found) == 2


def test_table_and_lines_show_the_figures():
    def row(system: str, n: int, median: float, residual: float | None, **extra: float | str) -> SolverRow:
        figures = {"cpu_median_s": median, "cpu_p99_s": 1.5 * median, "samples": 10.0}
        return SolverRow(system, n, 2, 0, median, 2.0 * median, residual, {**figures, **extra})

    report = SolverReport(
        (
            row("rod solve, banded", 81, 10e-6, 1e-9),
            row("rod solve, banded", 2000, 200e-6, 1e-9),
            row("rod solve, piqp", 81, 100e-6, 1e-9, conversion_s=1e-3),
            row("rod solve, clarabel", 81, 50e-6, 1e-3, conversion_s=1e-3),
            row("xpbd", 81, 20e-6, None, error_percent=3.0, physics="isotropic drag"),
        ),
        ("mujoco: not measured",),
    )
    lines = solver_lines(report)
    # Clarabel's is not solved as well, and so does not count.
    assert any("10.0 times as fast as piqp" in line for line in lines)
    assert any("0.12 at 81, 0.10 at 2000; 0.10 for each further one" in line for line in lines)
    assert any("p99/median at most 1.5" in line for line in lines)
    assert any("xpbd, n = 81: 3.00 % of the length from the rod; isotropic drag" in line for line in lines)
    assert lines[-1] == "mujoco: not measured"
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(solver_table(report))
    text = console.export_text()
    assert "rod solve, clarabel" in text


def test_a_residual_that_is_not_finite_is_null_in_json():
    report = SolverReport((SolverRow("rod solve, piqp", 5, 2, 0, 1.0, 1.0, math.inf),))
    assert json.loads(json.dumps(report.to_json(), allow_nan=False))["rows"][0]["max_residual"] is None
