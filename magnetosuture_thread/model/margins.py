"""The margins of a prediction: the value of every barrier, and what follows from them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.barrier import OBSTACLE, WALL, BarrierRows
from magnetosuture_thread.model.friction import UNKNOWN, Friction

SOLID = (OBSTACLE, WALL)
"""Barriers of what a thread can touch."""


@dataclass(frozen=True, eq=False)
class BarrierMargins:
    """The margins of one barrier, an entry for each of its rows.

    Attributes:
        barrier: its name.
        node: index of the node, shape (m,); 0 is the needle's tail.
        obstacle: index of the scene's shape, -1 where there is none, shape (m,).
        value: h, safe at >= 0, shape (m,); [m] for an obstacle and the wall, [m^4] for stiffness, [m^2] for
            connectivity and compression, else the barrier's own unit.
        clearance: the same margin as a distance, shape (m,) [m].
    """

    barrier: str
    node: NDArray[np.uint32]
    obstacle: NDArray[np.int32]
    value: NDArray[np.float64]
    clearance: NDArray[np.float64]

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.value)

    @property
    def minimum(self) -> float:
        """Least h of all rows; inf where the barrier has none, as no shape is near."""
        return float(self.value.min(initial=math.inf))

    @property
    def minimum_clearance(self) -> float:
        """Least margin as a distance [m]; inf where the barrier has no rows."""
        return float(self.clearance.min(initial=math.inf))

    @property
    def closest(self) -> int:
        """The row with the least clearance.

        Raises:
            ValueError: the barrier has no rows.
        """
        return int(self.clearance.argmin())


@dataclass(frozen=True, eq=False)
class Margins(Mapping[str, BarrierMargins]):
    """The margins of all barriers at one instant, by the barriers' names.

    Attributes:
        barriers: one entry for each barrier, in the order of the formulation, then the user's.
        in_contact: nodes that touch a shape or the wall, rising.
        friction: between shapes.
        scene_version: of the scene that they are of; empty where the model knows none.
    """

    barriers: tuple[BarrierMargins, ...]
    in_contact: tuple[int, ...] = ()
    friction: Friction = UNKNOWN
    scene_version: str = ""

    def __getitem__(self, barrier: str) -> BarrierMargins:
        """Return the margins of a barrier by its name."""
        for margins in self.barriers:
            if margins.barrier == barrier:
                return margins
        raise KeyError(barrier)

    def __iter__(self) -> Iterator[str]:
        """Return the barriers' names."""
        return (margins.barrier for margins in self.barriers)

    def __len__(self) -> int:
        """Return the number of barriers."""
        return len(self.barriers)

    @property
    def minima(self) -> tuple[BarrierMargins, ...]:
        """The row of least clearance of each barrier that has rows, each as margins of one row."""
        return tuple(_row(margins, margins.closest) for margins in self.barriers if len(margins))

    def with_friction(self, friction: Friction) -> Margins:
        """Return the same margins with the thread's friction."""
        return replace(self, friction=friction)

    @classmethod
    def of(cls, barriers: Sequence[BarrierRows], contact_tolerance: float, scene_version: str = "") -> Margins:
        """Return the margins of barriers at the same positions.

        Args:
            barriers: the rows of each, in SI units.
            contact_tolerance: a node this close to a shape or the wall touches it [m].
            scene_version: of the scene.
        """
        margins = tuple(
            BarrierMargins(
                rows.name,
                rows.nodes[:, -1].astype(np.uint32),
                rows.obstacle.astype(np.int32),
                rows.value,
                rows.clearance,
            )
            for rows in barriers
        )
        near = [m.node[m.clearance <= contact_tolerance] for m in margins if m.barrier in SOLID]
        touching = sorted({node for nodes in near for node in nodes.tolist()})
        return cls(margins, tuple(touching), scene_version=scene_version)


def _row(margins: BarrierMargins, row: int) -> BarrierMargins:
    part = slice(row, row + 1)
    return BarrierMargins(
        margins.barrier, margins.node[part], margins.obstacle[part], margins.value[part], margins.clearance[part]
    )


def node_clearance(margins: Margins, count: int) -> NDArray[np.float64]:
    """Return the minimum clearance of a shape or the wall for each of `count` nodes [m]; inf where none is near.

    Args:
        margins: of a prediction.
        count: of nodes, more than the greatest index in the margins.
    """
    clearance = np.full(count, np.inf)
    for name in SOLID:
        if name in margins:
            np.minimum.at(clearance, margins[name].node, margins[name].clearance)
    return clearance
