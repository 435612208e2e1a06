"""The goals of a procedure, judged by the ground truth of a simulation.

Nothing here is shared with what plans and judges the goals in the nodes.
"""

from __future__ import annotations

import cmath
import math

import numpy as np
import shapely

from magnetosuture_thread.geometry.polyline import Vector
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.planning.procedure import (
    BringEnd,
    GoTo,
    KeepSide,
    Lay,
    PassThrough,
    Procedure,
    TakeOff,
    Tighten,
    Unwind,
    Wind,
    WindingGoal,
    Withdraw,
    Wrap,
)

ESTIMATE_ERROR = 2e-4  # m, by which an estimated thread may be off


class GoalTruth:
    """Collects what becomes of each goal, frame by frame.

    A pass counts where the middle of the needle's chord crosses the line across the gap once more in the goal's
    direction than against it, from the end of the goal before to its own; a wrap where the thread winds so far when the
    goal ends, and not half a turn less at the end of the procedure; a place where the needle is there when the goal
    ends; a thread is tight where it is as near to its shape as wanted. A thread lies along a line where no point of
    either is farther than the tolerance from the other.

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
        failures = [f"goal {index + 1} in truth: {problem}" for index, problem in sorted(self._problems.items())]
        last = {goal.around: k for k, goal in enumerate(self._procedure.goals) if isinstance(goal, WindingGoal)}
        lost = [self._unwound(index, math.pi) for index in last.values() if ended]
        return failures + [f"at the end, {problem} in truth" for problem in filter(None, lost)]

    def _problem(self, index: int, at: complex, along: complex) -> str:
        goal, problem = self._procedure.goals[index], ""
        if isinstance(goal, PassThrough):
            crossings = self._passed[index]
            return "" if crossings >= 1 else f"{crossings} net crossings between {' and '.join(goal.between)}"
        if isinstance(goal, WindingGoal):
            problem = self._unwound(index, 0.1)  # rad, by which an estimated thread may be off
        if isinstance(goal, Lay):
            problem = _beyond(self._off_line(goal), goal.tolerance, "off its line", "the thread")
        elif isinstance(goal, BringEnd):
            off = math.dist(self._thread[-1], goal.position)
            problem = _beyond(off, goal.tolerance, "from its place", "the free end")
        elif isinstance(goal, TakeOff):
            away = float(self._distances(goal.around, self._thread).min())
            if away < goal.clearance - ESTIMATE_ERROR:
                problem = f"the thread is {1e3 * away:.2f} mm from {goal.around}"
        elif isinstance(goal, Tighten) and goal.clearance > 0.0:
            # Of the part that goes around the shape.
            swept = np.cumsum([0.0, *self._steps(goal.around)])
            first, last = sorted((int(np.argmin(swept)), int(np.argmax(swept))))
            away = float(self._distances(goal.around, self._thread[first : last + 1]).max())
            problem = _beyond(away, goal.clearance, f"from {goal.around}", "the thread")
        return problem or (self._misplaced(goal, at, along) if isinstance(goal, GoTo | Withdraw | KeepSide) else "")

    def _off_line(self, goal: Lay) -> float:
        """Return how far thread and line are apart, of 2,000 points on each [m]."""
        share, turn = np.linspace(0.0, 1.0, 2000), np.array([1.0, 1.0j])

        def spread(points: Vector) -> Vector:
            along = np.cumsum([0.0, *np.abs(np.diff(points @ turn))])
            return np.asarray(np.interp(share * along[-1], along, points @ turn))

        line, thread = spread(np.array(goal.along).reshape(-1, 2)), spread(self._thread)
        length = float(np.abs(np.diff(self._thread @ turn)).sum())
        if goal.stretch:
            first, last = (round(1999 * min(1.0, at / length)) for at in goal.stretch)
        else:
            first, last = sorted(int(np.abs(thread - end).argmin()) for end in (line[0], line[-1]))
        apart = np.abs(line[:, None] - thread[None, first : last + 1])
        return float(max(apart.min(axis=0).max(), apart.min(axis=1).max()))

    def _unwound(self, index: int, slack: float) -> str:
        """Return how the thread winds about the shape of a goal, if that is off by more than an angle [rad]."""
        goal = self._procedure.goals[index]
        assert isinstance(goal, WindingGoal)
        # From its free end to the needle.
        wound, least, greatest = -float(np.sum(self._steps(goal.around))), -math.inf, math.inf
        if isinstance(goal, Wrap):
            needed = self._needed(index)
            least, greatest = (needed, math.inf) if goal.sense == "counterclockwise" else (-math.inf, needed)
        elif isinstance(goal, Wind):
            least, greatest = goal.swept - goal.tolerance, goal.swept + goal.tolerance
        elif isinstance(goal, KeepSide):  # the thread passes the shape at its left in the sense of a clock
            least, greatest = (-2.0 * math.pi, 0.0) if goal.side == "left" else (0.0, 2.0 * math.pi)
        else:
            greatest = goal.angle if isinstance(goal, Unwind) else math.pi
            least = -greatest
        if least - slack <= wound <= greatest + slack:
            return ""
        limits = " to ".join(f"{math.degrees(limit):.0f}" for limit in (least, greatest) if math.isfinite(limit))
        return f"the thread winds {math.degrees(wound):.0f} of {limits} degrees about {goal.around}"

    def _misplaced(self, goal: GoTo | Withdraw | KeepSide, at: complex, along: complex) -> str:
        place = goal.position if isinstance(goal, GoTo) else goal.to
        assert self._start is not None
        off = abs(at - (complex(*place) if place else self._start))
        if off > goal.tolerance + 5e-5:  # m, with the noise of a tracked needle
            return f"{1e3 * off:.2f} mm from its place"
        if isinstance(goal, GoTo) and goal.heading:
            turned = cmath.phase(along / cmath.rect(1.0, goal.heading[0]))
            return f"{turned:.2f} rad from its heading" if abs(turned) > 0.35 else ""
        return ""

    def _needed(self, index: int) -> float:
        """Return the angle by which the thread is to wind about a wrap's shape once that is met [rad]."""
        needed, name = 0.0, getattr(self._procedure.goals[index], "around", "")
        for goal in self._procedure.goals[: index + 1]:
            if isinstance(goal, WindingGoal) and goal.around == name:
                swept = goal.swept if isinstance(goal, Wrap | Wind) else 0.0
                needed = swept + (needed if isinstance(goal, Wrap) else 0.0)
        return needed

    def _steps(self, name: str) -> Vector:
        """Return the angles that the pieces of the thread sweep about a shape, from the needle on [rad]."""
        centre = self._solid(name).centroid
        seen = self._thread @ np.array([1.0, 1.0j]) - complex(centre.x, centre.y)
        return np.asarray(np.angle(seen[1:] / seen[:-1]))

    def _distances(self, name: str, points: Vector) -> Vector:
        return np.asarray(shapely.distance(shapely.points(points), self._solid(name)))

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
        distances = [shapely.distance(points, second) for points in sampled]
        least, direction, lines = np.min(distances), complex(*goal.direction) / abs(complex(*goal.direction)), []
        for points, distance in zip(sampled, distances, strict=True):
            near = distance <= 1.001 * least + 1e-7
            starts = np.flatnonzero(near & ~np.roll(near, 1)) if not near.all() else [0]
            for start in starts:
                count = int(np.argmin(np.roll(near, -start))) or len(near)  # of the run
                middle = points[(start + count // 2) % len(near)]
                (x, y), (u, v) = shapely.get_coordinates(shapely.shortest_line(middle, second))
                begin, along = complex(x, y), complex(u - x, v - y)
                part = (direction / (1j * along / abs(along))).real
                if abs(part) >= 0.5:
                    lines.append((begin, along) if part > 0.0 else (begin + along, -along))
        return lines


def _crosses(begin: complex, along: complex, before: complex, after: complex) -> int:
    """Return 1 where a step crosses a line from its right to its left, -1 for the other way round, 0 where it does not.

    In the frame of the line, which there is from 0 to 1.
    """
    first, then = (before - begin) / along, (after - begin) / along
    if (first.imag < 0.0) == (then.imag < 0.0):
        return 0
    where = first + (then - first) * (first.imag / (first.imag - then.imag))
    return (1 if then.imag >= 0.0 else -1) if 0.0 <= where.real <= 1.0 else 0


def _beyond(off: float, limit: float, what: str, whose: str) -> str:
    """Return in words what is farther off than a limit and the error of an estimated thread [m]."""
    return f"{whose} is {1e3 * off:.2f} mm {what}" if off > limit + ESTIMATE_ERROR else ""
