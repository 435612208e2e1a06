"""Whether goals are met: by the needle's poses and the thread as they are, not by the path that was planned."""

from __future__ import annotations

import math

import numpy as np
import shapely
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.geometry.scene import WALL_NAME, Scene
from magnetosuture_thread.planning.procedure import (
    BringEnd,
    Lay,
    PassThrough,
    Procedure,
    TakeOff,
    ThreadGoal,
    WindingGoal,
    Wrap,
)

Vector = NDArray[np.float64]

PASSED = 4e-5  # m; off a gap's line: three times the noise of the tracked middle of a needle of 2.5 mm


def solid_of(scene: Scene, name: str) -> shapely.Geometry:
    """Return a shape of a scene, or its wall, as a geometry [m]."""
    if name == WALL_NAME and WALL_NAME not in scene.names:
        return shapely.Point(0.0, 0.0).buffer(scene.dish.radius, quad_segs=256).exterior
    return next(shape.solid for shape in scene.shapes if shape.name == name)


def centre_of(scene: Scene, name: str) -> Vector:
    """Return the centroid of a shape, shape (2,) [m]."""
    return np.array(solid_of(scene, name).centroid.coords[0])


def gap_lines(scene: Scene, between: tuple[str, ...]) -> list[Points]:
    """Return the lines across the gaps between two shapes, from one to the other, each of shape (2, 2) [m].

    A gap is where the shapes are nearest, within a thousandth of their distance; its line is in the middle of that
    stretch. Shapes that touch have none, nor has one that is as far from the other all around, nor one that is gone.
    """
    if not set(between) <= {WALL_NAME, *scene.names}:
        return []
    first, second = sorted((solid_of(scene, name) for name in between), key=lambda solid: solid.area, reverse=True)
    width = first.distance(second)
    if not width > 0.0:
        return []
    nearest = first.boundary.intersection(second.buffer(1.001 * width, quad_segs=64))
    stretches = [
        part for part in shapely.get_parts(shapely.line_merge(nearest)) if part.length > 0.0 and not part.is_ring
    ]
    middles = [part.interpolate(0.5, normalized=True) for part in stretches]
    return [np.array(shapely.shortest_line(middle, second).coords) for middle in middles]


def lines_of_pass(scene: Scene, goal: PassThrough) -> list[Points]:
    """Return the lines across the gaps that a goal passes, which its direction crosses from right to left.

    The gaps are those whose own direction is within 60 degrees of the goal's.
    """
    along = np.array(goal.direction) / math.hypot(*goal.direction)
    found = []
    for line in gap_lines(scene, goal.between):
        x, y = (line[1] - line[0]) / math.dist(*line)
        if abs(share := float(x * along[1] - y * along[0])) >= 0.5:
            found.append(line if share > 0.0 else line[::-1])
    return found


def crossings(line: Points, before: Vector, after: Vector) -> int:
    """Return 1 for a step that crosses a line from its right to its left, -1 for the other way round, else 0."""
    (x, y), along = line[0], line[1] - line[0]
    was_left, is_left = (bool(along[0] * (at[1] - y) >= along[1] * (at[0] - x)) for at in (before, after))
    if was_left == is_left or not shapely.LineString([before, after]).intersects(shapely.LineString(line)):
        return 0
    return 1 if is_left else -1


def winding(thread: Points, centre: Vector) -> float:
    """Return the angle that a thread sweeps about a point from its free end to its tail, which comes first [rad]."""
    if not len(thread):
        return 0.0
    turns = np.unwrap(np.arctan2(*(thread - centre).T[::-1]))
    return float(turns[0] - turns[-1])


def left_to_wind(allowed: tuple[float, float], now: float) -> float:
    """Return the least angle by which a winding has to change to be within an interval [rad]; NaN of one unknown."""
    least, greatest = allowed
    return max(least - now, 0.0) + min(greatest - now, 0.0)


def resampled(line: Points) -> Points:
    """Return 40 points of a line, evenly spaced, from its first to its last one, shape (40, 2) [m]."""
    return points_at(line, np.linspace(0.0, arc_lengths(line)[-1], 40))


def part_along(thread: Points, line: Points, stretch: tuple[float, ...]) -> Points:
    """Return the part of a thread that is to lie along a line, in the order of the line's points, shape (k, 2) [m].

    Args:
        thread: the tail first, shape (n + 1, 2) [m].
        line: shape (m, 2) [m].
        stretch: arc lengths of the part from the tail on [m]; empty for what is between the points of the thread that
            are nearest to the line's ends.
    """
    curve = shapely.LineString(thread)
    begin, end = stretch or (curve.line_locate_point(shapely.Point(point)) for point in (line[0], line[-1]))
    part = points_at(thread, np.linspace(begin, end, 40))
    if stretch and math.dist(part[0], line[0]) + math.dist(part[-1], line[-1]) > (
        math.dist(part[0], line[-1]) + math.dist(part[-1], line[0])
    ):
        part = part[::-1]
    return part


def miss(goal: ThreadGoal, allowed: tuple[float, float], thread: Points, solid: shapely.Geometry | None) -> float:
    """Return by how much a thread misses a goal, as a share of what the goal tolerates: 1 or less is met.

    Of a line it is the greatest distance between points at equal shares of its length and of that of the thread along
    it; of the free end its distance; of a winding how far it is from the middle of its interval; of a thread that is to
    be taken off also its clearance over its distance from the shape.

    Args:
        goal: of the thread.
        allowed: interval of the winding, see `Procedure.windings` [rad].
        thread: the tail first, shape (n + 1, 2) [m].
        solid: the goal's shape; None where it has none.
    """
    if isinstance(goal, Lay):
        line = np.reshape(goal.along, (-1, 2))
        apart = np.linalg.norm(part_along(thread, line, goal.stretch) - resampled(line), axis=1)
        return float(np.max(apart)) / goal.tolerance
    if isinstance(goal, BringEnd):
        return math.dist(thread[-1], goal.position) / goal.tolerance
    assert solid is not None
    middle, half = 0.5 * (allowed[0] + allowed[1]), 0.5 * (allowed[1] - allowed[0])
    off = abs(winding(thread, np.array(solid.centroid.coords[0])) - middle) / half
    if isinstance(goal, TakeOff):
        off = max(off, goal.clearance / max(shapely.LineString(thread).distance(solid), 1e-9))
    return off


class GoalJudge:
    """Follows needle and thread through the goals of a procedure.

    A pass is met when the middle of the needle's chord has crossed the line across the gap once more in its direction
    than against it, since its goal began, and is off it by `PASSED`. A wrap is met when the thread, from its free end
    to the needle, winds about the shape by the angles of all wraps about it so far; a thread that slips off undoes it.
    For the other goals of the thread see `miss`.

    Args:
        procedure: its goals.
        scene: dish and shapes.

    Attributes:
        crossed: net crossings of the present goal's gap.
        windings: of the thread about each shape of a `WindingGoal` [rad]; NaN where no thread is known.
        thread: as it was known last, the tail first, shape (n + 1, 2) [m]; None before that.
    """

    def __init__(self, procedure: Procedure, scene: Scene) -> None:
        self._procedure, self._scene = procedure, scene
        self._lines = {
            index: lines_of_pass(scene, goal)
            for index, goal in enumerate(procedure.goals)
            if isinstance(goal, PassThrough)
        }
        self._solids = {name: solid_of(scene, name) for name in procedure.lasting(len(procedure.goals))}
        self._goal, self.crossed = 0, 0
        self._middle: Vector | None = None
        self.thread: Points | None = None
        self.windings = dict.fromkeys(self._solids, math.nan)

    def in_scene(self, scene: Scene) -> GoalJudge:
        """Return a judge that goes on in another scene, which has the shapes of all goals."""
        other = GoalJudge(self._procedure, scene)
        other._goal, other.crossed, other._middle = self._goal, self.crossed, self._middle
        other.thread = self.thread
        return other

    def begin(self, goal: int) -> None:
        """Judge another goal from now on."""
        self._goal, self.crossed = goal, 0

    def update(self, middle: Vector, thread: Points | None) -> None:
        """Take a pose of the needle and the thread then.

        Args:
            middle: of the needle's chord, shape (2,) [m].
            thread: the tail first, shape (n + 1, 2) [m]; None where it is not known.
        """
        if self._middle is not None:
            lines, step = self._lines.get(self._goal, ()), (self._middle, middle)
            self.crossed += sum(crossings(line, *step) for line in lines)
        self._middle = middle
        if thread is not None and len(thread) > 1:
            self.thread = thread
            self.windings = {name: winding(thread, centre_of(self._scene, name)) for name in self._solids}

    @property
    def is_met(self) -> bool:
        """Whether the present goal is met, as far as it is a pass or one of the thread."""
        goal = self._procedure.goals[self._goal]
        if isinstance(goal, PassThrough):
            lines = shapely.MultiLineString(self._lines[self._goal])
            return self.crossed >= 1 and lines.distance(shapely.Point(self._middle)) >= PASSED
        if isinstance(goal, Wrap):  # the angle trembles with the measured thread, in rad
            return abs(self.left_to_wind) <= 0.02
        return not isinstance(goal, ThreadGoal) or self.miss <= 1.0

    @property
    def miss(self) -> float:
        """By how much the present goal of the thread is missed, see `miss`; inf where no thread is known."""
        goal = self._procedure.goals[self._goal]
        assert isinstance(goal, ThreadGoal)
        solid = self._solids[goal.around] if isinstance(goal, WindingGoal) else None
        allowed = self._procedure.windings[self._goal]
        return math.inf if self.thread is None else miss(goal, allowed, self.thread, solid)

    @property
    def left_to_wind(self) -> float:
        """By how much the winding of the present goal has to change, see `left_to_wind` [rad]; NaN of one unknown."""
        return self._left(self._goal)

    def missing(self, goal: int) -> str:
        """Return in words what is missing of a pass or a goal of the thread."""
        wanted, allowed = self._procedure.goals[goal], self._procedure.windings[goal]
        if isinstance(wanted, PassThrough):
            return f"the needle did not pass between {' and '.join(wanted.between)}"
        if self.thread is None:
            return "the thread is not known"
        if isinstance(wanted, Lay | BringEnd):
            what = "thread is off its line" if isinstance(wanted, Lay) else "free end is off its place"
            off = 1e3 * wanted.tolerance * miss(wanted, allowed, self.thread, None)
            return f"the {what} by {off:.2f} mm, with a tolerance of {1e3 * wanted.tolerance:.2f} mm"
        assert isinstance(wanted, WindingGoal)
        if isinstance(wanted, TakeOff) and not self._left(goal):
            away = 1e3 * shapely.LineString(self.thread).distance(self._solids[wanted.around])
            return f"the thread is {away:.2f} mm from {wanted.around}, not {1e3 * wanted.clearance:.2f} mm"
        now = math.degrees(self.windings[wanted.around])
        if isinstance(wanted, Wrap):
            sense, needed = math.copysign(1.0, wanted.swept), math.degrees(min(map(abs, allowed)))
            return f"the thread slips on {wanted.around}: it winds {sense * now:.0f} of {needed:.0f} degrees"
        least, greatest = map(math.degrees, allowed)
        return f"the thread winds {now:.0f} degrees about {wanted.around}, not {least:.0f} to {greatest:.0f}"

    def lost_winding(self) -> str:
        """Return in words about which shape the thread does not wind any more as it is to; empty for none.

        A thread that is led off straight may wind by half a turn less.
        """
        last = self._procedure.lasting(len(self._procedure.goals)).values()
        lost = [index for index in last if abs(self._left(index)) > math.pi]
        return self.missing(lost[0]) if lost else ""

    def _left(self, index: int) -> float:
        goal = self._procedure.goals[index]
        assert isinstance(goal, WindingGoal)
        return left_to_wind(self._procedure.windings[index], self.windings[goal.around])
