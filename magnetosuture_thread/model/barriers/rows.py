"""What every control barrier function of the thread gives: its rows.

A row is one barrier h, safe at h >= 0, with its gradient at the nodes that it touches. The set of verbs
is the same for each kind: a class with a method `rows(positions)` that returns `BarrierRows`, over a
compiled function that the formulations call as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points

NO_OBSTACLE = -1


class BarrierKind(IntEnum):
    """The kinds of barrier; the numbers are those of the message BarrierMargin."""

    CONNECTIVITY = 0
    COMPRESSION = 1
    OBSTACLE = 2
    ENHANCED_CONNECTIVITY = 3
    STIFFNESS = 4
    WALL = 5


@dataclass(frozen=True)
class BarrierRows:
    """Barriers of one kind at given positions.

    Attributes:
        kind: which barrier.
        nodes: the nodes that each row touches, shape (m, k); the last is the one it is named after.
        obstacle: obstacle index of each row, `NO_OBSTACLE` where the kind has none, shape (m,).
        value: h of each row, safe at >= 0, shape (m,); its unit is the kind's.
        gradient: derivative of h by the position of each of its nodes, shape (m, k, d).
        clearance: the same margin as a distance, shape (m,) [unit of the positions].
    """

    kind: BarrierKind
    nodes: NDArray[np.intp]
    obstacle: NDArray[np.intp]
    value: NDArray[np.float64]
    gradient: NDArray[np.float64]
    clearance: NDArray[np.float64]


class Barrier(Protocol):
    """A kind of control barrier function."""

    def rows(self, positions: Points) -> BarrierRows:
        """Return the rows at the positions of all nodes, shape (n + 1, d)."""
        ...
