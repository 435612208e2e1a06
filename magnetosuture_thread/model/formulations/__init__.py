"""Formulations: ways of writing one step of the thread as a quadratic program, a file for each."""

from magnetosuture_thread.model.formulations.rod import RodFormulation, StepSolution

__all__ = ["RodFormulation", "StepSolution"]
