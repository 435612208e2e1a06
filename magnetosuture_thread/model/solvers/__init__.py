"""Solvers of the step's program, a file for each."""

from magnetosuture_thread.model.solvers.banded import BandedSolver
from magnetosuture_thread.model.solvers.fallback import FallbackSolver
from magnetosuture_thread.model.solvers.osqp import OsqpSolver
from magnetosuture_thread.model.solvers.qpsolvers import QpsolversSolver

__all__ = ["BandedSolver", "FallbackSolver", "OsqpSolver", "QpsolversSolver"]
