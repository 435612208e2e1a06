"""From goals to paths: what a goal asks of the needle's pose, and the way there through the scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from magnetosuture_thread.coils.needle_motion import NeedleKinematics
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.forecast.forecaster import make_forecaster
from magnetosuture_thread.geometry.needle_arc import needle_points
from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.geometry.scene import WALL_NAME, Scene
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
    BringEnd,
    Goal,
    GoTo,
    KeepSide,
    Lay,
    PassThrough,
    Procedure,
    ProcedureLimits,
    TakeOff,
    ThreadGoal,
    Tighten,
    Unwind,
    Wait,
    Wind,
    WindingGoal,
    Withdraw,
    Wrap,
)
from magnetosuture_thread.planning.thread_ways import Candidate, ThreadRollout, candidates
from magnetosuture_thread.planning.tracking import PathTracker
from magnetosuture_thread.planning.verdict import (
    PASSED,
    GoalJudge,
    centre_of,
    gap_lines,
    left_to_wind,
    lines_of_pass,
    solid_of,
    winding,
)
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError, MagnetosutureError

Vector = NDArray[np.float64]

MARGINS = (3e-4, 1e-4, 3e-5, 5e-6)  # m; beyond the required clearance, for errors of control: the widest with a way
WRAP_LEAD = 0.1  # rad; that the needle goes on after a wrap, as the thread follows it
WELL_MET = 0.7  # of what a goal of the thread tolerates: enough, for errors of forecast and estimate
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
class _Asked:
    """A goal of the thread, and from where it is to be reached: pose of the chord, thread, and state of the lattice."""

    procedure: Procedure
    index: int
    pose: Vector
    thread: Points
    required: float
    margin: float
    state: NDArray[np.int64]

    @property
    def goal(self) -> ThreadGoal:
        goal = self.procedure.goals[self.index]
        assert isinstance(goal, ThreadGoal)
        return goal


@dataclass(frozen=True, eq=False)
class _Trial:
    """A candidate, its path up to where the thread comes nearest to the goal, by how much it misses, and the thread."""

    candidate: Candidate
    whole: BodyPath
    path: BodyPath
    miss: float
    thread: Points


class NeedlePlanner:
    """Plans paths of the needle's body through a scene.

    Args:
        scene: dish and shapes.
        needle: its kinematics.
        keep_out: least distance of the needle's axis from wall and shapes [m].
        thread_length: of the thread behind it [m].
        axes: of the coils, for `PathTracker`.
        model: settings of the thread model, for forecasts; None for those of the thread model's defaults.
        delay: for `PathTracker` [s].

    Attributes:
        looked: states of the lattice that were looked at so far, with what forecasts took as long as.

    Raises:
        ConfigurationError: the needle has no room in the dish.
    """

    def __init__(
        self,
        scene: Scene,
        needle: NeedleKinematics,
        keep_out: float,
        thread_length: float,
        axes: Sequence[tuple[float, float]] = (),
        model: ThreadModelSettings | None = None,
        delay: float = 0.0,
    ) -> None:
        least = needle.chord + 2.0 * keep_out
        if scene.dish.diameter <= least:
            expected = f"more than {least:g} m, room for the needle and the clearance on both sides"
            raise ConfigurationError("scene.dish.diameter", scene.dish.diameter, expected)
        self.scene, self.needle, self.axes, self.delay = scene, needle, tuple(axes), delay
        self.keep_out, self.thread_length = keep_out, thread_length
        self._model = ThreadModelSettings() if model is None else model
        self.near = map_clearance(scene)
        self.lever = 0.5 * needle.chord
        # Points a step of the grid apart, about the middle of the chord.
        axis = needle_points(needle.length, needle.curvature, self.near.step)[0]
        along = needle.chord_direction(np.array([1.0, 0.0]))
        turn = np.array([[along[0], along[1]], [-along[1], along[0]]])
        self.body = np.ascontiguousarray((axis - self.lever * along) @ turn.T)
        self._step = STRIDE * self.near.step
        self._size = CELLS // STRIDE + 1
        self.looked = 0
        self._ways: dict[tuple[object, ...], Points] = {}  # found, by what was searched

    def pose(self, tail: Vector, heading: Vector) -> tuple[Vector, float]:
        """Return middle, shape (2,) [m], and angle of the chord [rad] of a needle with this tail and heading."""
        along = self.needle.chord_direction(heading)
        return tail + self.lever * along, math.atan2(float(along[1]), float(along[0]))

    def tracker(self, path: BodyPath) -> PathTracker:
        """Return what tracks a path with these coils."""
        return PathTracker(path, self.axes, self.delay)

    def check(self, procedure: Procedure, first: int = 0) -> None:
        """Refuse what can be seen to be impossible without planning.

        Args:
            procedure: its goals.
            first: index of the goal from which on they are still to be reached.

        Raises:
            ConfigurationError: a name is not of the scene, a place is not free, a gap is blocked, too narrow or not
                there, the thread is too short for all wraps, a wrap undoes one before, there is nothing to tighten, or
                a tension is over the goal's own limit.
        """
        _check_procedure(procedure, self, first)

    def plan(
        self,
        procedure: Procedure,
        first: int,
        middle: Vector,
        angle: float,
        start: Vector,
        thread: Points | None = None,
        crossed: int = 0,
        aim: Vector | None = None,
        before: BodyPath | None = None,
    ) -> BodyPath:
        """Return a path from a pose through the goals of a `chain`.

        Args:
            procedure: whose goals they are.
            first: index of the first of them.
            middle: of the chord, shape (2,) [m]; see `pose`.
            angle: of the chord [rad].
            start: where the procedure began, shape (2,) [m].
            thread: the tail first, shape (n + 1, 2) [m]; one that winds about nothing if None.
            crossed: how often the needle has passed the gap of the first goal since that began.
            aim: from the place of the first goal to where the path is to end, shape (2,) [m].
            before: what is left of a path to a goal of the thread, from which a better one is looked for first.

        Raises:
            PlanningError: there is no way to one of them.
        """
        goals, limits = chain(procedure, first), procedure.limits[first]
        if isinstance(goal := goals[0], GoTo | Withdraw) and aim is not None:  # the last of its chain
            x, y = (place_of(goal, start) + aim).tolist()
            goals = (replace(goal, position=(x, y)) if isinstance(goal, GoTo) else replace(goal, to=(x, y)),)
        required = max(self.keep_out, limits.clearance)
        if isinstance(goal, Wait):
            return self.standing_path(middle, angle, limits)
        if isinstance(goal, ThreadGoal):
            lies = np.empty((0, 2)) if thread is None else thread
            return self._plan_thread(procedure, first, np.array([*middle, angle]), lies, required, before)
        for margin in MARGINS:
            states, ends, at = np.empty((0, 3)), [], self._nearest_free(middle, angle, required + margin)
            lies = np.empty((0, 2)) if thread is None else thread
            for index, goal in enumerate(goals, first):
                if at is None:
                    break
                found = self._way(
                    procedure, index, goal, start, at, lies, crossed if index == first else 0, required + margin
                )
                if not len(found):
                    at = None
                    break
                states = np.vstack([states, found])
                ends.append(len(states))
                lies = self.led(lies, found, limits.speed)
                at = self._state_of(found[-1])
            if at is not None and (last := self._end_of(goals[-1], start, states[-1], required + margin)) is not None:
                states = np.vstack([states, last])
                ends[-1] += 1
            if at is not None and len(states):
                # It begins where the needle is, which may be closer than what is required from then on.
                begin = np.array([[*middle, states[0, 2] + math.remainder(angle - states[0, 2], 2.0 * math.pi)]])
                states = np.vstack([begin, states])
                return smooth_path(states, np.array(ends), self.lever, self.body, required, margin, self.near)
        last = states[-1, :2] if len(states) else middle
        raise PlanningError(_no_way(goals[len(ends)], last, required), len(ends))

    @cached_property
    def rollout(self) -> ThreadRollout:
        """What forecasts the thread along a path; it raises a `PlanningError` where the thread model does not fit."""
        try:
            return ThreadRollout(make_forecaster(self._model, self.scene, step=0.1), self.needle)  # s
        except ConfigurationError as error:
            raise PlanningError(f"no forecast of the thread: {error}") from None

    def leads_to(self, procedure: Procedure, index: int, path: BodyPath, thread: Points) -> bool:
        """Return whether a goal of the thread is met, by a forecast, at the end of a path."""
        trial = self._foresee(Candidate(), path, procedure, index, thread)
        return trial is not None and trial.miss <= 1.0

    def _plan_thread(
        self,
        procedure: Procedure,
        index: int,
        pose: Vector,
        thread: Points,
        required: float,
        before: BodyPath | None,
    ) -> BodyPath:
        """Return the path from a pose of the chord by which the thread comes to lie as a goal asks; see `plan`.

        Every candidate is forecast along its corners. The four that miss by the least are improved, and rounded. Of
        those that meet the goal well the shortest is chosen.
        """
        trials: list[_Trial] = []
        began = self.looked
        for margin in MARGINS:
            state = self._nearest_free(pose[:2], float(pose[2]), required + margin)
            if state is None:
                continue
            asked = _Asked(procedure, index, pose, thread, required, margin, state)
            known = None if before is None else self._try(Candidate(path=before.poses), asked)
            if known is not None and (trial := self._rounded(self._improved(known, asked), asked)).miss <= 1.0:
                return trial.path
            reach = self.scene.dish.radius - required - margin - self.lever
            found = filter(None, [self._try(candidate, asked) for candidate in candidates(asked.goal, reach)])
            for trial in sorted(found, key=lambda trial: max(trial.miss, WELL_MET))[:4]:
                trials.append(self._rounded(self._improved(trial, asked), asked))
                if trials[-1].miss <= WELL_MET or self.looked - began > 10_000_000:  # about 20 s
                    break
            if trials:
                break
        no_way = _no_way(procedure.goals[index], pose[:2], required)
        if not trials:
            raise PlanningError(no_way)
        best = min(trials, key=lambda trial: (max(trial.miss, WELL_MET), trial.path.length))
        if best.miss > 1.0:
            judge = GoalJudge(procedure, self.scene)
            judge.update(best.path.middles[-1], best.thread)
            raise PlanningError(f"{no_way}; at best, {judge.missing(index)}")
        return best.path

    def _improved(self, trial: _Trial, asked: _Asked) -> _Trial:
        """Return the best of a candidate, what corrects it by its error, and of variations of the best so far.

        Source: the (1 + 1) evolution strategy with the rule of successes, Rechenberg 1973.
        """
        rng, scale, is_new = np.random.default_rng(0), 1.0, True
        for _ in range(32):
            if trial.miss <= WELL_MET:
                break
            left = self._left_to_wind(asked.procedure, asked.index, trial.thread)
            moved = trial.candidate.corrected(asked.goal, trial.thread, left) if is_new else None
            latest = self._try(trial.candidate.varied(rng, scale) if moved is None else moved, asked)
            is_new = latest is not None and latest.miss < trial.miss
            trial = latest if latest is not None and is_new else trial
            scale *= 1.5 if is_new else 0.9
        return trial

    def _try(self, candidate: Candidate, asked: _Asked) -> _Trial | None:
        """Return what a forecast makes of a candidate; None where there is no way for it."""
        states = self._states_of(candidate, asked)
        if states is None:
            return None
        path = BodyPath.through(np.vstack([asked.pose, states]), self.lever)
        return self._foresee(candidate, path, asked.procedure, asked.index, asked.thread)

    def _rounded(self, trial: _Trial, asked: _Asked) -> _Trial:
        """Return what the forecast makes of a path whose corners are rounded; as it was where that cannot be."""
        at = asked.required, asked.margin, self.near
        path = smooth_path(trial.whole.poses, np.array([len(trial.whole.angles) - 1]), self.lever, self.body, *at)
        self.looked += 60 * len(path.angles)  # which takes as long
        return self._foresee(trial.candidate, path, asked.procedure, asked.index, asked.thread) or trial

    def _foresee(
        self, candidate: Candidate, path: BodyPath, procedure: Procedure, index: int, thread: Points
    ) -> _Trial | None:
        """Return what the forecast along a path makes of it; None where needle or thread lie where they cannot."""
        goal, judge, before = procedure.goals[index], GoalJudge(procedure, self.scene), self.rollout.steps
        judge.begin(index)
        best, reach, nearest = math.inf, 0.0, np.empty((0, 2))
        try:
            for way, lies in self.rollout.threads(path, procedure.limits[index].speed, thread):
                judge.update(pose := path.at(way)[0], lies)
                is_there = not isinstance(goal, KeepSide) or math.dist(pose, goal.to) <= PLACE_SHARE * goal.tolerance
                if is_there and judge.miss < best:
                    best, reach, nearest = judge.miss, way, lies
                if best <= WELL_MET:
                    break
        except InvalidInputError:
            return None
        # A step of a forecast, and what is compared with the goal, take as long as 40 states of the lattice.
        self.looked += 40 * (self.rollout.steps - before)
        return _Trial(candidate, path, path.part(0.0, reach), best, nearest) if best < math.inf else None

    def _states_of(self, candidate: Candidate, asked: _Asked) -> Points | None:
        """Return the states on the way of a candidate, shape (k, 3); None where there is none."""
        kept = asked.required + asked.margin
        if len(candidate.path):
            free = [body_clearance(x, y, angle, self.body, self.near) >= kept for x, y, angle in candidate.path[1:]]
            return candidate.path if all(free) else None
        parts = [self._pose_of(asked.state)[None]]
        if not math.isnan(candidate.more):
            at = asked.pose[:2], asked.state, asked.thread, 0, kept, candidate.more
            found = self._way(asked.procedure, asked.index, asked.goal, *at)
            if not len(found):
                return None
            parts.append(found)
        # Straight on before and beyond a line, as a thread lies straight that is pulled straight.
        beyond = 0.0 if len(candidate.onward) else self.thread_length
        for place in candidate.places(self.lever, self.thread_length, beyond):
            way = self._to_place(place, parts[-1][-1], kept)
            parts += [way] if way is not None else []  # where the needle has no room it goes past
        return np.vstack(parts)

    def _to_place(self, place: Vector, state: Vector, kept: float) -> Points | None:
        """Return the states on the way to a place, straight if that is free; None where there is none."""
        x, y = place.tolist()
        if not any(body_clearance(x, y, angle, self.body, self.near) >= kept for angle in DIRECTIONS):
            return None
        direction = math.atan2(y - state[1], x - state[0])
        turns = np.linspace(state[2], state[2] + math.remainder(direction - state[2], 2.0 * math.pi), 32)
        way = np.linspace(state[:2], place, max(2, math.ceil(math.dist(state[:2], place) / self.near.step)))
        middles, angles = np.vstack([np.tile(state[:2], (32, 1)), way]), np.append(turns, np.full(len(way), turns[-1]))
        straight = np.column_stack([middles, angles])
        if all(body_clearance(u, v, angle, self.body, self.near) >= kept for u, v, angle in straight):
            return straight
        goal = self._place_goal(GoTo(position=(x, y)), place, np.empty((0, 4)))
        found = self._search(goal, kept, self._state_of(state))
        return found if len(found) else None

    def led(self, thread: Points, poses: Points, speed: float) -> Points:
        """Return where a thread lies after the needle has led it, by a forecast.

        Where that cannot be, as of a thread that is not known, it lies where the tail has been, and then as before.

        Args:
            thread: before, the tail first, shape (n, 2) [m].
            poses: x, y [m] and angle [rad] of the needle's chord on the way, shape (k, 3).
            speed: of the tip [m/s].
        """
        if len(thread):
            with suppress(InvalidInputError, PlanningError):
                before = self.rollout.steps
                *_, (_, lies) = self.rollout.threads(BodyPath.through(poses, self.lever), speed, thread)
                self.looked += 40 * (self.rollout.steps - before)
                return lies
        tails = poses[:, :2] - self.lever * np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
        line = np.vstack([tails[::-1], thread])
        return line[: int(np.searchsorted(arc_lengths(line), self.thread_length)) + 1]

    def standing_path(self, middle: Vector, angle: float, limits: ProcedureLimits) -> BodyPath:
        """Return a path of one pose, in which the needle stays, with the leeway that it has there."""
        near = body_clearance(float(middle[0]), float(middle[1]), angle, self.body, self.near)
        leeway = max(0.0, near - max(self.keep_out, limits.clearance))
        twice = np.tile(middle, (2, 1)), np.full(2, angle)
        return BodyPath(*twice, self.lever, np.full(2, leeway), np.zeros(1))

    def plan_all(
        self, procedure: Procedure, middle: Vector, angle: float, thread: Points | None = None
    ) -> tuple[BodyPath, ...]:
        """Return the paths that a procedure will take, each through the goals of one `chain`.

        Args:
            procedure: whose goals they are.
            middle: of the needle's chord now, shape (2,) [m]; see `pose`.
            angle: of the chord [rad].
            thread: the tail first, shape (n + 1, 2) [m]; one that winds about nothing if None.

        Raises:
            ConfigurationError: see `check`.
            PlanningError: there is no way to a goal.
        """
        self.check(procedure)
        start = middle
        paths: list[BodyPath] = []
        for index, _ in chains(procedure):
            try:
                path = self.plan(procedure, index, middle, angle, start, thread)
            except PlanningError as error:
                raise PlanningError(f"goals[{index + error.goal}]: {error}", index + error.goal) from None
            lies = np.empty((0, 2)) if thread is None else thread
            thread = self.led(lies, path.poses, procedure.limits[index].speed)
            middle, angle = path.middles[-1], float(path.angles[-1])
            paths.append(path)
        return tuple(paths)

    def begins(self, path: BodyPath, middle: Vector, angle: float) -> bool:
        """Return whether a path begins at a pose of the chord, within a step of the lattice of the needle's tip."""
        turn = math.remainder(angle - float(path.angles[0]), 2.0 * math.pi)
        return math.dist(middle, path.middles[0]) + self.lever * abs(turn) <= self._step

    def beside(self, middle: Vector, angle: float) -> str:
        """Return in words what a needle in a pose is as close to as it may be; empty for nothing."""
        c, s = math.cos(angle), math.sin(angle)
        axis = shapely.LineString(self.body @ np.array([[c, s], [-s, c]]) + middle)
        away = {name: axis.distance(solid_of(self.scene, name)) for name in (WALL_NAME, *self.scene.names)}
        name = min(away, key=lambda name: away[name])
        return f" beside {name}" if away[name] <= self.keep_out + self.near.step else ""

    def thread_clearance(self, name: str, thread: Points) -> float:
        """Return the greatest distance from a shape of the part of a thread that sweeps the most about it [m]."""
        centre = centre_of(self.scene, name)
        turns = np.unwrap(np.arctan2(*(thread - centre).T[::-1]))
        sense = math.copysign(1.0, turns[-1] - turns[0])
        # The part between the least and the greatest angle.
        first, last = sorted((int(np.argmin(sense * turns)), int(np.argmax(sense * turns))))
        from_shape = map_clearance(self.scene, (name,))
        return max(clearance_at(x, y, from_shape) for x, y in thread[first : last + 1].tolist())

    def _search(self, goal: LatticeGoal, kept: float, start: NDArray[np.int64]) -> Points:
        """Return x, y and direction of the states on the way to a goal, shape (k, 3); empty where there is none."""
        # A procedure is planned as a whole, and then goal by goal from the same points of the lattice.
        key = (start.tobytes(), kept, *(np.asarray(part).tobytes() for part in goal))
        if (found := self._ways.get(key)) is None:
            # 32 ways are kept.
            if len(self._ways) >= 32:
                self._ways.clear()
            found, looked = search_lattice(start, self.body, self.lever, kept, kept + PREFERRED, goal, self.near)
            self._ways[key] = found
            self.looked += looked
        return found  # kept or not: another thread may have cleared what is kept

    def _state_of(self, state: Vector) -> NDArray[np.int64]:
        """Return column, row and direction of a state of the lattice."""
        column, row = np.rint((np.asarray(state[:2]) - self.near.origin) / self._step).astype(int)
        return np.array([column, row, int(np.argmin(np.abs(turn_of(DIRECTIONS - state[2]))))])

    def _pose_of(self, state: NDArray[np.int64]) -> Vector:
        """Return x, y and direction of a state of the lattice, shape (3,)."""
        return np.array([*(self.near.origin + self._step * state[:2]), DIRECTIONS[state[2]]])

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

    def _way(
        self,
        procedure: Procedure,
        index: int,
        goal: Goal,
        start: Vector,
        state: NDArray[np.int64],
        thread: Points,
        crossed: int,
        kept: float,
        more: float = 0.0,
    ) -> Points:
        """Return x, y and direction of the states on the way to a goal, shape (k, 3); empty where there is none.

        A thread that is led around a shape loses what its free end wound about it before: the angle that a wrap sweeps
        is corrected by that of the thread as it will lie.
        """
        before, speed = np.empty((0, 3)), procedure.limits[index].speed
        target = self._lattice_goal(procedure, index, goal, start, state, thread, crossed, more)
        if not target.allowed[state[1], state[0]]:  # first to where the shape of a wrap is in view
            there = target._replace(places=target.allowed, allowed=target.places, cuts=np.empty((0, 4)), crossings=0)
            before = self._search(there, kept, state)
            if not len(before):
                return before
            state, thread = self._state_of(before[-1]), self.led(thread, before, speed)
        found = before
        for _ in range(3):
            target = self._lattice_goal(procedure, index, goal, start, state, thread, crossed, more)
            found = self._search(target, kept, state)
            if not isinstance(goal, Wrap) or not len(found):
                break
            short = self._left_to_wind(procedure, index, self.led(thread, found, speed))
            if abs(short) <= 0.5 * WRAP_LEAD:
                break
            more += short
        return np.vstack([before, found]) if len(found) else found

    def _left_to_wind(self, procedure: Procedure, index: int, thread: Points) -> float:
        """Return by how much the winding of a goal has to change, to be well within its limits [rad]."""
        goal, (least, greatest) = procedure.goals[index], procedure.windings[index]
        if not isinstance(goal, WindingGoal):
            return 0.0
        clear = WRAP_LEAD if isinstance(goal, Wrap) else 0.5 * WELL_MET * (greatest - least)
        return left_to_wind((least + clear, greatest - clear), winding(thread, centre_of(self.scene, goal.around)))

    def _lattice_goal(
        self,
        procedure: Procedure,
        index: int,
        goal: Goal,
        start: Vector,
        state: NDArray[np.int64],
        thread: Points,
        crossed: int,
        more: float,
    ) -> LatticeGoal:
        """Return what a goal asks of the lattice.

        See `plan`; the way to it begins at `state`, and is to wind `more` than what is left of it [rad].
        """
        everywhere, any_heading = np.ones((self._size, self._size), bool), np.ones(len(DIRECTIONS), bool)
        middle = np.asarray(self.near.origin + self._step * state[:2])
        kept = self._done(procedure, index, middle, thread)
        anything = LatticeGoal(everywhere, everywhere, any_heading, kept[:0], 0, 0.0, kept, np.full(2, np.nan))
        if isinstance(goal, WindingGoal):
            # The tail, which leads the thread, crosses a line from the shape to beyond the wall, where the wrap ends.
            direction = DIRECTIONS[state[2]]
            tail = middle - self.lever * np.array([math.cos(direction), math.sin(direction)])
            if isinstance(goal, KeepSide):
                wound = winding(thread, centre_of(self.scene, goal.around)) - more
                return self._past(goal, procedure.windings[index], tail, wound, kept)
            left = self._left_to_wind(procedure, index, thread) + more
            sense, left = math.copysign(1.0, left), abs(left)
            if left <= WRAP_LEAD:
                return anything
            cuts = self._ray(goal.around, tail, sense, left).reshape(1, 4)
            turns = math.ceil(left / (2.0 * math.pi))
            allowed = self._in_view_of(goal.around)
            return anything._replace(allowed=allowed, cuts=cuts, crossings=turns, lag=self.lever)
        at = self.near.origin + self._step * np.arange(self._size)
        x, y = np.meshgrid(at, at)
        if isinstance(goal, PassThrough):
            if crossed >= 1:
                return anything
            lines = lines_of_pass(self.scene, goal)
            places, headings = np.zeros_like(everywhere), np.zeros(len(DIRECTIONS), bool)
            for first, second in lines:
                (across_x, across_y), width = (second - first) / math.dist(first, second), math.dist(first, second)
                dx, dy = x - 0.5 * (first[0] + second[0]), y - 0.5 * (first[1] + second[1])
                ahead, aside = dy * across_x - dx * across_y, dx * across_x + dy * across_y
                # Beyond the line by a step, so that nobody doubts the pass.
                places |= (ahead >= self._step + PASSED) & (ahead <= 4.0 * self._step) & (np.abs(aside) <= 0.5 * width)
                # The needle may be 0.8 rad off the direction of a gap while it passes.
                headings |= np.abs(turn_of(DIRECTIONS - math.atan2(across_x, -across_y))) <= 0.8
            cuts = np.reshape(lines, (-1, 4))
            return anything._replace(places=places, headings=headings, cuts=cuts, crossings=1 - crossed)
        assert isinstance(goal, GoTo | Tighten | Withdraw)
        return self._place_goal(goal, place_of(goal, start), kept)

    def _place_goal(self, goal: GoTo | Tighten | Withdraw | KeepSide, place: Vector, kept: Points) -> LatticeGoal:
        """Return what a place asks of the lattice, and a heading there, if the goal has one."""
        tolerance = self._step if isinstance(goal, Tighten) else goal.tolerance
        at = self.near.origin + self._step * np.arange(self._size)
        away, headings = np.hypot(at[None, :] - place[0], at[:, None] - place[1]), np.ones(len(DIRECTIONS), bool)
        # At least the nearest point of the lattice.
        places = away <= max(PLACE_SHARE * tolerance, PLACE_STEPS * self._step)
        if isinstance(goal, GoTo) and goal.heading:
            headings = np.abs(turn_of(DIRECTIONS - goal.heading[0])) <= HEADING_TOLERANCE
        return LatticeGoal(np.ones_like(places), places, headings, kept[:0], 0, 0.0, kept, place)

    def _past(
        self, goal: KeepSide, allowed: tuple[float, float], tail: Vector, wound: float, kept: Points
    ) -> LatticeGoal:
        """Return what a place asks of the lattice to which the tail is led past a shape, on one side of it.

        Args:
            goal: with the place.
            allowed: interval of the winding about the shape then [rad].
            tail: of the needle now, shape (2,) [m].
            wound: winding now [rad].
            kept: see `LatticeGoal`.
        """
        centre, place = centre_of(self.scene, goal.around), np.array(goal.to)
        before, after = (math.atan2(*(point - centre)[::-1]) for point in (tail, place))
        direct = math.remainder(after - before, 2.0 * math.pi)
        turns = round((0.5 * sum(allowed) - wound - direct) / (2.0 * math.pi))
        sweep = direct + 2.0 * math.pi * turns
        # The line that is crossed is halfway, and opposite of a sweep that is too small to cross any.
        whole, rest = divmod(abs(sweep), 2.0 * math.pi)
        sense, count = math.copysign(1.0, sweep), int(whole) + (rest > 0.2)
        ray = self._ray(goal.around, tail, sense, 0.5 * rest if rest > 0.2 else math.pi)
        return self._place_goal(goal, place, kept)._replace(cuts=ray.reshape(1, 4), crossings=count, lag=self.lever)

    def _ray(self, name: str, point: Vector, sense: float, angle: float) -> Points:
        """Return the line from a shape to beyond the wall that a point crosses after it has swept an angle about it.

        Args:
            name: of the shape.
            point: shape (2,) [m].
            sense: of the angle: 1 counterclockwise, -1 clockwise. The line is crossed in this sense from right to left.
            angle: [rad].
        """
        centre = centre_of(self.scene, name)
        end = math.atan2(*(point - centre)[::-1]) + sense * angle
        line = np.array([centre, centre + 2.0 * self.scene.dish.diameter * np.array([math.cos(end), math.sin(end)])])
        return line if sense > 0.0 else line[::-1]

    def _done(self, procedure: Procedure, index: int, middle: Vector, thread: Points) -> Points:
        """Return the lines by whose crossing back a goal would undo what was done before, shape (k, 4) [m].

        They are across the gaps that were passed, but on the way out, and where the thread would wind half a turn less
        about a shape than it is to.
        """
        goals, goal = procedure.goals[:index], procedure.goals[index]
        passed = {frozenset(done.between): done for done in goals if isinstance(done, PassThrough)}
        if isinstance(goal, PassThrough):
            passed.pop(frozenset(goal.between), None)
        lines = [line for done in passed.values() for line in lines_of_pass(self.scene, done)]
        lines = [] if isinstance(goal, Withdraw) else lines
        for name, k in procedure.lasting(index).items():
            least, greatest = procedure.windings[k]
            if least < 0.0 < greatest or isinstance(procedure.goals[k], KeepSide):
                continue
            sense = 1.0 if least > 0.0 else -1.0
            room = sense * winding(thread, centre_of(self.scene, name)) - min(abs(least), abs(greatest)) + math.pi
            if room > 0.0 and not (isinstance(goal, WindingGoal) and goal.around == name):
                lines.append(self._ray(name, middle, sense, -min(room, 1.5 * math.pi)))
        return np.reshape(np.array(lines, np.float64), (-1, 4))

    def length_around(self, windings: Mapping[str, float]) -> float:
        """Return the length of thread that winds about shapes and leads from each to the next, at the least [m].

            max(max_k L_k(|w_k|), sum_k L_k(|w_k| - pi) + sum_k d(k, k + 1))
            L(w) = girth floor(w / 2 pi) + r (w mod 2 pi)    for w > 0, else 0

        with the distance d between shapes, and r of a shape's hull from its centroid. A thread that is straight winds
        by up to pi, past a shape that other parts of it are wrapped around.

        Args:
            windings: about each shape, in the order of the wraps [rad].
        """
        solids = [solid_of(self.scene, name) for name in windings]

        def around(solid: shapely.Geometry, angle: float) -> float:
            hull = solid.convex_hull
            turns, rest = divmod(max(0.0, angle), 2.0 * math.pi)
            return float(hull.length * turns + hull.exterior.distance(solid.centroid) * rest)

        pairs = list(zip(solids, map(abs, windings.values()), strict=True))
        alone = max((around(solid, angle) for solid, angle in pairs), default=0.0)
        together = sum(around(solid, angle - math.pi) for solid, angle in pairs)
        return max(alone, together + sum(float(first.distance(second)) for first, second in pairwise(solids)))

    def _end_of(self, goal: Goal, start: Vector, state: Vector, kept: float) -> Vector | None:
        """Return the pose that a goal asks for, near a state of the lattice; None for none, or if it is not free."""
        if not isinstance(goal, GoTo | Withdraw) or PLACE_SHARE * goal.tolerance >= PLACE_STEPS * self._step:
            return None  # a state of the lattice is near enough
        x, y = place_of(goal, start).tolist()
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
        # Not from inside of a ring, around which nothing can be led there.
        filled = shapely.polygons(shapely.get_exterior_ring(solid_of(self.scene, name)))
        shapely.prepare(filled)
        x, y = (self.near.origin + self._step * index for index in (columns, rows))
        return np.asarray(free & ~shapely.contains_xy(filled, x, y))


def _no_way(goal: Goal, middle: Vector, required: float) -> str:
    x, y = 1e3 * middle
    return f"no way for the needle to {goal.GROUP} from {x:.1f}, {y:.1f} mm, with {1e3 * required:.3g} mm around it"


def place_of(goal: GoTo | Tighten | Withdraw | KeepSide, start: Vector) -> Vector:
    """Return the place that a goal brings the needle's middle to, shape (2,) [m].

    Args:
        goal: what is to be reached.
        start: where the procedure began, shape (2,) [m].
    """
    place = goal.position if isinstance(goal, GoTo) else goal.toward if isinstance(goal, Tighten) else goal.to
    return np.array(place) if place else start


def chain(procedure: Procedure, index: int) -> tuple[Goal, ...]:
    """Return the goals from one on that are reached on one path: up to the next at which the needle comes to rest."""
    limits = procedure.limits[index]
    last = index
    while last + 1 < len(procedure.goals) and procedure.limits[last + 1] == limits:
        # Where a tightened thread ends depends on the thread, and so does what follows.
        if not isinstance(procedure.goals[last], PassThrough | Wrap):
            break
        if isinstance(procedure.goals[last + 1], ThreadGoal | Wait):
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
    waits = sum(goal.time for goal in procedure.goals if isinstance(goal, Wait))
    return waits + sum(
        path.length / procedure.limits[index].speed for (index, _), path in zip(chains(procedure), paths, strict=True)
    )


def _check_procedure(procedure: Procedure, planner: NeedlePlanner, first: int) -> None:
    wrapped: dict[str, float] = {}  # what the thread winds about each shape, the last one last [rad]
    for index, (goal, limits) in enumerate(zip(procedure.goals, procedure.limits, strict=True)):
        where, required = f"goals[{index}].{goal.GROUP}", max(planner.keep_out, limits.clearance)
        if isinstance(goal, WindingGoal):
            _check_name(planner, f"{where}.around", goal.around)
            before = wrapped.pop(goal.around, 0.0)
            if isinstance(goal, Wrap) and before * goal.swept < 0.0:
                sense = "clockwise" if goal.swept > 0.0 else "counterclockwise"
                raise ConfigurationError(f"{where}.sense", goal.sense, f"{sense}, as {goal.around} is wrapped before")
        if isinstance(goal, Wrap | Wind):
            least = abs(before + goal.swept) if isinstance(goal, Wrap) else max(0.0, goal.angle - goal.tolerance)
            wrapped[goal.around] = math.copysign(least, goal.swept)
            needed, length = planner.length_around(wrapped), planner.thread_length
            if needed > length:
                is_alone = len(wrapped) == 1 and (isinstance(goal, Wind) or wrapped[goal.around] == goal.swept)
                whole = "" if is_alone else " with the wraps before"
                expected = f"an angle for which {1e3 * length:.3g} mm of thread are enough{goal.in_radians}"
                raise ConfigurationError(
                    f"{where}.angle", f"{goal.angle:g} rad, {1e3 * needed:.3g} mm of thread{whole}", expected
                )
        elif isinstance(goal, Tighten):
            _check_tighten(planner, where, goal, limits, required, wrapped)
        elif index < first or isinstance(goal, Unwind | TakeOff | Wait):
            continue
        elif isinstance(goal, Lay):
            _check_line(planner, where, goal)
        elif isinstance(goal, BringEnd):
            _check_free(planner, f"{where}.position", shapely.Point(goal.position), goal.position)
        elif isinstance(goal, PassThrough):
            _check_gap(planner, where, goal, required)
        elif isinstance(goal, GoTo):
            _check_place(planner, f"{where}.position", goal.position, required)
            if goal.heading:
                _check_place(planner, f"{where}.position", goal.position, required, goal.heading[0])
        elif goal.to:
            _check_place(planner, f"{where}.to", goal.to, required)


def _check_tighten(
    planner: NeedlePlanner,
    where: str,
    goal: Tighten,
    limits: ProcedureLimits,
    required: float,
    wrapped: Mapping[str, float],
) -> None:
    if goal.around:
        _check_name(planner, f"{where}.around", goal.around)
    if not wrapped or (goal.around and goal.around not in wrapped):
        around = f" around {goal.around}" if goal.around else ""
        raise ConfigurationError(
            where, "no wrap before it", f"a wrap{around} before, as else there is nothing to tighten"
        )
    if goal.tension > limits.tension:
        expected = f"at most the limit of the tension, {limits.tension:.3g} N"
        raise ConfigurationError(f"{where}.tension", goal.tension, expected)
    _check_place(planner, f"{where}.toward", goal.toward, required)
    around = goal.around or list(wrapped)[-1]
    away = float(solid_of(planner.scene, around).distance(shapely.Point(goal.toward))) - planner.lever
    left = planner.thread_length - planner.length_around(wrapped)
    if away > left:
        expected = f"a place within {1e3 * (left + planner.lever):.3g} mm of {around}, which the thread reaches"
        raise ConfigurationError(f"{where}.toward", list(goal.toward), expected)


def _check_line(planner: NeedlePlanner, where: str, goal: Lay) -> None:
    line = shapely.LineString(np.reshape(goal.along, (-1, 2)))
    _check_free(planner, f"{where}.along", line, goal.along)
    if not goal.stretch and math.dist(goal.along[:2], goal.along[-2:]) <= 2.0 * goal.tolerance:
        expected = "where it begins and ends along the thread, as both ends of the line are close to each other"
        raise ConfigurationError(f"{where}.stretch", [], expected)
    length, own = 1e3 * line.length, 1e3 * planner.thread_length
    if length > own + 2e3 * goal.tolerance or max(goal.stretch, default=0.0) > planner.thread_length:
        expected = f"a line and a stretch within the length of the thread, {own:.3g} mm"
        raise ConfigurationError(f"{where}.along", f"{length:.3g} mm", expected)
    if goal.stretch and abs(length - 1e3 * (goal.stretch[1] - goal.stretch[0])) > 2e3 * goal.tolerance:
        expected = f"one as long as the line, {length:.3g} mm, within twice the tolerance"
        raise ConfigurationError(f"{where}.stretch", list(goal.stretch), expected)


def _check_free(planner: NeedlePlanner, where: str, part: shapely.Geometry, given: tuple[float, ...]) -> None:
    """Refuse where the thread cannot lie."""
    within = [name for name in planner.scene.names if solid_of(planner.scene, name).intersects(part)]
    if np.hypot(*shapely.get_coordinates(part).T).max() >= planner.scene.dish.radius:
        within.append(WALL_NAME)
    if within:
        raise ConfigurationError(where, list(given), f"what is clear of {' and '.join(within)}")


def _check_gap(planner: NeedlePlanner, where: str, goal: PassThrough, required: float) -> None:
    names = planner.scene.names
    for name in goal.between:
        if name != WALL_NAME:
            _check_name(planner, f"{where}.between", name)
    between = gap_lines(planner.scene, goal.between)
    if not between:
        raise ConfigurationError(
            f"{where}.between", list(goal.between), "two shapes with a place where they are nearest"
        )
    lines = lines_of_pass(planner.scene, goal)
    if not lines:
        across = (between[0][1] - between[0][0]) / math.dist(*between[0])
        x, y = np.round([-across[1], across[0]], 2) + 0.0
        expected = f"one along a gap between them, as [{x:g}, {y:g}] or [{0.0 - x:g}, {0.0 - y:g}]"
        raise ConfigurationError(f"{where}.direction", list(goal.direction), expected)
    width = max(math.dist(*line) for line in lines)
    if width <= 2.0 * required:
        expected = f"a gap wider than {2e3 * required:.3g} mm, twice the needle's clearance"
        raise ConfigurationError(f"{where}.between", f"a gap of {1e3 * width:.3g} mm", expected)
    cut, others = shapely.MultiLineString(lines), [name for name in (WALL_NAME, *names) if name not in goal.between]
    away = {name: float(solid_of(planner.scene, name).distance(cut)) for name in others}
    room = max(clearance_at(x, y, planner.near) for line in lines for x, y in _points_of(line, planner.near.step))
    within = [name for name, distance in away.items() if distance < (required if room <= required else 1e-9)]
    if within:
        expected = f"a gap in which {' and '.join(within)} does not lie"
        raise ConfigurationError(f"{where}.between", list(goal.between), expected)


def _points_of(line: Points, spacing: float) -> Points:
    """Return points on a line that are no farther apart than a spacing [m], shape (k, 2)."""
    shares = np.linspace(0.0, 1.0, math.ceil(math.dist(*line) / spacing) + 1)[:, None]
    return np.asarray((1.0 - shares) * line[0] + shares * line[1])


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
