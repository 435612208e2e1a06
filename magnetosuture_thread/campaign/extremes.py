"""Keeps the extremes of a run, and the instants that a report shows."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.campaign.loop import LoopFrame
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.planning.planner import NeedlePlanner
from magnetosuture_thread.planning.procedure import ProcedureLimits, Wrap
from magnetosuture_thread.safety.packed_scene import measure, pack_scene
from magnetosuture_thread.scene import Scene

REST_WAY = 5e-5  # m; of the tip, that a needle covers if it does not rest
LAST_TIME = 4.0  # s; that the last instants cover
LAST_INSTANTS = 6


@dataclass(frozen=True)
class RunInstant:
    """A frame of a run, as a report shows it.

    Attributes:
        frame: of the loop.
        axis: of the needle in truth, shape (k, 2) [m].
        clearance: of the axis from wall and shapes [m].
        goal: index of the goal then.
        path: of the needle's middle as planned then, shape (m, 2) [m]; None without one.
    """

    frame: LoopFrame
    axis: Points
    clearance: float
    goal: int
    path: Points | None


class RunExtremes:
    """Keeps the extremes of a run.

    Args:
        planner: whose needle it is.
        scene: around it.
        limits: of each goal.
        wrap: whose angle is measured; None for none.

    Attributes:
        clearance: minimum of the needle's axis from wall and shapes [m].
        penetration: maximum of a node of the thread into them [m].
        rest: longest time for which the needle did not move while the procedure ran [s].
        wrapped: maximum angle that the thread swept about the shape of the wrap [deg].
        tension: peak of the thread [N].
        friction_nodes: maximum under friction at once, by the model.
        tension_excess: maximum of the tension above the limit of the goal that is pursued [N].
        friction_excess: the same of the nodes under friction.
        closest: the instant with the minimum clearance; None before the first frame.
    """

    def __init__(
        self, planner: NeedlePlanner, scene: Scene, limits: Sequence[ProcedureLimits], wrap: Wrap | None
    ) -> None:
        self._planner, self._wrap, self._scene, self._limits = planner, wrap, scene, limits
        self._packed = pack_scene(scene)
        self.clearance, self.penetration, self.rest, self.wrapped = math.inf, 0.0, 0.0, 0.0
        self.tension, self.friction_nodes = 0.0, 0
        self.tension_excess, self.friction_excess = -limits[0].tension, -limits[0].friction_nodes
        self.closest: RunInstant | None = None
        self._last: deque[RunInstant] = deque()
        self._angle = 0.0  # of the needle's chord [rad]
        self._anchor: tuple[float, float, float, float] | None = None

    def update(self, frame: LoopFrame, running: bool, goal: int, path: Points | None) -> None:
        """Take a frame.

        Args:
            frame: of the loop.
            running: whether the needle is to move.
            goal: index of the goal.
            path: of the needle's middle as planned, shape (m, 2) [m]; None without one.
        """
        heading = np.array([math.cos(frame.heading), math.sin(frame.heading)])
        middle, angle = self._planner.pose(frame.tail, heading)
        c, s = math.cos(angle), math.sin(angle)
        axis = self._planner.body @ np.array([[c, s], [-s, c]]) + middle
        instant = RunInstant(frame, axis, self._distance(axis), goal, path)
        if instant.clearance < self.clearance:
            self.clearance, self.closest = instant.clearance, instant
        self.penetration = max(self.penetration, -self._distance(frame.thread))
        self.tension = max(self.tension, frame.tension)
        self.friction_nodes = max(self.friction_nodes, frame.condition.friction_nodes)
        limits = self._limits[goal]
        self.tension_excess = max(self.tension_excess, frame.tension - limits.tension)
        self.friction_excess = max(self.friction_excess, frame.condition.friction_nodes - limits.friction_nodes)
        if self._wrap is not None:
            swept = math.degrees(self._planner.swept_by(self._wrap.around, frame.thread))
            self.wrapped = max(self.wrapped, abs(swept))
        # Not wrapped at a half turn, over which noise would be a turn of the needle.
        self._angle += math.remainder(angle - self._angle, 2.0 * math.pi)
        at = (frame.time, float(middle[0]), float(middle[1]), self._planner.lever * self._angle)
        if not running or self._anchor is None or math.dist(at[1:], self._anchor[1:]) > REST_WAY:
            self._anchor = at
        self.rest = max(self.rest, frame.time - self._anchor[0])
        self._last.append(instant)
        while self._last[0].frame.time < frame.time - LAST_TIME:
            self._last.popleft()

    def last_instants(self) -> tuple[RunInstant, ...]:
        """Return instants of the last seconds, evenly spaced, the last frame among them."""
        count = min(LAST_INSTANTS, len(self._last))
        return tuple(self._last[round(index)] for index in np.linspace(0, len(self._last) - 1, count))

    def _distance(self, points: Points) -> float:
        shapes = len(self._packed.shapes)
        found, normal = np.empty((len(points), shapes)), np.empty((len(points), shapes, 2))
        measure(np.ascontiguousarray(points), self._packed, found, normal)
        wall = self._scene.dish.radius - float(np.hypot(points[:, 0], points[:, 1]).max())
        return min(wall, float(found.min(initial=math.inf)))
