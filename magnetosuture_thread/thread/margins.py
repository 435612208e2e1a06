"""The margins of a prediction: the value of every barrier, and the friction that follows from them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.barrier import OBSTACLE, WALL, BarrierRows
from magnetosuture_thread.geometry.polyline import Points, Table, Vector

SOLID = (OBSTACLE, WALL)
"""Barriers of what a thread can touch."""


class FrictionState(IntEnum):
    """What the thread does between obstacles; the numbers are those of the message SafetyMargins."""

    UNKNOWN = 0
    FREE = 1
    SLIDING = 2
    STUCK = 3


@dataclass(frozen=True)
class Friction:
    """Where the thread is under friction, and by how much that slows the needle.

    Attributes:
        state: of the whole thread.
        nodes: that are close to two obstacles or more, rising.
        slowdown: factor on the needle's speed.
    """

    state: FrictionState
    nodes: tuple[int, ...]
    slowdown: float


UNKNOWN = Friction(FrictionState.UNKNOWN, (), 1.0)

Colour = tuple[float, float, float]


def friction_colour(friction: Friction) -> Colour:
    """Return the display colour of a friction state: red, green and blue, 0 to 1.

    Green where free, orange where pulled, deeper with each node under friction, blue at rest, grey where unknown.

    >>> friction_colour(Friction(FrictionState.FREE, (), 1.0))
    (0.12, 0.62, 0.33)
    """
    if friction.state is FrictionState.SLIDING:
        depth = min(1.0, (len(friction.nodes) - 1) / 19)  # from 20 nodes on it gets no deeper
        red, green, blue = ((1.0 - depth) * a + depth * b for a, b in ((1.0, 0.78), (0.70, 0.23), (0.25, 0.0)))
        return red, green, blue
    others = {FrictionState.FREE: (0.12, 0.62, 0.33), FrictionState.STUCK: (0.10, 0.42, 0.85)}
    return others.get(friction.state, (0.5, 0.5, 0.5))


@lru_cache(maxsize=256)
def constant_column(value: float, count: int, kind: str = "f8") -> NDArray[Any]:
    """Return a column of one value, shared and read-only."""
    column = np.full(count, value, kind)
    column.flags.writeable = False
    return column


def _nothing() -> Vector:
    return constant_column(0.0, 0)


@dataclass(eq=False)
class BarrierMargins:
    """The margins of one barrier, an entry for each of its rows. Not to be written to.

    Attributes:
        barrier: its name.
        node: index of the node, shape (m,); 0 is the needle's tail.
        obstacle: index of the scene's shape, -1 where there is none, shape (m,).
        value: h, safe at >= 0, shape (m,); [m] for an obstacle and the wall, [m^4] for stiffness, [m^2] for
            connectivity and compression, else the barrier's own unit.
        clearance: the same margin as a distance, shape (m,) [m]; of an obstacle and the wall that of the node and the
            half segments beside it, so that the least is that of the whole thread.
        bound: the clearance is greater than this with a probability of 99 %, shape (m,) [m]; -inf where the thread's
            covariance is not known.
        normal: of an obstacle and the wall, derivative of the value by the node's position, shape (m, d); else empty.
    """

    barrier: str
    node: NDArray[np.uint32]
    obstacle: NDArray[np.int32]
    value: Vector
    clearance: Vector
    bound: Vector = field(default_factory=_nothing)
    normal: Table = field(default_factory=_nothing)

    def __post_init__(self) -> None:
        """Take no bound as one that is not known."""
        if len(self.bound) != len(self.clearance):
            self.bound = constant_column(-math.inf, len(self.clearance))

    @classmethod
    def from_rows(cls, rows: BarrierRows) -> BarrierMargins:
        """Return the margins of the rows of any barrier."""
        nodes, obstacle = rows.nodes[:, -1].astype(np.uint32), rows.obstacle.astype(np.int32)
        return cls(rows.name, nodes, obstacle, rows.value, rows.clearance)

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


@dataclass(eq=False)
class Margins(Mapping[str, BarrierMargins]):
    """The margins of all barriers at one instant, by the barriers' names. Not to be written to.

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
        """The row of least clearance of each barrier that has rows, as margins of one row; its bound is the least."""
        return tuple(_row(margins, margins.closest) for margins in self.barriers if len(margins))

    @classmethod
    def of(cls, barriers: Sequence[BarrierMargins], contact_tolerance: float, scene_version: str = "") -> Margins:
        """Return the margins of barriers at the same positions.

        Args:
            barriers: the margins of each, in SI units.
            contact_tolerance: a node touches a shape or the wall to which it, or half a segment beside it, is this
                close [m].
            scene_version: of the scene.
        """
        nodes: set[int] = set()
        for margins in barriers:
            if margins.barrier in SOLID and len(margins.value):
                nodes.update(margins.node[margins.clearance <= contact_tolerance].tolist())
        return cls(tuple(barriers), tuple(sorted(nodes)), UNKNOWN, scene_version)


def _row(margins: BarrierMargins, row: int) -> BarrierMargins:
    part = slice(row, row + 1)
    value, clearance = margins.value[part], margins.clearance[part]
    least = np.array([margins.bound.min(initial=math.inf)])
    return BarrierMargins(margins.barrier, margins.node[part], margins.obstacle[part], value, clearance, least)


def node_clearance(margins: Margins, count: int) -> Vector:
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


@dataclass(frozen=True)
class FrictionLaw:
    """Classifies friction from the values of the obstacle barriers alone; no force is computed.

        index = {i >= 1 : h_obs,i,O < threshold for two obstacles O or more}
        slowdown = beta^|index|  where a node of the index moves faster than `stuck_speed`, else 1

    Source: [Forghani2025], algorithm "Real-Time Thread Sim with Visual Feedback". Deviation: v_i != 0, which
    holds for every number that was ever computed, is a speed above a bound, as in the source's own draft;
    one node of the index that moves is enough for the thread to be pulled.

    Attributes:
        threshold: of h_obs,i,O, a distance [m].
        beta: 0 < beta <= 1.
        stuck_speed: a node that is not faster rests [m/s].
        by_bound: whether h less what the 99 % bound is below the clearance counts in place of h, where there is one.
    """

    threshold: float
    beta: float
    stuck_speed: float
    by_bound: bool = False

    def classify(self, margins: Mapping[str, BarrierMargins], speeds: Vector) -> Friction:
        """Return the friction of a thread.

        Args:
            margins: of all barriers, by name; only those of the obstacles count.
            speeds: of each node, shape (n + 1,) [m/s].
        """
        obstacle = margins[OBSTACLE]
        value = obstacle.value
        if self.by_bound:
            value = np.where(np.isfinite(obstacle.bound), value - (obstacle.clearance - obstacle.bound), value)
        close = np.bincount(obstacle.node[value < self.threshold], minlength=len(speeds))
        close[0] = 0  # the needle: what holds it back is no friction of the thread
        index = np.flatnonzero(close >= 2)
        if not len(index):
            return Friction(FrictionState.FREE, (), 1.0)
        nodes = tuple(index.tolist())
        if float(speeds[index].max()) <= self.stuck_speed:
            return Friction(FrictionState.STUCK, nodes, 1.0)
        return Friction(FrictionState.SLIDING, nodes, self.beta ** len(nodes))


class NodeMotion:
    """The nodes' velocities, averaged: a tracked needle trembles, and its thread with it.

        w <- w + (1 - exp(-dt / T)) (dx / dt - w)

    Args:
        averaging: T, 0 for none [s].

    Attributes:
        averaging: T.
    """

    def __init__(self, averaging: float) -> None:
        self.averaging = averaging
        self._last: Points | None = None
        self._velocity: Points | None = None

    @property
    def speeds(self) -> Vector:
        """Each node's speed, shape (n + 1,) [m/s]; empty before the first time."""
        if self._velocity is None:
            return np.empty(0)
        return np.asarray(np.sqrt(np.einsum("ij,ij->i", self._velocity, self._velocity)))

    def update(self, vertices: Points, interval: float) -> Vector:
        """Return each node's speed, shape (n + 1,) [m/s].

        Args:
            vertices: where the nodes are now, shape (n + 1, d) [m].
            interval: since the last time; 0 to begin anew, at rest [s].
        """
        last, velocity = self._last, self._velocity
        if last is None or velocity is None or last.shape != vertices.shape or interval <= 0.0:
            velocity = np.zeros(vertices.shape)
        else:
            share = 1.0 - math.exp(-interval / self.averaging) if self.averaging > 0.0 else 1.0
            velocity = velocity + share * ((vertices - last) / interval - velocity)
        self._last, self._velocity = vertices, velocity
        return self.speeds
