"""Simulators of the same needle motion: what they have in common, and how their threads are compared."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from benchmarks.solver.cases import Case
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.thread import Thread


class Simulator(Protocol):
    """A thread in space that follows its lead, one pose a time.

    Attributes:
        name: of the row.
        physics: in what it is not the rod model.
    """

    name: str
    physics: str

    def advance(self, tail: NDArray[np.float64]) -> Points:
        """Move the lead to a position of shape (3,) within one interval; return the nodes, shape (n + 1, 3) [m]."""
        ...


class Scaled:
    """A thread in units in which everything is about 1: lengths in D, forces in those of a segment's drag at D/s.

        EI / (zeta_perp D^4)    is then the stiffness of a joint between two segments [1/s]

    Args:
        thread: the thread.
    """

    def __init__(self, thread: Thread) -> None:
        self.unit = thread.segment_length
        self.segments = thread.segments
        self.joint = thread.bending_stiffness / (thread.medium.drag_across * self.unit**4)


def check(case: Case) -> None:
    """Refuse a case that the simulators have not been set up for.

    Raises:
        ValueError: a case in the plane, with obstacles, or whose thread does not begin straight.
    """
    turns = np.diff(case.start, n=2, axis=0)
    if case.dimension != 3 or case.shapes or np.abs(turns).max(initial=0.0) > 1e-9 * case.thread.segment_length:
        raise ValueError("a simulator needs a straight thread in space without obstacles")


def error(case: Case, positions: Points, reference: Points) -> float:
    """Return the mean distance from the rod model's thread.

        mean over steps and nodes of |x - x_rod| / L

    Args:
        case: the motion.
        positions: of the simulator, shape (k, n + 1, 3) [m].
        reference: of the rod model after the same steps, same shape [m].
    """
    return float(np.linalg.norm(positions - reference[: len(positions)], axis=2).mean() / case.thread.length)
