"""Formulations: ways of writing one step of the thread as a quadratic program, a file for each."""

from magnetosuture_thread.model.formulations.paper import PaperFormulation, PaperOptions
from magnetosuture_thread.model.formulations.rod import RodFormulation
from magnetosuture_thread.model.formulations.step import Formulation, PrescribedMotion, StepResult, ThreadState

__all__ = [
    "Formulation",
    "PaperFormulation",
    "PaperOptions",
    "PrescribedMotion",
    "RodFormulation",
    "StepResult",
    "ThreadState",
]
