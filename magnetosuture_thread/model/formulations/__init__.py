"""Formulations: ways of writing one step of the thread as a quadratic program, a file for each."""

from magnetosuture_thread.model.formulations.paper import PaperFormulation, PaperOptions
from magnetosuture_thread.model.formulations.rod import RodFormulation
from magnetosuture_thread.model.formulations.step import Drive, Formulation, StepSolution, ThreadState

__all__ = ["Drive", "Formulation", "PaperFormulation", "PaperOptions", "RodFormulation", "StepSolution", "ThreadState"]
