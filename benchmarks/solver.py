"""Time the thread model on this machine, by number of segments, dimension, obstacles and solver.

What a user calls, `ThreadPredictor.step` with the margins of every barrier; the step of the formulation alone
(barriers, obstacles and solves); and the solve alone, with the largest residual beside every time. Single thread,
processor time; the machine's other work shows in the 99th percentile.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from benchmarks.general_solvers import PEERS, PeerSolver
from benchmarks.report import figures_table
from benchmarks.track import OBSTACLES, Case, case
from magnetosuture_thread.commands.command import progress
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread.prediction import NeedlePose, Prediction
from magnetosuture_thread.thread.predictor import ThreadPredictor
from magnetosuture_thread.thread.program import ChainProgram, Solution, Solver, Vector
from magnetosuture_thread.thread.rod import RodFormulation
from magnetosuture_thread.thread.solvers import BandedSolver, OsqpSolver
from magnetosuture_thread.thread.step import PrescribedMotion, StepResult, ThreadState

REACH = 5e-3  # m; of the margins, which the step does not ask for
ANY_RESIDUAL = 1e9  # accepted by the step: a residual is shown here, not refused
WARM = 5  # steps and solves before any is timed: kernels are loaded, memory is there
PASSES = 5  # the most times that a case is gone through
MAX_SEGMENTS = {"banded": 2000, "osqp": 81}  # of the others 320


class Captured(NamedTuple):
    """One program of a run as its solver got it, with its guess; arrays are copied."""

    program: ChainProgram
    velocities: Points
    multipliers: Vector


class SpyingSolver:
    """Solves with another solver and keeps every program.

    Attributes:
        captured: the programs in order.
        pushed: number of solves in which a contact pushed.
    """

    def __init__(self, solver: Solver) -> None:
        self.name, self._solver, self.pushed = solver.name, solver, 0
        self.captured: list[Captured] = []

    def solve(self, program: ChainProgram, velocities: Points, multipliers: Vector) -> Solution:
        """Solve one program; see `Solver`."""
        kept = ChainProgram(*(array.copy() for array in program))
        self.captured.append(Captured(kept, velocities.copy(), multipliers.copy()))
        found = self._solver.solve(program, velocities, multipliers)
        self.pushed += bool((found.multipliers[len(program.linear) - 1 :] > 0.0).any())
        return found


class Walk:
    """One run of a case, a step at a time."""

    def __init__(self, case: Case, solver: Solver) -> None:
        workspace = Workspace(case.shapes, REACH, case.dimension)
        self._formulation = RodFormulation(case.thread, workspace, solver, ANY_RESIDUAL)
        self._case, self._taken, self.state = case, 0, ThreadState.at_rest(case.start)

    def step(self) -> StepResult:
        """Take the next step: barriers, obstacles and solves."""
        drive = PrescribedMotion((0,), self._case.tails[self._taken, None], self._case.headings[self._taken])
        done = self._formulation.step(self.state, drive, self._case.interval)
        self.state, self._taken = done.state, self._taken + 1
        return done


class PredictedWalk:
    """The same as a user takes it, with the margins of every barrier."""

    def __init__(self, case: Case) -> None:
        self._predictor = ThreadPredictor(case.thread, Workspace(case.shapes, REACH, case.dimension))
        stamps = case.interval * np.arange(len(case.tails) + 1.0)
        self._predictor.start_at(NeedlePose(0.0, case.start[0], case.headings[0]), case.start)
        self._poses = map(NeedlePose, stamps[1:].tolist(), case.tails, case.headings)

    def step(self) -> Prediction:
        """Take the next step, and compute its margins."""
        prediction = self._predictor.step(next(self._poses))
        assert prediction.margins
        return prediction


def run_case(case: Case, solver: Solver) -> tuple[SpyingSolver, Points]:
    """Go through a case and keep its programs; return them and the thread after each step, shape (k, n + 1, d) [m]."""
    spy = SpyingSolver(solver)
    walk = Walk(case, spy)
    return spy, np.array([walk.step().state.positions for _ in case.tails])


def timed(calls: Sequence[Callable[[], Any]], budget: float) -> tuple[NDArray[np.float64], list[Any]]:
    """Make calls in their order, until a budget [s] is spent; return their durations [s] and results."""
    durations: list[int] = []
    results: list[Any] = []
    gc.collect()
    gc.disable()
    try:
        last = time.process_time_ns() + int(budget * 1e9)
        for call in calls:
            begun = time.process_time_ns()
            if results and begun > last:
                break
            results.append(call())
            durations.append(time.process_time_ns() - begun)
    finally:
        gc.enable()
    return 1e-9 * np.array(durations), results


def time_steps(case: Case, solver: Solver, budget: float) -> list[dict[str, Any]]:
    """Return the figures of whole steps, and of those of the predictor with its margins where that has this solver."""
    kinds: dict[str, Callable[[], Walk | PredictedWalk]] = {f"rod step, {solver.name}": lambda: Walk(case, solver)}
    if isinstance(solver, BandedSolver):
        kinds["predictor step with margins"] = lambda: PredictedWalk(case)
    rows = []
    for name, begin in kinds.items():
        warm = begin()
        for _ in case.tails[:WARM]:
            warm.step()
        walks = [begin() for _ in range(PASSES)]
        durations, done = timed([walk.step for walk in walks for _ in case.tails], budget)
        residuals = [each.residual if isinstance(each, Prediction) else each.residuals.largest for each in done]
        rows.append(_row(name, case, durations, max(residuals)))
        rows[-1]["of_rod_step"] = round(rows[-1]["median_s"] / rows[0]["median_s"], 2)
    return rows


def time_solves(case: Case, captured: Sequence[Captured], solver: Solver, budget: float) -> dict[str, Any]:
    """Return the figures of the solves alone, each from the guess that it had in its run."""
    for one in captured[:WARM]:
        solver.solve(*one)
    durations, done = timed([partial(solver.solve, *one) for _ in range(PASSES) for one in captured], budget)
    return _row(f"rod solve, {solver.name}", case, durations, max(each.residuals.largest for each in done))


def _row(system: str, case: Case, durations: NDArray[np.float64], residual: float) -> dict[str, Any]:
    return {
        "system": system,
        "n": case.thread.segments,
        "d": case.dimension,
        "obstacles": len(case.shapes),
        "median_s": float(np.median(durations)),
        "p99_s": float(np.percentile(durations, 99.0)),
        "samples": len(durations),
        "of_rod_step": None,
        "max_residual": min(residual, ANY_RESIDUAL),  # JSON has no infinity
    }


def measure(
    segments: Sequence[int], steps: int, budget: float, peers: bool, advance: Callable[[float], None]
) -> list[dict[str, Any]]:
    """Return the rows of all sizes.

    Args:
        segments: values of n.
        steps: of each case; a third of it where n >= 1000.
        budget: of each row, warm-up aside [s].
        peers: whether other general solvers are timed besides OSQP.
        advance: called with the part that is done, 0 to 1.
    """
    rows, sizes = [], [(n, d, count) for n in segments for d in (2, 3) for count in (0, OBSTACLES)]
    for done, (n, dimension, obstacles) in enumerate(sizes):
        advance(done / len(sizes))
        motion = case(n, dimension, obstacles > 0, steps if n < 1000 else steps // 3)
        solvers: list[Solver] = [BandedSolver(), OsqpSolver(), *(PeerSolver(name) for name in PEERS if peers)]
        captured = run_case(motion, BandedSolver())[0].captured
        for solver in solvers:
            if n > MAX_SEGMENTS.get(solver.name, 320):
                continue
            if solver.name in MAX_SEGMENTS:
                rows += time_steps(motion, solver, budget)
            rows.append(time_solves(motion, captured, solver, budget))
    advance(1.0)
    return rows


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    option = parser.add_argument
    option("--peers", action="store_true", help="time other general solvers too (needs the extra `peers`)")
    option("--segments", type=int, nargs="+", default=[25, 40, 81, 320, 1000, 2000], metavar="N")


def run(options: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Time predictions, steps and solves; return the figures."""
    with progress(console, "solver") as advance:
        rows = measure(options.segments, 300, 0.5, options.peers, advance)
    columns = {"system": "{system}", "n": "{n}", "d": "{d}", "obst.": "{obstacles}"}
    columns |= {"median [s]": "{median_s:.3g}", "p99 [s]": "{p99_s:.3g}", "of rod step": "{of_rod_step}"}
    columns["residual"] = "{max_residual:.1e}"
    console.print(figures_table("one step, one solve, processor time", rows, columns, "obst.: of 200 triangles each"))
    return {"rows": rows}, True
