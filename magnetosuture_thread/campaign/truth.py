"""Whether the goals of a procedure were made, by the ground truth of a simulation.

Nothing here is shared with what plans and judges the goals in the nodes.
"""

from __future__ import annotations

import cmath
import math
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from magnetosuture_thread.planning.procedure import GoTo, PassThrough, Procedure, Tighten, Withdraw, Wrap
from magnetosuture_thread.scene import Scene

Vector = NDArray[np.float64]


class GoalTruth:
    """Collects what becomes of each goal, frame by frame.

    A pass counts where the middle of the needle's chord crosses the line across the gap once more in the goal's
    direction than against it, from the end of the goal before to its own; a wrap where the thread winds so far when the
    goal ends, and not half a turn less at the end of the procedure; a place where the needle is there when the goal
    ends; a thread is tight where it is as near to its shape as wanted.

    Args:
        procedure: its goals.
        scene: dish and shapes.
    """

    def __init__(self, procedure: Procedure, scene: Scene) -> None:
        self._procedure, self._scene = procedure, scene
        self._passed = [0] * len(procedure.goals)
        self._problems: dict[int, str] = {}
        self._before: tuple[int, complex] | None = None
        self._start: complex | None = None
        self._thread = np.zeros((0, 2))
        self._lines = {k: self._gaps(goal) for k, goal in enumerate(procedure.goals) if isinstance(goal, PassThrough)}

    def update(self, met: int, middle: Vector, tail: Vector, thread: Vector) -> None:
        """Take a frame.

        Args:
            met: how many goals are met, as the nodes have it.
            middle: of the needle's chord, shape (2,) [m].
            tail: of the needle, shape (2,) [m].
            thread: the tail first, shape (n + 1, 2) [m].
        """
        at, self._thread = complex(*middle), thread
        self._start = at if self._start is None else self._start
        if self._before is not None:
            last, before = self._before
            if last < len(self._passed):
                for begin, along in self._lines.get(last, ()):
                    self._passed[last] += _crosses(begin, along, before, at)
            for index in range(last, met):
                if problem := self._problem(index, at, complex(*(middle - tail))):
                    self._problems[index] = problem
        self._before = met, at

    def failures(self, ended: bool) -> list[str]:
        """Return in words what was not made, of the goals that the nodes take for met.

        Args:
            ended: whether the nodes take all goals for met; then no wrap may have slipped off either.
        """
        found = [f"goal {index + 1} in truth: {problem}" for index, problem in sorted(self._problems.items())]
        last = {goal.around: k for k, goal in enumerate(self._procedure.goals) if isinstance(goal, Wrap)}
        for name, index in last.items() if ended else ():
            needed = self._needed(index)
            if needed and self._wound(name) / needed < 1.0 - math.pi / abs(needed):
                wound = f"{math.degrees(self._wound(name)):.0f} degrees of thread are left around {name}"
                found.append(f"{wound} in truth, of {math.degrees(needed):.0f}")
        return found

    def _problem(self, index: int, at: complex, along: complex) -> str:
        goal = self._procedure.goals[index]
        if isinstance(goal, PassThrough):
            made = self._passed[index]
            return "" if made >= 1 else f"{made} net crossings between {' and '.join(goal.between)}"
        if isinstance(goal, Wrap):
            wound, needed = self._wound(goal.around), self._needed(index)
            is_wound = (
                wound * math.copysign(1.0, needed) >= abs(needed) - 0.1
            )  # rad, by which an estimated thread may be off
            return (
                "" if is_wound else f"the thread winds {math.degrees(wound):.0f} of {math.degrees(needed):.0f} degrees"
            )
        if isinstance(goal, Tighten):
            return self._slack(goal) if goal.clearance > 0.0 else ""
        return self._misplaced(goal, at, along)

    def _misplaced(self, goal: GoTo | Withdraw, at: complex, along: complex) -> str:
        place = goal.position if isinstance(goal, GoTo) else goal.to
        assert self._start is not None
        off = abs(at - (complex(*place) if place else self._start))
        if off > goal.tolerance + 5e-5:  # m, with the noise of a tracked needle
            return f"{1e3 * off:.2f} mm from its place"
        if isinstance(goal, GoTo) and goal.heading:
            turned = cmath.phase(along / cmath.rect(1.0, goal.heading[0]))
            return f"{turned:.2f} rad from its heading" if abs(turned) > 0.35 else ""
        return ""

    def _slack(self, goal: Tighten) -> str:
        """Return how far the part of the thread that goes around a shape is from it, if that is too far."""
        swept = np.cumsum([0.0, *self._steps(goal.around)])
        first, last = sorted((int(np.argmin(swept)), int(np.argmax(swept))))
        part, solid = shapely.points(self._thread[first : last + 1]), self._solid(goal.around)
        away = float(shapely.distance(part, solid).max())
        return f"the thread is {1e3 * away:.2f} mm from {goal.around}" if away > goal.clearance + 2e-4 else ""

    def _needed(self, index: int) -> float:
        """Return the angle by which the thread is to wind about a wrap's shape once that is met [rad]."""
        wraps = [goal for goal in self._procedure.goals[: index + 1] if isinstance(goal, Wrap)]
        signs = {"counterclockwise": 1.0, "clockwise": -1.0}
        return sum(signs[wrap.sense] * wrap.angle for wrap in wraps if wrap.around == wraps[-1].around)

    def _wound(self, name: str) -> float:
        """Return the angle by which the thread winds about a shape, from its free end to the needle [rad]."""
        return -float(np.sum(self._steps(name)))

    def _steps(self, name: str) -> Vector:
        """Return the angles that the pieces of the thread sweep about a shape, from the needle on [rad]."""
        centre = self._solid(name).centroid
        seen = self._thread @ np.array([1.0, 1.0j]) - complex(centre.x, centre.y)
        return np.asarray(np.angle(seen[1:] / seen[:-1]))

    def _solid(self, name: str) -> shapely.Geometry:
        shapes = {shape.name: shape.solid for shape in self._scene.shapes}
        wall = shapely.Point(0.0, 0.0).buffer(self._scene.dish.radius, quad_segs=360).exterior
        return shapes.get(name, wall)

    def _gaps(self, goal: PassThrough) -> list[tuple[complex, complex]]:
        """Return start and vector of the lines across a gap, which the goal's direction crosses from right to left.

        They are found among thousands of points around the first shape: where those are nearest to the second one, in
        the middle of each run.
        """
        first, second = (self._solid(name) for name in goal.between)
        rings = shapely.get_parts(first.boundary if first.geom_type == "Polygon" else first)
        share = np.linspace(0.0, 1.0, 4000, endpoint=False)
        sampled = [shapely.line_interpolate_point(ring, share, normalized=True) for ring in rings]
        least = min(float(shapely.distance(points, second).min()) for points in sampled)
        return [line for points in sampled for line in self._lines_between(points, second, least, goal)]

    @staticmethod
    def _lines_between(
        points: Any, second: shapely.Geometry, least: float, goal: PassThrough
    ) -> list[tuple[complex, complex]]:
        """Return the lines from points around a shape to another, where they are nearest; see `_gaps`."""
        near = shapely.distance(points, second) <= 1.001 * least + 1e-7
        offset = int(np.argmin(near))  # a point that is not near, to begin with
        runs = np.split(np.roll(np.arange(len(near)), -offset), np.flatnonzero(np.diff(np.roll(near, -offset))) + 1)
        found, wanted = [], complex(*goal.direction) / abs(complex(*goal.direction))
        for run in runs:
            if not near[run[0]]:
                continue
            (x, y), (u, v) = shapely.get_coordinates(shapely.shortest_line(points[run[len(run) // 2]], second))
            begin, along = complex(x, y), complex(u - x, v - y)
            share = (wanted / (1j * along / abs(along))).real
            if abs(share) >= 0.5:
                found.append((begin, along) if share > 0.0 else (begin + along, -along))
        return found


def _crosses(begin: complex, along: complex, before: complex, after: complex) -> int:
    """Return 1 where a step crosses a line from its right to its left, -1 for the other way round, 0 where it does not.

    In the frame of the line, which there is from 0 to 1.
    """
    first, then = (before - begin) / along, (after - begin) / along
    if (first.imag < 0.0) == (then.imag < 0.0):
        return 0
    where = first + (then - first) * (first.imag / (first.imag - then.imag))
    return (1 if then.imag >= 0.0 else -1) if 0.0 <= where.real <= 1.0 else 0
