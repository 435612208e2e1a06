"""Time the thread model on this machine, by number of segments, obstacles and solver.

What a user calls, `ThreadPredictor.step` with the margins of every barrier; the step of the formulation alone
(barriers, obstacles and solves); and the solve alone, with the largest residual beside every time. Single thread,
processor time; the machine's other work shows in the 99th percentile.

A needle draws a silk thread along a track that winds by  theta(s) = 0.9 cos(2 pi s / 30 mm)  about a straight line, s
its arc length. Obstacles lie on the inside of three bends, where a pulled thread cuts the corner and leans on them.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import math
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import islice, product
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from benchmarks.report import figures_table
from magnetosuture_thread.commands.command import Terminal
from magnetosuture_thread.geometry.obstacles import Polygon, Workspace
from magnetosuture_thread.geometry.polyline import Points, Vector
from magnetosuture_thread.thread.material import MATERIALS, Attachment, Thread
from magnetosuture_thread.thread.prediction import NeedlePose
from magnetosuture_thread.thread.predictor import ThreadPredictor
from magnetosuture_thread.thread.program import ChainProgram, Solution, Solver, residuals_of
from magnetosuture_thread.thread.rod import RodFormulation
from magnetosuture_thread.thread.solvers import BandedSolver, OsqpSolver, as_quadratic_program
from magnetosuture_thread.thread.step import PrescribedMotion, ThreadState

SEGMENT = 1.85e-3  # m; of the paper's thread
SPEED, RATE = 10e-3, 66.0  # m/s, poses a second
WAVE, GRID = 30e-3, 5e-6  # m; of the track, and steps of its integral
REACH = 5e-3  # m; of the margins, which the step does not ask for
ANY_RESIDUAL = 1e9  # accepted by the step: a residual is shown here, not refused
PEERS = ("clarabel", "piqp")  # sparse interior-point methods
TOLERANCE, ITERATIONS = 1e-9, 200  # of the peers; the residual of the banded solver is between 1e-9 and 1e-8
STEPS, BUDGET = 300, 0.5  # of each case, and s for each row
WARM, PASSES = 5, 5  # calls before any is timed, and the most times that a case is gone through


class Case(NamedTuple):
    """One motion of one thread in one scene, 0.15 mm a step.

    Attributes:
        thread: of n segments.
        shapes: the obstacles.
        start: the thread before the first step, shape (n + 1, 2) [m].
        tails: position of the needle's tail at the end of each step, shape (k, 2) [m].
        headings: unit vector along the needle at the end of each step, shape (k, 2).
    """

    thread: Thread
    shapes: tuple[Polygon, ...]
    start: Points
    tails: Points
    headings: Points


def case(segments: int, obstacles: bool, steps: int) -> Case:
    """Return a motion of n segments over k steps, among three obstacles of 200 triangles or none."""
    arc = np.arange(1.0, steps + 1.0) * SPEED / RATE
    positions = _track(np.concatenate([-SEGMENT * np.arange(segments + 1.0), arc]))
    start, tails = np.split(positions, [segments + 1])
    length, silk = segments * SEGMENT, MATERIALS["silk_6_0"]
    thread = Thread.of(silk, length=length, segments=segments, attachment=Attachment.PINNED)
    # One bend that the thread begins in, two on the needle's way; 0.15 mm between the track and the highest bump.
    bends = np.array([-0.25, 0.25, 0.75]) * WAVE
    turning = _heading(bends + GRID) - _heading(bends - GRID)
    inward = turning / np.linalg.norm(turning, axis=1, keepdims=True)
    centres = _track(bends) + (2.5e-3 * 1.05 + 0.15e-3) * inward
    shapes = tuple(map(_star, centres)) if obstacles else ()
    return Case(thread, shapes, start.copy(), tails.copy(), _heading(arc))


def _heading(arc: NDArray[np.float64]) -> Points:
    """Return unit vectors along the track, shape (k, 2), at arc lengths s of shape (k,) [m]."""
    theta = 0.9 * np.cos(2.0 * math.pi * arc / WAVE)
    return np.column_stack([np.cos(theta), np.sin(theta)])


def _track(arc: NDArray[np.float64]) -> Points:
    """Return the positions at arc lengths, the integral of the heading from s = 0, shape (k, 2) [m]."""
    first, last = math.floor(min(arc.min(), 0.0) / GRID), math.ceil(max(arc.max(), 0.0) / GRID)
    # Midpoints: exact to (GRID / WAVE)^2, far below what a segment may stretch.
    pieces = GRID * _heading((np.arange(first, last) + 0.5) * GRID)
    walked = np.concatenate([np.zeros((1, 2)), np.cumsum(pieces, axis=0)])
    walked -= walked[-first]
    return np.column_stack([np.interp(arc, np.arange(first, last + 1) * GRID, side) for side in walked.T])


def _star(centre: NDArray[np.float64]) -> Polygon:
    """Return a smooth outline with five bumps, of the 202 vertices that give 200 triangles."""
    angle = 2.0 * math.pi * np.arange(202) / 202
    outline = centre + 2.5e-3 * (1.0 + 0.05 * np.cos(5 * angle))[:, None] * np.column_stack(
        [np.cos(angle), np.sin(angle)]
    )
    return Polygon(tuple(map(tuple, outline.tolist())))


class PeerSolver:
    """Another general solver, from a cold start.

        minimise over x   1/2 x' P x + q' x    subject to   lower <= A x <= upper
        P x + q = A' lambda,    lambda_r > 0 at a lower bound, < 0 at an upper one

    Writing a program in its form is a part of the solve.

    Args:
        name: of `PEERS`.
    """

    def __init__(self, name: str) -> None:
        self.name, self._library = name, importlib.import_module(name)

    def solve(self, program: ChainProgram, velocities: Points, multipliers: Vector) -> Solution:
        """Solve one program; see `Solver`."""
        general = as_quadratic_program(program)
        equal = general.lower == general.upper
        rows = equal, ~equal & np.isfinite(general.lower), ~equal & np.isfinite(general.upper)
        find = self._clarabel if self.name == "clarabel" else self._piqp
        x, result, status = find(general, *map(np.flatnonzero, rows))
        flat = np.zeros(program.linear.size)
        flat[general.unknown] = x[: len(general.unknown)]
        u, result = flat.reshape(program.linear.shape), result[: len(program.lower)]
        return Solution(u, result, self.name, status, 0, residuals_of(program, u, result))

    def _clarabel(self, general: Any, equal: Any, below: Any, above: Any) -> tuple[Vector, Vector, str]:
        """Return x, lambda and the status:  A x + s = b,  s in a cone, one row for each bound."""
        settings = self._library.DefaultSettings()
        settings.verbose, settings.max_iter, settings.max_threads = False, ITERATIONS, 1
        settings.tol_feas = settings.tol_gap_abs = settings.tol_gap_rel = TOLERANCE
        image = sp.csc_matrix(sp.vstack([general.A[equal], -general.A[below], general.A[above]]))
        bounds = np.concatenate([general.lower[equal], -general.lower[below], general.upper[above]])
        cones = [self._library.ZeroConeT(len(equal)), self._library.NonnegativeConeT(len(below) + len(above))]
        result = self._library.DefaultSolver(general.P, general.q, image, bounds, cones, settings).solve()
        multipliers = np.zeros(len(general.lower))
        of_equal, of_below, of_above = np.split(np.asarray(result.z), np.cumsum([len(equal), len(below)]))
        multipliers[equal] = -of_equal
        multipliers[below] += of_below
        multipliers[above] -= of_above
        return np.asarray(result.x), multipliers, str(result.status)

    def _piqp(self, general: Any, equal: Any, below: Any, above: Any) -> tuple[Vector, Vector, str]:
        """Return x, lambda and the status:  A x = b,  lower <= G x <= upper."""
        unequal, solver = np.union1d(below, above), self._library.SparseSolver()
        settings = solver.settings
        settings.eps_abs = settings.eps_duality_gap_abs = TOLERANCE
        settings.eps_rel = settings.eps_duality_gap_rel = TOLERANCE
        settings.max_iter, settings.verbose = ITERATIONS, False
        arguments = {"P": general.P, "c": general.q, "A": general.A[equal].tocsc(), "b": general.lower[equal]}
        if len(unequal):
            arguments |= {"G": general.A[unequal].tocsc(), "h_l": general.lower[unequal], "h_u": general.upper[unequal]}
        solver.setup(**arguments)
        status, result, multipliers = solver.solve(), solver.result, np.zeros(len(general.lower))
        multipliers[equal] = -np.asarray(result.y)
        if len(unequal):
            multipliers[unequal] = np.asarray(result.z_l) - np.asarray(result.z_u)
        return np.array(result.x), multipliers, str(status)


class RecordingSolver:
    """Solves with the banded solver and keeps a copy of every program with its guess, in `programs`."""

    name = "banded"

    def __init__(self) -> None:
        self._solver, self.programs = BandedSolver(), list[tuple[ChainProgram, Points, Vector]]()

    def solve(self, program: ChainProgram, velocities: Points, multipliers: Vector) -> Solution:
        """Solve one program; see `Solver`."""
        copied = ChainProgram(*(array.copy() for array in program))
        self.programs.append((copied, velocities.copy(), multipliers.copy()))
        return self._solver.solve(program, velocities, multipliers)


def _steps(motion: Case, solver: Solver) -> Iterator[float]:
    """Return the residuals of steps of the formulation alone: barriers, obstacles and solves."""
    formulation = RodFormulation(motion.thread, Workspace(motion.shapes, REACH), solver, ANY_RESIDUAL)

    def take() -> Iterator[float]:
        state = ThreadState.at_rest(motion.start)
        for tail, heading in zip(motion.tails[:, None], motion.headings, strict=True):
            result = formulation.step(state, PrescribedMotion((0,), tail, heading), 1.0 / RATE)
            state = result.state
            yield result.residuals.largest

    return take()


def _predictions(motion: Case) -> Iterator[float]:
    """Return the residuals of the same steps as a user takes them, with the margins of every barrier."""
    predictor = ThreadPredictor(motion.thread, Workspace(motion.shapes, REACH))
    predictor.start_at(NeedlePose(0.0, motion.start[0], motion.headings[0]), motion.start)

    def take() -> Iterator[float]:
        for index, (tail, heading) in enumerate(zip(motion.tails, motion.headings, strict=True), 1):
            prediction = predictor.step(NeedlePose(index / RATE, tail, heading))
            assert prediction.margins
            yield prediction.residual

    return take()


def _row(system: str, motion: Case, calls: Iterable[Callable[[], float]]) -> dict[str, Any]:
    """Return the figures of calls that return residuals, made in their order until the budget is spent."""
    durations, residuals, calls = list[int](), list[float](), list(calls)
    gc.collect()
    gc.disable()
    try:
        last = time.process_time_ns() + int(BUDGET * 1e9)
        for call in calls:
            began = time.process_time_ns()
            if residuals and began > last:
                break
            residuals.append(call())
            durations.append(time.process_time_ns() - began)
    finally:
        gc.enable()
    median, p99 = 1e-9 * np.percentile(durations, [50.0, 99.0])
    size = {"system": system, "n": motion.thread.segments, "obstacles": len(motion.shapes), "samples": len(durations)}
    residual = min(max(residuals), ANY_RESIDUAL)  # JSON has no infinity
    return {**size, "median_s": float(median), "p99_s": float(p99), "of_rod_step": None, "max_residual": residual}


def measure(motion: Case, solvers: Iterable[Solver]) -> list[dict[str, Any]]:
    """Return the rows of a case; those of the predictor with its margins where that has the solver."""
    rows, recorder = list[dict[str, Any]](), RecordingSolver()
    for _ in _steps(motion, recorder):
        pass
    for solver in solvers:
        walks: dict[str, Callable[[], Iterator[float]]] = {}
        if solver.name not in PEERS:
            walks[f"rod step, {solver.name}"] = partial(_steps, motion, solver)
        if solver.name == "banded":
            walks["predictor step with margins"] = partial(_predictions, motion)
        for name, begin in walks.items():
            list(islice(begin(), WARM))
            passes = [begin() for _ in range(PASSES)]
            rows.append(_row(name, motion, (partial(next, walk) for walk in passes for _ in motion.tails)))
            rows[-1]["of_rod_step"] = round(rows[-1]["median_s"] / rows[0]["median_s"], 2)

        def solve(program: tuple[ChainProgram, Points, Vector], solver: Solver = solver) -> float:
            return solver.solve(*program).residuals.largest

        for program in recorder.programs[:WARM]:
            solve(program)
        calls = [partial(solve, program) for program in recorder.programs] * PASSES
        rows.append(_row(f"rod solve, {solver.name}", motion, calls))
    return rows


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    option = parser.add_argument
    option("--peers", action="store_true", help="time other general solvers too (needs the extra `peers`)")
    option("--segments", type=int, nargs="+", default=[25, 40, 81, 320], metavar="N")


def run(options: argparse.Namespace, terminal: Terminal) -> tuple[dict[str, Any], bool]:
    """Time predictions, steps and solves; return the figures."""
    rows, sizes = list[dict[str, Any]](), list(product(options.segments, (False, True)))
    with terminal.progress("solver") as advance:
        for index, (segments, obstacles) in enumerate(sizes, 1):
            solvers: list[Solver] = [
                BandedSolver(),
                OsqpSolver(),
                *(PeerSolver(name) for name in PEERS if options.peers),
            ]
            rows += measure(case(segments, obstacles, STEPS), solvers)
            advance(index / len(sizes))
    columns = {"system": "{system}", "n": "{n}", "obst.": "{obstacles}", "median [s]": "{median_s:.3g}"}
    columns |= {"p99 [s]": "{p99_s:.3g}", "of rod step": "{of_rod_step}", "residual": "{max_residual:.1e}"}
    terminal.print(figures_table("one step, one solve, processor time", rows, columns, "obst.: of 200 triangles each"))
    return {"rows": rows}, True
