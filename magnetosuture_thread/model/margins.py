"""The margins of a prediction as one table: every barrier, the least of each kind, and what touches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.model.barriers import BarrierRows
from magnetosuture_thread.model.barriers.rows import BarrierKind
from magnetosuture_thread.model.friction import UNKNOWN, Friction

TOUCHABLE = (BarrierKind.OBSTACLE, BarrierKind.WALL)
"""Kinds of barriers that are of a solid thing."""


@dataclass(frozen=True)
class LeastBarrier:
    """The barrier with the least margin of its kind.

    Attributes:
        kind: number of the kind.
        node: index.
        obstacle: index, -1 where the kind has none.
        value: h.
        clearance: the same as a distance [m].
    """

    kind: int
    node: int
    obstacle: int
    value: float
    clearance: float


@dataclass(frozen=True)
class Margins:
    """Every barrier of a prediction; the arrays have an entry for each.

    Attributes:
        kind: number of the kind, uint8.
        node: index, uint32.
        obstacle: index, int32; -1 where the kind has none.
        value: h, safe at >= 0; [m] for an obstacle and the wall, [m^4] for stiffness, else [m^2].
        clearance: the same margin as a distance [m].
        least: of each kind present.
        touching: nodes that touch an obstacle or the wall, rising.
        friction: between obstacles.
        scene_version: of the scene that they are of; empty where the model knows none.
    """

    kind: NDArray[np.uint8]
    node: NDArray[np.uint32]
    obstacle: NDArray[np.int32]
    value: NDArray[np.float64]
    clearance: NDArray[np.float64]
    least: tuple[LeastBarrier, ...]
    touching: tuple[int, ...]
    friction: Friction = UNKNOWN
    scene_version: str = ""

    @classmethod
    def of(
        cls,
        barriers: Sequence[BarrierRows],
        contact_tolerance: float,
        friction: Friction = UNKNOWN,
        scene_version: str = "",
    ) -> Margins:
        """Put the barriers of all kinds together.

        Args:
            barriers: the rows of each kind, in SI units.
            contact_tolerance: a node this close to an obstacle or the wall touches it [m].
            friction: between obstacles.
            scene_version: of the scene.
        """
        count = sum(len(rows.value) for rows in barriers)
        whole = cls(
            np.empty(count, np.uint8),
            np.empty(count, np.uint32),
            np.empty(count, np.int32),
            np.empty(count),
            np.empty(count),
            tuple(_least(rows) for rows in barriers if len(rows.value)),
            _touching(barriers, contact_tolerance),
            friction,
            scene_version,
        )
        begin = 0
        for rows in barriers:
            part = slice(begin, begin + len(rows.value))
            whole.kind[part], whole.node[part], whole.obstacle[part] = rows.kind, rows.nodes[:, -1], rows.obstacle
            whole.value[part], whole.clearance[part] = rows.value, rows.clearance
            begin = part.stop
        return whole


def _least(rows: BarrierRows) -> LeastBarrier:
    at = int(rows.clearance.argmin())
    return LeastBarrier(
        int(rows.kind),
        int(rows.nodes[at, -1]),
        int(rows.obstacle[at]),
        float(rows.value[at]),
        float(rows.clearance[at]),
    )


def _touching(barriers: Sequence[BarrierRows], tolerance: float) -> tuple[int, ...]:
    """Return the nodes that are this close to an obstacle or the wall, rising."""
    near = [rows for rows in barriers if rows.kind in TOUCHABLE and len(rows.value)]
    return tuple(sorted({node for rows in near for node in rows.nodes[rows.clearance <= tolerance, -1].tolist()}))


def node_clearance(margins: Any, count: int) -> NDArray[np.float64]:
    """Return the minimum clearance of an obstacle or the wall for each of `count` nodes [m]; inf where none is near.

    Args:
        margins: `Margins`, or a message SafetyMargins.
        count: of nodes, more than the greatest index in the margins.
    """
    clearance = np.full(count, np.inf)
    near = np.isin(np.asarray(margins.kind, dtype=np.uint8), TOUCHABLE)
    nodes = np.asarray(margins.node, dtype=np.intp)
    np.minimum.at(clearance, nodes[near], np.asarray(margins.clearance)[near])
    return clearance
