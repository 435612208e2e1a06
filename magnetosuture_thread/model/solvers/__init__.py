"""Solvers of the step's program, a file for each."""

from magnetosuture_thread.model.solvers.osqp import OsqpSolver

__all__ = ["OsqpSolver"]
