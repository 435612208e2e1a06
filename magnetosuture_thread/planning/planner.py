"""From goals to paths: what a goal asks of the needle's pose, and the way there through the scene."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from magnetosuture_thread.errors import ConfigurationError, MagnetosutureError
from magnetosuture_thread.geometry.needle_arc import needle_points
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.planning.path import (
    CELLS,
    DIRECTIONS,
    PREFERRED,
    STRIDE,
    BodyPath,
    LatticeGoal,
    body_clearance,
    clearance_at,
    map_clearance,
    search_lattice,
    smooth_path,
    turn_of,
)
from magnetosuture_thread.planning.procedure import (
    HEADING_TOLERANCE,
    Goal,
    GoTo,
    PassThrough,
    Procedure,
    ProcedureLimits,
    Tighten,
    Withdraw,
    Wrap,
)
from magnetosuture_thread.safety.motion import NeedleKinematics
from magnetosuture_thread.scene import Scene, SceneShape

Vector = NDArray[np.float64]

MARGINS = (3e-4, 1e-4, 3e-5, 5e-6)  # m; beyond the required clearance, for errors of control: the widest with a way
PLACE_SHARE, PLACE_STEPS = 0.7, 0.75  # of a goal's tolerance, and of the lattice: how far from its place a way may end


class PlanningError(MagnetosutureError):
    """There is no way to a goal.

    Args:
        problem: between which places.
        goal: its index, among those that were to be planned.
    """

    def __init__(self, problem: str, goal: int = 0) -> None:
        super().__init__(problem)
        self.goal = goal


@dataclass(frozen=True, eq=False)
class Gap:
    """The narrowest place between two shapes.

    Attributes:
        centre: midway between them, shape (2,) [m].
        along: unit vector that it is passed along, shape (2,).
        width: between the shapes [m].
    """

    centre: Vector
    along: Vector
    width: float


class NeedlePlanner:
    """Plans paths of the needle's body through a scene.

    Args:
        scene: dish and shapes.
        needle: its kinematics.
        keep_out: least distance of the needle's axis from wall and shapes [m].
        thread_length: of the thread behind it [m].
        axes: of the coils [rad], for `PathTracker`.

    Raises:
        ConfigurationError: the needle has no room in the dish.
    """

    def __init__(
        self,
        scene: Scene,
        needle: NeedleKinematics,
        keep_out: float,
        thread_length: float,
        axes: Sequence[float] = (),
    ) -> None:
        least = needle.chord + 2.0 * keep_out
        if scene.dish.diameter <= least:
            expected = f"more than {least:g} m, room for the needle and the clearance on both sides"
            raise ConfigurationError("scene.dish.diameter", scene.dish.diameter, expected)
        self.scene, self.needle, self.axes = scene, needle, tuple(axes)
        self.keep_out, self.thread_length = keep_out, thread_length
        self.near = map_clearance(scene)
        self.lever = 0.5 * needle.chord
        # Points a step of the grid apart, about the middle of the chord.
        axis = needle_points(needle.length, needle.curvature, self.near.step)[0]
        along = needle.chord_direction(np.array([1.0, 0.0]))
        turn = np.array([[along[0], along[1]], [-along[1], along[0]]])
        self.body = np.ascontiguousarray((axis - self.lever * along) @ turn.T)
        self._step = STRIDE * self.near.step
        self._size = CELLS // STRIDE + 1
        self._ways: dict[tuple[object, ...], Points] = {}  # found, by what was searched

    def pose(self, tail: Vector, heading: Vector) -> tuple[Vector, float]:
        """Return middle, shape (2,) [m], and angle of the chord [rad] of a needle with this tail and heading."""
        along = self.needle.chord_direction(heading)
        return tail + self.lever * along, math.atan2(float(along[1]), float(along[0]))

    def check(self, procedure: Procedure) -> None:
        """Refuse what can be seen to be impossible without planning.

        Raises:
            ConfigurationError: a name is not of the scene, a place is not free, a gap is too narrow or not there, the
                thread is too short for wraps that follow each other, or a tension is over the goal's own limit.
        """
        _check_procedure(procedure, self)

    def plan(
        self,
        goals: Sequence[Goal],
        limits: ProcedureLimits,
        middle: Vector,
        angle: float,
        start: Vector,
        swept: float | None = None,
    ) -> BodyPath:
        """Return a path from a pose through goals, one after the other.

        Args:
            goals: to reach.
            limits: on the way.
            middle: of the chord, shape (2,) [m]; see `pose`.
            angle: of the chord [rad].
            start: where the procedure began, shape (2,) [m].
            swept: what is left to sweep of the first goal, a wrap [rad]; all of it if None.

        Raises:
            PlanningError: there is no way to one of them.
        """
        required = max(self.keep_out, limits.clearance)
        targets = [self._lattice_goal(goal, start, None if index else swept) for index, goal in enumerate(goals)]
        for margin in MARGINS:
            states, ends, at = np.empty((0, 3)), [], self._nearest_free(middle, angle, required + margin)
            for target in targets:
                if at is None:
                    break
                found = self._search(target, required + margin, at)
                if not len(found):
                    at = None
                    break
                states = np.vstack([states, found])
                ends.append(len(states))
                at = self._state_of(found[-1])
            if at is not None and (last := self._end_of(goals[-1], start, states[-1], required + margin)) is not None:
                states = np.vstack([states, last])
                ends[-1] += 1
            if at is not None and len(states):
                # It begins where the needle is, which may be closer than what is required from then on.
                begin = np.array([[*middle, states[0, 2] + math.remainder(angle - states[0, 2], 2.0 * math.pi)]])
                states = np.vstack([begin, states])
                return smooth_path(states, np.array(ends), self.lever, self.body, required, margin, self.near)
        where, kept = f"{1e3 * middle[0]:.1f}, {1e3 * middle[1]:.1f} mm", f"{1e3 * required:.3g} mm around it"
        raise PlanningError(f"no way for the needle to {goals[len(ends)].GROUP} from {where}, with {kept}", len(ends))

    def standing_path(self, middle: Vector, angle: float, limits: ProcedureLimits) -> BodyPath:
        """Return a path of one pose, in which the needle stays, with the leeway that it has there."""
        near = body_clearance(float(middle[0]), float(middle[1]), angle, self.body, self.near)
        leeway = max(0.0, near - max(self.keep_out, limits.clearance))
        twice = np.tile(middle, (2, 1)), np.full(2, angle)
        return BodyPath(*twice, self.lever, np.full(2, leeway), np.zeros(1))

    def plan_all(self, procedure: Procedure, middle: Vector, angle: float) -> tuple[BodyPath, ...]:
        """Return the paths that a procedure will take, each through the goals of one `chain`.

        Raises:
            ConfigurationError: see `check`.
            PlanningError: there is no way to a goal.
        """
        self.check(procedure)
        start = middle
        paths: list[BodyPath] = []
        for index, goals in chains(procedure):
            try:
                paths.append(self.plan(goals, procedure.limits[index], middle, angle, start))
            except PlanningError as error:
                raise PlanningError(f"goals[{index + error.goal}]: {error}", index + error.goal) from None
            middle, angle = paths[-1].middles[-1], float(paths[-1].angles[-1])
        return tuple(paths)

    def gaps(self, goal: PassThrough) -> list[Gap]:
        """Return the gaps between the two shapes that are passed along the goal's direction."""
        wanted = np.array(goal.direction) / math.hypot(*goal.direction)
        found = [
            replace(gap, along=math.copysign(1.0, float(gap.along @ wanted)) * gap.along)
            for gap in self.gaps_between(*goal.between)
            if abs(gap.along @ wanted) >= 0.5
        ]
        least = min((gap.width for gap in found), default=0.0)
        return [gap for gap in found if gap.width <= 2.0 * least]

    def gaps_between(self, first_name: str, second_name: str) -> list[Gap]:
        """Return the narrowest places between two shapes, each passed along its direction or against it."""
        first, second = (map_clearance(self.scene, (name,)).distance for name in (first_name, second_name))
        width, step = first + second, self.near.step
        midway = (np.abs(first - second) <= 1.5 * step) & (self.near.distance >= 0.45 * width)
        if not midway.any():
            return []
        # Up to 1.03 of its least width it is one gap.
        narrow = midway & (width <= ndimage.minimum_filter(np.where(midway, width, np.inf), 9) * 1.03)
        labels, count = ndimage.label(narrow, np.ones((3, 3)))
        slope = np.asarray(np.gradient(first - second))
        found = []
        for label in range(1, count + 1):
            rows, columns = np.nonzero(labels == label)
            narrowest = float(width[rows, columns].min())
            across = np.array([slope[1][rows, columns].mean(), slope[0][rows, columns].mean()])
            if not (size := math.hypot(*across)) > 0.0:
                continue
            along = np.array([-across[1], across[0]]) / size
            # The middle of the gap along its direction, on the line midway between the shapes.
            points = self.near.origin + step * np.column_stack([columns, rows])
            found.append(Gap(points.mean(axis=0), along, narrowest))
        return found

    def thread_clearance(self, name: str, thread: Points) -> float:
        """Return the greatest distance from a shape of the part of a thread that sweeps the most about it [m]."""
        centre = self._centre(name)
        turns = np.unwrap(np.arctan2(*(thread - centre).T[::-1]))
        sense = math.copysign(1.0, turns[-1] - turns[0])
        # The part between the least and the greatest angle.
        first, last = sorted((int(np.argmin(sense * turns)), int(np.argmax(sense * turns))))
        from_shape = map_clearance(self.scene, (name,))
        return max(clearance_at(x, y, from_shape) for x, y in thread[first : last + 1].tolist())

    def bearing(self, name: str, point: Vector) -> float:
        """Return the direction of a point from the centre of a shape [rad]."""
        x, y = point - self._centre(name)
        return math.atan2(float(y), float(x))

    def swept_by(self, name: str, points: Points) -> float:
        """Return the angle that a polyline sweeps about a shape from its first point to its last [rad]."""
        turns = np.unwrap(np.arctan2(*(points - self._centre(name)).T[::-1]))
        return float(turns[-1] - turns[0])

    def _search(self, goal: LatticeGoal, kept: float, start: NDArray[np.int64]) -> Points:
        """Return x, y and direction of the states on the way to a goal, shape (k, 3); empty where there is none."""
        # A procedure is planned as a whole, and then goal by goal from the same points of the lattice.
        key = (start.tobytes(), kept, *(np.asarray(part).tobytes() for part in goal))
        if (found := self._ways.get(key)) is None:
            # 32 ways are kept.
            if len(self._ways) >= 32:
                self._ways.clear()
            found = self._ways[key] = search_lattice(
                start, self.body, self.lever, kept, kept + PREFERRED, goal, self.near
            )
        return found  # kept or not: another thread may have cleared what is kept

    def _state_of(self, state: Vector) -> NDArray[np.int64]:
        """Return column, row and direction of a state of the lattice."""
        column, row = np.rint((np.asarray(state[:2]) - self.near.origin) / self._step).astype(int)
        return np.array([column, row, int(np.argmin(np.abs(turn_of(DIRECTIONS - state[2]))))])

    def _nearest_free(self, middle: Vector, angle: float, required: float) -> NDArray[np.int64] | None:
        """Return the free state of the lattice that is nearest to a pose; None where none is near."""
        column, row = np.rint((middle - self.near.origin) / self._step).astype(int)
        best, found = np.inf, None
        for j in range(max(0, row - 4), min(self._size, row + 5)):
            for i in range(max(0, column - 4), min(self._size, column + 5)):
                x, y = self.near.origin + self._step * i, self.near.origin + self._step * j
                for k, direction in enumerate(DIRECTIONS):
                    turn = abs(math.remainder(direction - angle, 2.0 * math.pi))
                    off = math.hypot(x - middle[0], y - middle[1]) + self.lever * turn
                    if off < best and body_clearance(x, y, direction, self.body, self.near) >= required:
                        best, found = off, np.array([i, j, k])
        return found

    def _lattice_goal(self, goal: Goal, start: Vector, swept: float | None) -> LatticeGoal:
        everywhere, nowhere = np.ones((self._size, self._size), bool), np.full(2, np.nan)
        any_heading = np.ones(len(DIRECTIONS), bool)
        if isinstance(goal, Wrap):
            wanted = goal.swept if swept is None else swept
            return LatticeGoal(
                self._in_view_of(goal.around), everywhere, any_heading, wanted, self._centre(goal.around), nowhere
            )
        at = self.near.origin + self._step * np.arange(self._size)
        x, y = np.meshgrid(at, at)
        if isinstance(goal, PassThrough):
            places, headings = np.zeros_like(everywhere), np.zeros(len(DIRECTIONS), bool)
            for gap in self.gaps(goal):
                dx, dy = x - gap.centre[0], y - gap.centre[1]
                ahead, aside = dx * gap.along[0] + dy * gap.along[1], dy * gap.along[0] - dx * gap.along[1]
                places |= (ahead >= 0.0) & (ahead <= 4.0 * self._step) & (np.abs(aside) <= 0.5 * gap.width)
                off = np.abs(turn_of(DIRECTIONS - math.atan2(gap.along[1], gap.along[0])))
                # The needle may be 0.8 rad off the direction of a gap while it passes.
                headings |= off <= 0.8
            return LatticeGoal(everywhere, places, headings, 0.0, np.zeros(2), nowhere)
        place, tolerance = start, self._step
        headed: tuple[float, ...] = ()
        if isinstance(goal, GoTo):
            place, tolerance, headed = np.array(goal.position), goal.tolerance, goal.heading
        elif isinstance(goal, Tighten):
            place = np.array(goal.toward)
        else:
            place, tolerance = np.array(goal.to) if goal.to else start, goal.tolerance
        # At least the nearest point of the lattice.
        places = np.hypot(x - place[0], y - place[1]) <= max(PLACE_SHARE * tolerance, PLACE_STEPS * self._step)
        headings = np.abs(turn_of(DIRECTIONS - headed[0])) <= HEADING_TOLERANCE if headed else any_heading
        return LatticeGoal(everywhere, places, headings, 0.0, np.zeros(2), place)

    def _end_of(self, goal: Goal, start: Vector, state: Vector, kept: float) -> Vector | None:
        """Return the pose that a goal asks for, near a state of the lattice; None for none, or if it is not free."""
        if not isinstance(goal, GoTo | Withdraw) or PLACE_SHARE * goal.tolerance >= PLACE_STEPS * self._step:
            return None  # a state of the lattice is near enough
        x, y = goal.position if isinstance(goal, GoTo) else goal.to or start.tolist()
        angle = float(state[2])
        if isinstance(goal, GoTo) and goal.heading:
            angle += math.remainder(goal.heading[0] - angle, 2.0 * math.pi)
        return np.array([x, y, angle]) if body_clearance(x, y, angle, self.body, self.near) >= kept else None

    def _in_view_of(self, name: str) -> NDArray[np.bool_]:
        """Return from which points of the lattice nothing is between them and a shape's nearest point."""
        from_shape = map_clearance(self.scene, (name,)).distance[::STRIDE, ::STRIDE]
        others = tuple(other for other in self.scene.names if other != name)
        blocking = (
            map_clearance(self.scene, others).distance[::STRIDE, ::STRIDE] if others else np.full_like(from_shape, 1.0)
        )
        slope = np.array(np.gradient(from_shape))  # per step, rows first
        rows, columns = np.indices(from_shape.shape)
        free = blocking > 0.0
        for share in np.linspace(0.1, 1.0, 24):
            way = share * from_shape / self._step
            at = [
                np.clip(np.rint(index - way * part), 0, self._size - 1).astype(int)
                for index, part in ((rows, slope[0] / self._step), (columns, slope[1] / self._step))
            ]
            free &= blocking[at[0], at[1]] > 0.0
        return np.asarray(free)

    def _centre(self, name: str) -> Vector:
        return np.array(self._shape(name).solid.centroid.coords[0])

    def girth(self, name: str) -> float:
        """Return the length of a thread that lies around a shape once [m]."""
        return float(self._shape(name).solid.convex_hull.length)

    def _shape(self, name: str) -> SceneShape:
        return next(shape for shape in self.scene.shapes if shape.name == name)


def chain(procedure: Procedure, index: int) -> tuple[Goal, ...]:
    """Return the goals from one on that are reached on one path: up to the next at which the needle comes to rest."""
    limits = procedure.limits[index]
    last = index
    while last + 1 < len(procedure.goals) and procedure.limits[last + 1] == limits:
        # Where a tightened thread ends depends on the thread, and so does what follows.
        if not isinstance(procedure.goals[last], PassThrough | Wrap):
            break
        last += 1
    return procedure.goals[index : last + 1]


def chains(procedure: Procedure) -> list[tuple[int, tuple[Goal, ...]]]:
    """Return all chains of goals of a procedure, each with the index of its first goal; see `chain`."""
    found, index = [], 0
    while index < len(procedure.goals):
        found.append((index, chain(procedure, index)))
        index += len(found[-1][1])
    return found


def planned_duration(procedure: Procedure, paths: Sequence[BodyPath]) -> float:
    """Return the time of planned paths at the speeds of their goals, without friction [s]."""
    return sum(
        path.length / procedure.limits[index].speed for (index, _), path in zip(chains(procedure), paths, strict=True)
    )


def _check_procedure(procedure: Procedure, planner: NeedlePlanner) -> None:
    wrapped: defaultdict[str, float] = defaultdict(float)  # about each shape, by the wraps one after the other
    for index, (goal, limits) in enumerate(zip(procedure.goals, procedure.limits, strict=True)):
        where, required = f"goals[{index}].{goal.GROUP}", max(planner.keep_out, limits.clearance)
        if not isinstance(goal, Wrap):
            wrapped.clear()  # another goal may unwind the thread
        if isinstance(goal, PassThrough):
            _check_gap(planner, where, goal, required)
        elif isinstance(goal, Wrap):
            _check_name(planner, f"{where}.around", goal.around)
            wrapped[goal.around] += goal.swept
            needed = sum(abs(angle) / (2.0 * math.pi) * planner.girth(name) for name, angle in wrapped.items())
            if needed > planner.thread_length:
                before = ", with the wraps before it" if index and isinstance(procedure.goals[index - 1], Wrap) else ""
                expected = f"an angle for which {1e3 * planner.thread_length:.3g} mm of thread are enough{before}"
                raise ConfigurationError(f"{where}.angle", goal.angle, expected)
        elif isinstance(goal, Tighten):
            if goal.around:
                _check_name(planner, f"{where}.around", goal.around)
            if goal.tension > limits.tension:
                expected = f"at most the limit of the tension, {limits.tension:.3g} N"
                raise ConfigurationError(f"{where}.tension", goal.tension, expected)
            _check_place(planner, f"{where}.toward", goal.toward, required)
        elif isinstance(goal, GoTo):
            _check_place(planner, f"{where}.position", goal.position, required)
            if goal.heading:
                _check_place(planner, f"{where}.position", goal.position, required, goal.heading[0])
        elif isinstance(goal, Withdraw) and goal.to:
            _check_place(planner, f"{where}.to", goal.to, required)


def _check_gap(planner: NeedlePlanner, where: str, goal: PassThrough, required: float) -> None:
    for name in goal.between:
        _check_name(planner, f"{where}.between", name)
    between = planner.gaps_between(*goal.between)
    if not between:
        expected = "two shapes with a gap between them, in which no other shape lies"
        raise ConfigurationError(f"{where}.between", list(goal.between), expected)
    gaps = planner.gaps(goal)
    if not gaps:
        x, y = np.round(min(between, key=lambda gap: gap.width).along, 2) + 0.0
        expected = f"one along a gap between them, as [{x:g}, {y:g}] or [{0.0 - x:g}, {0.0 - y:g}]"
        raise ConfigurationError(f"{where}.direction", list(goal.direction), expected)
    width = max(gap.width for gap in gaps)
    if width <= 2.0 * required:
        expected = f"a gap wider than {2e3 * required:.3g} mm, twice the needle's clearance"
        raise ConfigurationError(f"{where}.between", f"a gap of {1e3 * width:.3g} mm", expected)


def _check_name(planner: NeedlePlanner, where: str, name: str) -> None:
    names = planner.scene.names
    if name not in names:
        raise ConfigurationError(where, name, f"a shape of the scene: {', '.join(names) or 'it has none'}")


def _check_place(
    planner: NeedlePlanner, where: str, place: tuple[float, ...], required: float, heading: float | None = None
) -> None:
    (x, y), directions, words = place, DIRECTIONS, "in some direction"
    if heading is not None:
        directions, words = DIRECTIONS[np.abs(turn_of(DIRECTIONS - heading)) <= HEADING_TOLERANCE], "at its heading"
    if not any(body_clearance(x, y, angle, planner.body, planner.near) >= required for angle in directions):
        expected = f"a place with {1e3 * required:.3g} mm around the needle {words}"
        raise ConfigurationError(where, [x, y], expected)
