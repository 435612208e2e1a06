"""What can be chosen by name: formulations and solvers."""

from __future__ import annotations

from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.model.formulations import Formulation, PaperFormulation, PaperOptions, RodFormulation
from magnetosuture_thread.model.program import Solver
from magnetosuture_thread.model.solvers import BandedSolver, FallbackSolver, OsqpSolver
from magnetosuture_thread.model.thread import Thread

FORMULATIONS = (RodFormulation.name, PaperFormulation.name)
SOLVERS = (BandedSolver.name, OsqpSolver.name)


def make_solver(name: str, tolerance: float) -> Solver:
    """Return a solver by name; `banded` falls back on a cold start and on OSQP, OSQP on a cold start alone."""
    solvers: dict[str, tuple[Solver, ...]] = {
        BandedSolver.name: (BandedSolver(), OsqpSolver()),
        OsqpSolver.name: (OsqpSolver(),),
    }
    return FallbackSolver(solvers[name], tolerance)


def make_formulation(
    name: str,
    thread: Thread,
    workspace: Workspace,
    solver: Solver,
    tolerance: float,
    paper: PaperOptions | None = None,
) -> Formulation:
    """Return a formulation by name; the options are those of `paper`."""
    if name == PaperFormulation.name:
        return PaperFormulation(thread, workspace, solver, tolerance, paper)
    return RodFormulation(thread, workspace, solver, tolerance)
