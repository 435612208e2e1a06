"""All measurements, one after the other: the rod step and its solves, general solvers, simulators."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from benchmarks.baselines.elastica_rod import ElasticaRod
from benchmarks.baselines.general_solvers import (
    SOLVERS,
    GeneralSolver,
    converted,
    residuals_of_general,
)
from benchmarks.baselines.mujoco_chain import MujocoChain
from benchmarks.baselines.simulators import Simulator, error
from benchmarks.baselines.xpbd import XpbdRope
from benchmarks.solver.cases import OBSTACLES, Case, case
from benchmarks.solver.timing import Captured, Run, Timing, run, time_solves, time_steps, timed
from magnetosuture_thread.model.program import as_quadratic_program
from magnetosuture_thread.model.solvers import OsqpSolver
from magnetosuture_thread.model.solvers.banded import BandedSolver

EXTRA = "pip install 'magnetosuture_thread[peers]'"
SIMULATORS: dict[str, Callable[[Case], Simulator]] = {
    "mujoco": MujocoChain,
    "pyelastica": ElasticaRod,
    "xpbd": XpbdRope,
}


@dataclass(frozen=True)
class Plan:
    """What is measured, and how long.

    Attributes:
        segments: values of n.
        dimensions: values of d.
        steps: of each case; a third of it where n >= 1000.
        budget: of each row, warm-up aside [s].
        passes: the most times a case is gone through.
        osqp_most: greatest n of OSQP, which is slow.
        general_most: greatest n of the other general solvers.
        simulated: values of n of the simulators.
    """

    segments: tuple[int, ...] = (25, 40, 81, 320, 1000, 2000)
    dimensions: tuple[int, ...] = (2, 3)
    steps: int = 300
    budget: float = 0.5
    passes: int = 5
    osqp_most: int = 81
    general_most: int = 320
    simulated: tuple[int, ...] = (25, 81)


@dataclass(frozen=True)
class SolverRow:
    """One system at one size.

    Attributes:
        system: its name.
        n: number of segments.
        d: number of dimensions.
        obstacles: 0 or 3.
        median_s: of the wall clock; of a general solver without writing the program in its form [s].
        p99_s: the same [s].
        max_residual: the largest of all solves; none for a simulator, which solves something else.
        extra: further figures by name.
    """

    system: str
    n: int
    d: int
    obstacles: int
    median_s: float
    p99_s: float
    max_residual: float | None
    extra: Mapping[str, float | str] = field(default_factory=dict)

    def to_json(self) -> dict[str, float | str | None]:
        """Return all figures for JSON."""
        figures: dict[str, float | str | None] = {
            "system": self.system,
            "n": self.n,
            "d": self.d,
            "obstacles": self.obstacles,
            "median_s": self.median_s,
            "p99_s": self.p99_s,
            # JSON has no infinity; a solver that found nothing has no residual either.
            "max_residual": None if self.max_residual is None or math.isinf(self.max_residual) else self.max_residual,
        }
        return figures | dict(self.extra)


@dataclass(frozen=True)
class SolverReport:
    """All rows.

    Attributes:
        rows: in the order in which they were measured.
        remarks: one line for each baseline that could not be measured.
    """

    rows: tuple[SolverRow, ...]
    remarks: tuple[str, ...] = ()

    def to_json(self) -> dict[str, list[dict[str, float | str | None]]]:
        """Return the rows for JSON."""
        return {"rows": [row.to_json() for row in self.rows]}


def measure_solver(with_baselines: bool, progress: Callable[[float], None], plan: Plan | None = None) -> SolverReport:
    """Measure everything that a plan says.

    Args:
        with_baselines: whether to measure general solvers other than OSQP, and simulators.
        progress: called with the part that is done, 0 to 1.
        plan: what to measure; the whole by default.
    """
    plan = plan or Plan()
    solvers: list[GeneralSolver] = []
    remarks: list[str] = []
    if with_baselines:
        for name, solver in SOLVERS.items():
            try:
                solvers.append(solver())
            except ImportError as problem:
                remarks.append(_missing(name, problem))
    rows: list[SolverRow] = []
    sizes = [(n, d, obstacles) for n in plan.segments for d in plan.dimensions for obstacles in (False, True)]
    simulations = [(n, name) for n in plan.simulated for name in SIMULATORS] if with_baselines else []
    progress(0.0)
    for done, (n, d, obstacles) in enumerate(sizes, 1):
        rows += _rod_rows(case(n, d, obstacles, _steps(plan, n)), plan, solvers)
        progress(done / (len(sizes) + len(simulations)))
    for done, (n, name) in enumerate(simulations, len(sizes) + 1):
        try:
            rows.append(_simulator_row(name, n, plan))
        except ImportError as problem:
            if _missing(name, problem) not in remarks:
                remarks.append(_missing(name, problem))
        progress(done / (len(sizes) + len(simulations)))
    return SolverReport(tuple(rows), tuple(remarks))


def _missing(name: str, problem: ImportError) -> str:
    return f"{name}: not measured, {problem}; it comes with {EXTRA}"


def _steps(plan: Plan, n: int) -> int:
    return plan.steps if n < 1000 else max(plan.steps // 3, 1)


def _rod_rows(motion: Case, plan: Plan, solvers: list[GeneralSolver]) -> Iterator[SolverRow]:
    """Measure the rod step and its solves in one case, by all solvers."""
    n = motion.thread.segments
    banded = BandedSolver()
    walked = run(motion, banded)
    scene = {
        "steps": float(len(motion.tails)),
        "contact_steps": float(walked.contact_steps),
        "solves_per_step": walked.solves / len(motion.tails),
    }
    timing, steps = time_steps(motion, banded, plan.budget, plan.passes)
    yield _row("rod step, banded", motion, timing, max(step.residuals.largest for step in steps), scene)
    timing, solutions = time_solves(walked.captured, banded, plan.budget, plan.passes)
    iterations = {"iterations": float(np.mean([solution.iterations for solution in solutions]))}
    worst = max(solution.residuals.largest for solution in solutions)
    yield _row("rod solve, banded", motion, timing, worst, iterations)
    if n <= plan.osqp_most:
        yield from _osqp_rows(motion, walked, plan)
    if n <= plan.general_most:
        for solver in solvers:
            yield _general_row(motion, walked.captured, solver, plan.budget)


def _osqp_rows(motion: Case, walked: Run, plan: Plan) -> Iterator[SolverRow]:
    """Measure OSQP on the programs of a run, written in its form before."""
    timing, steps = time_steps(motion, OsqpSolver(), plan.budget)
    yield _row("rod step, osqp", motion, timing, max(step.residuals.largest for step in steps))
    solver, programs = OsqpSolver(), [one.program for one in walked.captured]
    writing, forms = timed([partial(as_quadratic_program, program) for program in programs], 2.0 * plan.budget)
    solver.run(forms[0])  # the warm-up
    timing, found = timed([partial(solver.run, form) for form in forms], plan.budget)
    solutions = [solver.read(*given) for given in zip(programs, forms, found, strict=False)]
    worst = max(solution.residuals.largest for solution in solutions)
    yield _row("rod solve, osqp", motion, timing, worst, {"conversion_s": writing.median})


def _general_row(motion: Case, captured: list[Captured], solver: GeneralSolver, budget: float) -> SolverRow:
    """Measure a general solver on the programs of a run."""
    writing, forms = timed([partial(converted, one.program, solver) for one in captured], 2.0 * budget)
    solver.solve(forms[0])  # the warm-up
    timing, found = timed([partial(solver.solve, form) for form in forms], budget)
    worst = max(
        residuals_of_general(one.program, form, *solver.read(form, raw)).largest
        for one, form, raw in zip(captured, forms, found, strict=False)
    )
    return _row(f"rod solve, {solver.name}", motion, timing, worst, {"conversion_s": writing.median})


def _simulator_row(name: str, n: int, plan: Plan) -> SolverRow:
    """Measure a simulator, and how far its thread is from the rod model's."""
    motion = case(n, 3, False, _steps(plan, n), straight=True)
    warm = SIMULATORS[name](motion)
    warm.advance(motion.start[0])
    simulator = SIMULATORS[name](motion)
    timing, found = timed([partial(simulator.advance, tail) for tail in motion.tails], 3.0 * plan.budget)
    reference = run(motion, BandedSolver()).positions
    distance = 100.0 * error(motion, np.array(found), reference)
    return _row(name, motion, timing, None, {"error_percent": distance, "physics": simulator.physics})


def _row(
    system: str, motion: Case, timing: Timing, residual: float | None, extra: Mapping[str, float | str] | None = None
) -> SolverRow:
    return SolverRow(
        system=system,
        n=motion.thread.segments,
        d=motion.dimension,
        obstacles=OBSTACLES if motion.shapes else 0,
        median_s=timing.median,
        p99_s=timing.p99,
        max_residual=residual,
        extra={**timing.to_json(), **(extra or {})},
    )
