"""Clocks around a step and around its solves, a warm-up before them, and no garbage collection between."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from benchmarks.solver.cases import Case
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.formulations.rod import RodFormulation
from magnetosuture_thread.model.formulations.step import PrescribedMotion, StepResult, ThreadState
from magnetosuture_thread.model.program import ChainProgram, Solution, Solver, Vector, WideRows

REACH = 5e-3  # m; of the margins, which the step does not ask for
ANY_RESIDUAL = 1e9  # accepted by the step: a residual is shown here, not refused
WARM = 5  # steps and solves before any is timed: kernels are loaded, memory is there

_Result = TypeVar("_Result")


class Captured(NamedTuple):
    """One program of a run as its solver got it.

    Attributes:
        program: its arrays copied, as a formulation writes the next program over them.
        velocities: the guess, shape (m, d).
        multipliers: the guess, shape (r,).
    """

    program: ChainProgram
    velocities: NDArray[np.float64]
    multipliers: Vector


class SpyingSolver:
    """Solves with another solver and keeps every program.

    Args:
        solver: the other solver.

    Attributes:
        captured: the programs in order.
        solutions: what was found for them.
    """

    def __init__(self, solver: Solver) -> None:
        self.name = solver.name
        self._solver = solver
        self.captured: list[Captured] = []
        self.solutions: list[Solution] = []

    def solve(
        self,
        program: ChainProgram,
        velocities: NDArray[np.float64],
        multipliers: Vector,
        wide: WideRows | None = None,
    ) -> Solution:
        """Solve one program; see `Solver`."""
        kept = ChainProgram(*(array.copy() for array in program))
        self.captured.append(Captured(kept, velocities.copy(), multipliers.copy()))
        self.solutions.append(self._solver.solve(program, velocities, multipliers, wide))
        return self.solutions[-1]


@dataclass(frozen=True, eq=False)
class Timing:
    """Durations of the same thing done many times.

        p99 = the value that 99 of 100 durations do not exceed

    Attributes:
        wall: by the clock on the wall, shape (k,) [s].
        cpu: what the process computed meanwhile, all its threads, shape (k,) [s].
    """

    wall: NDArray[np.float64]
    cpu: NDArray[np.float64]

    @property
    def median(self) -> float:
        """Of the wall clock [s]."""
        return float(np.median(self.wall))

    @property
    def p99(self) -> float:
        """Of the wall clock [s]."""
        return float(np.percentile(self.wall, 99.0))

    def to_json(self) -> dict[str, float]:
        """Return the figures that stand beside the wall clock's: CPU times [s] and how many were timed."""
        return {
            "cpu_median_s": float(np.median(self.cpu)),
            "cpu_p99_s": float(np.percentile(self.cpu, 99.0)),
            "samples": float(len(self.wall)),
        }


@contextmanager
def without_collection() -> Iterator[None]:
    """Keep the garbage collector from running inside of what is timed."""
    enabled = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def timed(calls: Sequence[Callable[[], _Result]], budget: float, least: int = 1) -> tuple[Timing, list[_Result]]:
    """Make calls in their order, as long as a budget lasts.

    Args:
        calls: what to time.
        budget: no call begins later than this after the first [s].
        least: number of calls that are made even so.

    Returns:
        The durations and what the calls returned.
    """
    wall: list[int] = []
    cpu: list[int] = []
    found: list[_Result] = []
    with without_collection():
        last = time.perf_counter_ns() + int(budget * 1e9)
        for call in calls:
            if len(wall) >= least and time.perf_counter_ns() > last:
                break
            computed = time.process_time_ns()
            begun = time.perf_counter_ns()
            result = call()
            ended = time.perf_counter_ns()
            cpu.append(time.process_time_ns() - computed)
            wall.append(ended - begun)
            found.append(result)
    return Timing(np.array(wall) * 1e-9, np.array(cpu) * 1e-9), found


class Walk:
    """One run of a case, a step at a time.

    Args:
        case: the motion.
        solver: of the programs.

    Attributes:
        state: the thread now.
    """

    def __init__(self, case: Case, solver: Solver) -> None:
        workspace = Workspace(case.shapes, REACH, case.dimension)
        self._formulation = RodFormulation(case.thread, workspace, solver, ANY_RESIDUAL)
        self._case = case
        self._taken = 0
        self.state = ThreadState.at_rest(case.start)

    def step(self) -> StepResult:
        """Take the next step: barriers, obstacles and solves."""
        i = self._taken
        drive = PrescribedMotion((0,), self._case.tails[i, None], self._case.headings[i])
        solution = self._formulation.step(self.state, drive, self._case.interval)
        self.state, self._taken = solution.state, i + 1
        return solution


class Run(NamedTuple):
    """What a run did, untimed.

    Attributes:
        captured: its programs.
        positions: the thread after each step, shape (k, n + 1, d) [m].
        contact_steps: number of steps in which an obstacle pushed the thread.
        solves: number of programs.
    """

    captured: list[Captured]
    positions: Points
    contact_steps: int
    solves: int


def run(case: Case, solver: Solver) -> Run:
    """Go through a case and keep its programs; this warms up what is timed later, too."""
    spy = SpyingSolver(solver)
    walk = Walk(case, spy)
    positions, contact_steps = [], 0
    for _ in case.tails:
        walk.step()
        positions.append(walk.state.positions)
        contact_steps += bool((spy.solutions[-1].multipliers[case.thread.segments :] > 0.0).any())
    return Run(spy.captured, np.array(positions), contact_steps, len(spy.captured))


def time_steps(case: Case, solver: Solver, budget: float, passes: int = 1) -> tuple[Timing, list[StepResult]]:
    """Time whole steps: barriers, obstacles and solves.

    Args:
        case: the motion, gone through `passes` times.
        solver: of the programs.
        budget: of all passes together [s].
        passes: number of times.
    """
    warm = Walk(case, solver)
    for _ in case.tails[:WARM]:
        warm.step()
    walks = [Walk(case, solver) for _ in range(passes)]
    return timed([walk.step for walk in walks for _ in case.tails], budget)


def time_solves(
    captured: Sequence[Captured], solver: Solver, budget: float, passes: int = 1
) -> tuple[Timing, list[Solution]]:
    """Time the solves alone, each from the guess that it had in its run.

    Args:
        captured: programs, solved `passes` times in their order.
        solver: of the programs.
        budget: of all passes together [s].
        passes: number of times.
    """
    for one in captured[:WARM]:
        solver.solve(*one)
    return timed([partial(solver.solve, *one) for _ in range(passes) for one in captured], budget)
