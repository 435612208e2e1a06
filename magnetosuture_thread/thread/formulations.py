"""Formulations: ways of writing one step of the thread as a quadratic program, a file for each."""

from __future__ import annotations

from collections.abc import Sequence

from magnetosuture_thread.barrier import Barrier, check_barriers
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.thread.material import Thread
from magnetosuture_thread.thread.paper import PaperFormulation, PaperOptions
from magnetosuture_thread.thread.program import Solver
from magnetosuture_thread.thread.rod import RodFormulation
from magnetosuture_thread.thread.step import (
    Formulation,
    PrescribedMotion,
    StepResult,
    ThreadState,
    WarmStart,
)

__all__ = [
    "FORMULATIONS",
    "Formulation",
    "PaperFormulation",
    "PaperOptions",
    "PrescribedMotion",
    "RodFormulation",
    "StepResult",
    "ThreadState",
    "WarmStart",
    "make_formulation",
]

FORMULATIONS = (RodFormulation.name, PaperFormulation.name)


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
