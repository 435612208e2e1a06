"""Whether goals are met: by the needle's poses and the thread as they are, not by the path that was planned."""

from __future__ import annotations

import math

import numpy as np
import shapely
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.planning.procedure import PassThrough, Procedure, Wrap
from magnetosuture_thread.scene import WALL_NAME, Scene

Vector = NDArray[np.float64]


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


class GoalJudge:
    """Follows needle and thread through the goals of a procedure.

    A pass is met when the middle of the needle's chord has crossed the line across the gap once more in its direction
    than against it, since its goal began. A wrap is met when the thread, from its free end to the needle, winds about
    the shape by the angles of all wraps about it so far; a thread that slips off undoes it.

    Args:
        procedure: its goals.
        scene: dish and shapes.

    Attributes:
        crossed: net crossings of the present goal's gap.
        windings: of the thread about each shape that is wrapped [rad]; NaN where no thread is known.
    """

    def __init__(self, procedure: Procedure, scene: Scene) -> None:
        self._procedure = procedure
        self._lines = {
            index: lines_of_pass(scene, goal)
            for index, goal in enumerate(procedure.goals)
            if isinstance(goal, PassThrough)
        }
        wrapped = dict.fromkeys(goal.around for goal in procedure.goals if isinstance(goal, Wrap))
        self._centres = {name: centre_of(scene, name) for name in wrapped}
        self._goal, self.crossed = 0, 0
        self._middle: Vector | None = None
        self.windings = dict.fromkeys(self._centres, math.nan)

    def in_scene(self, scene: Scene) -> GoalJudge:
        """Return a judge that goes on in another scene, which has the shapes of all goals."""
        other = GoalJudge(self._procedure, scene)
        other._goal, other.crossed, other._middle = self._goal, self.crossed, self._middle
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
            self.windings = {name: winding(thread, centre) for name, centre in self._centres.items()}

    @property
    def is_met(self) -> bool:
        """Whether the present goal is met, as far as it is a pass or a wrap."""
        goal = self._procedure.goals[self._goal]
        if isinstance(goal, PassThrough):
            return self.crossed >= 1
        return not isinstance(goal, Wrap) or self.left_to_wind <= 0.02  # rad; it trembles with the measured thread

    @property
    def left_to_wind(self) -> float:
        """Angle that the thread winds less than the present goal, a wrap, asks for [rad]; NaN where it is not known."""
        return self._short_by(self._goal)

    def missing(self, goal: int) -> str:
        """Return in words what is missing of a pass or a wrap."""
        wanted = self._procedure.goals[goal]
        if isinstance(wanted, PassThrough):
            return f"the needle did not pass between {' and '.join(wanted.between)}"
        assert isinstance(wanted, Wrap)
        now, needed = self.windings[wanted.around], abs(self._procedure.windings[goal])
        if math.isnan(now):
            return "the thread is not known"
        wound = math.degrees(math.copysign(1.0, wanted.swept) * now)
        return f"the thread slips on {wanted.around}: it winds {wound:.0f} of {math.degrees(needed):.0f} degrees"

    def lost_wrap(self) -> str:
        """Return in words which wrap the thread has slipped off; empty for none.

        A thread that is led off straight may wind by half a turn less.
        """
        last = {goal.around: index for index, goal in enumerate(self._procedure.goals) if isinstance(goal, Wrap)}
        lost = [index for index in last.values() if self._short_by(index) > math.pi]
        return self.missing(lost[0]) if lost else ""

    def _short_by(self, index: int) -> float:
        """Return the angle that the thread winds less than a wrap asks for [rad]; NaN where it is not known."""
        wrap = self._procedure.goals[index]
        assert isinstance(wrap, Wrap)
        missing = self._procedure.windings[index] - self.windings[wrap.around]
        return math.copysign(1.0, wrap.swept) * missing
