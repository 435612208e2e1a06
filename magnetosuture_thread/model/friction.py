"""Friction: where the thread is squeezed between two obstacles, and whether it is pulled through there."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.barrier import OBSTACLE
from magnetosuture_thread.geometry.polyline import Points

if TYPE_CHECKING:
    from magnetosuture_thread.model.margins import BarrierMargins


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
_GREEN, _BLUE, _GREY = (0.12, 0.62, 0.33), (0.10, 0.42, 0.85), (0.5, 0.5, 0.5)
_LIGHT_ORANGE, _DEEP_ORANGE = (1.0, 0.70, 0.25), (0.78, 0.23, 0.0)
_DEEPEST = 20  # nodes under friction, from which on orange gets no deeper


def friction_colour(friction: Friction) -> Colour:
    """Return the colour that tells a friction: red, green and blue, 0 to 1.

    Green where free, orange where pulled, deeper with each node under friction, blue at rest, grey where unknown.

    >>> friction_colour(Friction(FrictionState.FREE, (), 1.0))
    (0.12, 0.62, 0.33)
    """
    if friction.state is FrictionState.SLIDING:
        depth = min(1.0, (len(friction.nodes) - 1) / (_DEEPEST - 1))
        red, green, blue = ((1.0 - depth) * a + depth * b for a, b in zip(_LIGHT_ORANGE, _DEEP_ORANGE, strict=True))
        return red, green, blue
    return {FrictionState.FREE: _GREEN, FrictionState.STUCK: _BLUE}.get(friction.state, _GREY)


@dataclass(frozen=True)
class FrictionLaw:
    """Tells friction from the values of the obstacle barriers alone; no force is worked out.

        index = {i >= 1 : h_obs,i,O < threshold for two obstacles O or more}
        slowdown = beta^|index|  where a node of the index moves faster than `stuck_speed`, else 1

    Source: [Forghani2025], algorithm "Real-Time Thread Sim with Visual Feedback". Deviation: v_i != 0, which
    holds for every number that was ever computed, is a speed above a bound, as in the source's own draft;
    one node of the index that moves is enough for the thread to be pulled.

    Attributes:
        threshold: of h_obs,i,O, a distance [m].
        beta: 0 < beta <= 1.
        stuck_speed: a node that is not faster rests [m/s].
    """

    threshold: float
    beta: float
    stuck_speed: float

    def classify(self, margins: Mapping[str, BarrierMargins], speeds: NDArray[np.float64]) -> Friction:
        """Return the friction of a thread.

        Args:
            margins: of all barriers, by name; only those of the obstacles count.
            speeds: of each node, shape (n + 1,) [m/s].
        """
        obstacle = margins[OBSTACLE]
        close = np.bincount(obstacle.node[obstacle.clearance < self.threshold], minlength=len(speeds))
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
    """

    def __init__(self, averaging: float) -> None:
        self._averaging = averaging
        self._last: Points | None = None
        self._velocity: Points | None = None

    def update(self, vertices: Points, interval: float) -> NDArray[np.float64]:
        """Return each node's speed, shape (n + 1,) [m/s].

        Args:
            vertices: where the nodes are now, shape (n + 1, d) [m].
            interval: since the last time; 0 to begin anew, at rest [s].
        """
        last, velocity = self._last, self._velocity
        if last is None or velocity is None or last.shape != vertices.shape or interval <= 0.0:
            velocity = np.zeros(vertices.shape)
        else:
            share = 1.0 - math.exp(-interval / self._averaging) if self._averaging > 0.0 else 1.0
            velocity = velocity + share * ((vertices - last) / interval - velocity)
        self._last, self._velocity = vertices, velocity
        return np.asarray(np.sqrt(np.einsum("ij,ij->i", velocity, velocity)))

    def follow_on(self, other: NodeMotion) -> None:
        """Go on from the motion of a thread that this one takes the place of."""
        self._last, self._velocity = other._last, other._velocity
