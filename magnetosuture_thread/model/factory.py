"""What can be chosen by name: formulations and solvers."""

from __future__ import annotations

from collections.abc import Sequence

from magnetosuture_thread.barrier import Barrier, check_barriers
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.model.formulations import Formulation, PaperFormulation, PaperOptions, RodFormulation
from magnetosuture_thread.model.program import Solver
from magnetosuture_thread.model.solvers import BandedSolver, FallbackSolver, OsqpSolver, QpsolversSolver
from magnetosuture_thread.model.thread import Thread
from magnetosuture_thread.scene import Scene

FORMULATIONS = (RodFormulation.name, PaperFormulation.name)
SOLVERS = (BandedSolver.name, OsqpSolver.name)
"""Those that need no other package; besides, any that qpsolvers knows."""


def workspace_of(scene: Scene | None, reach: float) -> Workspace:
    """Return a scene's obstacles and wall for the barriers, which see as far as a reach [m]; none of no scene."""
    if scene is None:
        return Workspace((), reach)
    return Workspace(scene.obstacles, reach, wall_radius=scene.dish.radius)


def make_solver(name: str, tolerance: float) -> Solver:
    """Return a solver by name; `banded` falls back on a cold start and on OSQP, OSQP on a cold start alone.

    Any other name is that of a solver of the package qpsolvers, where that is installed.

    Raises:
        ConfigurationError: there is no solver of this name.
    """
    if name not in SOLVERS:
        return FallbackSolver((QpsolversSolver(name),), tolerance)
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
    barriers: Sequence[Barrier] = (),
) -> Formulation:
    """Return a formulation by name; the options are those of `paper`.

    Raises:
        ConfigurationError: there is no formulation of this name, or barriers cannot be told apart.
    """
    check_barriers(tuple(barriers))
    if name == PaperFormulation.name:
        return PaperFormulation(thread, workspace, solver, tolerance, paper, barriers)
    if name != RodFormulation.name:
        raise ConfigurationError("formulation", name, f"one of {', '.join(FORMULATIONS)}")
    return RodFormulation(thread, workspace, solver, tolerance, barriers)
