"""Runs a procedure: plans each goal, tracks its path, and notices when the needle is stalled."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.planning.path import BodyPath
from magnetosuture_thread.planning.planner import WELL_MET, NeedlePlanner, PlanningError, place_of
from magnetosuture_thread.planning.procedure import (
    Goal,
    KeepSide,
    PlaceGoal,
    Procedure,
    ThreadGoal,
    Tighten,
    Wait,
    Wrap,
)
from magnetosuture_thread.planning.tracking import PathTracker, RestDetector
from magnetosuture_thread.planning.verdict import GoalJudge, centre_of, left_to_wind, winding
from magnetosuture_thread.settings.errors import MagnetosutureError

Vector = NDArray[np.float64]


BACK_OFF_TIME = 0.8  # s; for which it then drives away from what stops it
MAX_REPLANS, MAX_DETOURS, MAX_MISSES = 6, 20, 6  # of a goal: without progress, without less to go, off its place
OFF_PATH, MAX_OFF_PATH = 8e-4, 3e-3  # m; an error beyond which a new path is planned: more where there is room
PROGRESS = 2e-3  # m; on a new path, or less to go than ever before, after which plans before count no more
MAX_WAIT = 30.0  # s; for a thread that is not known, after which a procedure is given up
TENSION_SHARE = 0.9  # of the limit, which the speed is regulated to
UNLIMITED = 10_000  # nodes under friction: a limit that is none


class ProcedureState(Enum):
    """What a procedure does now."""

    READY = "ready"
    RUNNING = "running"
    PAUSED = "paused"
    DONE = "done"
    FAILED = "failed"


ENDED = (ProcedureState.DONE, ProcedureState.FAILED)


@dataclass(frozen=True)
class ThreadCondition:
    """What is known of the thread, for the limits of a procedure and for goals about it.

    Attributes:
        vertices: of the estimated thread, the tail first, shape (n + 1, 2) [m]; None if unknown.
        tension: its peak by the model [N]; 0 if unknown.
        friction_nodes: how many nodes are under friction.
        slowdown: factor on the needle's speed by the thread's friction, which the bridge applies.
        problem: why it is not known well enough to go on; empty if it is.
        pull: velocity that the thread's pull gives the needle, which the bridge measures and compensates, shape (2,)
            [m/s]; 0 if unknown.
        may_hold: whether the needle may be kept in place by commands while there is a problem; else it is left alone.
        age: of the needle's pose when a command is sent [s]; 0 if unknown.
    """

    vertices: Points | None = None
    tension: float = 0.0
    friction_nodes: int = 0
    slowdown: float = 1.0
    problem: str = ""
    pull: Vector = field(default_factory=lambda: np.zeros(2))
    may_hold: bool = True
    age: float = 0.0


class PendingPath(Protocol):
    """A path that is being planned or forecast, as `concurrent.futures.Future` is one."""

    def done(self) -> bool:
        """Return whether planning has ended."""

    def result(self) -> Any:
        """Return the path, or whether it leads to its goal; or raise what planning raised."""


PathSubmitter = Callable[[Callable[[], Any]], PendingPath]
"""Begins to plan a path, as `concurrent.futures.Executor.submit` does."""


def plan_now(task: Callable[[], Any]) -> PendingPath:
    """Plan a path here and now."""
    pending: Future[Any] = Future()
    try:
        pending.set_result(task())
    except PlanningError as error:
        pending.set_exception(error)
    return pending


@dataclass
class Pursuit:
    """What has come of the present goal.

    Attributes:
        replans: new paths without progress since.
        detours: new paths without less to go than before.
        misses: paths at whose end the goal was not met.
        left: minimum of the way to go so far [m].
        aim: from the goal's place to where its path is to end, shape (2,) [m].
    """

    replans: int = 0
    detours: int = 0
    misses: int = 0
    left: float = math.inf
    aim: Vector = field(default_factory=lambda: np.zeros(2))


class ProcedureExecutor:
    """Takes the needle through the goals of a procedure.

    A goal's path is planned when its turn comes, from where the needle is then; that of the first goal may be there
    before. Meanwhile, and while the thread is not known well enough to go on, the needle is kept where it is: at a zero
    command the coils are off, and the thread pulls it away. A needle that is stalled while it is commanded
    (`RestDetector`) backs off, and its goal is
    planned anew; one that is off its path by more than `OFF_PATH` too. A path that ends off the place of its goal, as a
    turn throws the needle aside, is followed by one that ends as far to the other side. Whether the needle has passed a
    gap, and whether the thread winds about a shape, is judged by both as they are known (`GoalJudge`), not by the path.
    After `MAX_REPLANS`, `MAX_DETOURS` or `MAX_MISSES` the goal is given up, and the needle rests; so is a procedure
    that has waited too long for the thread. A pause for the thread ends by itself once that is known again; one by
    `pause` lasts until `start`.
    Pure: time comes in with the poses.

    Args:
        procedure: what to do.
        planner: of paths in the scene.
        submit: begins to plan a path; by default that is done at once, while the caller waits.
        max_wait: for a thread that is not known; then the procedure is given up [s].

    Attributes:
        state: of the procedure.
        reason: why it is paused or has failed; empty else.
        resumes: whether it goes on by itself once the thread is known again.
        goal: index of the present goal.
        path: that is tracked, or was tracked last; None before the first.
    """

    def __init__(
        self,
        procedure: Procedure,
        planner: NeedlePlanner,
        submit: PathSubmitter = plan_now,
        max_wait: float = MAX_WAIT,
    ) -> None:
        self.procedure, self.planner, self._submit = procedure, planner, submit
        self._max_wait = max_wait
        self.state, self.reason, self.resumes = ProcedureState.READY, "", False
        self.goal, self.pursuit = 0, Pursuit()
        self.path: BodyPath | None = None
        self._tracker: PathTracker | None = None
        self._holder: PathTracker | None = None  # of the pose in which the needle is kept
        self._planned: BodyPath | None = None  # before the procedure was begun
        self._pending: PendingPath | None = None
        self._foreseen: PendingPath | None = None  # whether the path leads to its goal
        self._foresees_at = 0.0  # way on the path at which that is asked next [m]
        self._left: BodyPath | None = None  # of a path that does not, for when there is no better one
        self._goal_since = math.nan  # stamp at which the present goal was begun to be pursued [s]
        self._begin: Vector | None = None
        self._rest = RestDetector()
        self._back_off, self._back_off_until = np.zeros(3), -math.inf
        self._speed = math.inf
        self._unwrapped: float | None = None
        self._reached = 0  # goals on the path
        self._handover = 0.0  # way on the present path at which that of the next goal begins, or is asked for [m]
        self._waits_since = 0.0  # for the thread, since this stamp [s]
        self._judge: GoalJudge | None = None
        self._thread: Points | None = None  # as it was known last
        self._compensates = False  # whether the bridge has ever measured what pulls the needle

    @property
    def judge(self) -> GoalJudge:
        """What judges the goals."""
        if self._judge is None:
            self._judge = GoalJudge(self.procedure, self.planner.scene)
        return self._judge

    @property
    def is_commanding(self) -> bool:
        """Whether its output is to be followed: it runs, or is paused by itself and keeps the needle in place."""
        return self.state is ProcedureState.RUNNING or (self.resumes and self._holder is not None)

    @property
    def is_tracking(self) -> bool:
        """Whether there is a path that the needle is on."""
        return self._tracker is not None

    @property
    def travel(self) -> float:
        """Way of the tip on the present path [m]; 0 without one."""
        return 0.0 if self._tracker is None else self._tracker.travel

    @property
    def progress(self) -> float:
        """Completed share of the goal's path, 0 to 1."""
        if self.state is ProcedureState.DONE:
            return 1.0
        if self._tracker is None or self.path is None:
            return 0.0
        before = float(self.path.ends[self._reached - 1]) if self._reached else 0.0
        way = float(self.path.ends[self._reached]) - before
        return min(1.0, max(0.0, (self._tracker.travel - before) / way)) if way > 0.0 else 1.0

    def start(self, planned: BodyPath | None = None) -> None:
        """Begin, or go on after a pause, with the next pose; the goal's path is planned anew, unless there is one.

        Args:
            planned: a path of the present goal, which is taken if the needle is where it begins; None for none.
        """
        if self.state in (ProcedureState.READY, ProcedureState.PAUSED):
            self.state, self.reason, self.resumes = ProcedureState.RUNNING, "", False
            self._drop_path()
            self._planned = planned

    def pause(self, reason: str) -> None:
        """Rest until `start` is called again, also where the procedure would go on by itself."""
        if self.resumes:
            self._drop_path()
        if self.resumes or self.state is ProcedureState.RUNNING:
            self.state, self.reason, self.resumes = ProcedureState.PAUSED, reason, False

    def abort(self, reason: str) -> None:
        """Rest for good."""
        self.resumes = False
        if self.state not in ENDED:
            self.state, self.reason = ProcedureState.FAILED, reason

    def set_planner(self, planner: NeedlePlanner) -> None:
        """Plan in another scene from now on; a procedure that does not fit it fails."""
        self.planner = planner
        if self.state in ENDED:
            return
        self._drop_path()
        self._holder = None
        self.pursuit = replace(self.pursuit, left=math.inf, aim=np.zeros(2))
        try:
            planner.check(self.procedure, self.goal)
            self._judge = self.judge.in_scene(planner.scene)
        except MagnetosutureError as error:
            self.abort(str(error))

    def update(self, stamp: float, tail: Vector, heading: Vector, thread: ThreadCondition) -> Vector:
        """Return the motion commanded at a needle pose, see `NeedleTwist`, shape (3,) [m/s, m/s, rad/s].

        Args:
            stamp: of the pose [s].
            tail: shape (2,) [m].
            heading: unit vector at the tail, shape (2,).
            thread: what is known of it now.
        """
        middle, angle = self._pose(tail, heading)
        self._begin = middle if self._begin is None else self._begin
        self._heed(stamp, thread)
        self._thread = thread.vertices
        self._compensates = self._compensates or bool(thread.pull.any())
        if self.state in (ProcedureState.RUNNING, ProcedureState.PAUSED):
            self.judge.update(middle, thread.vertices)  # also by hand: a wrap may be unwound in a pause
        if self.state is not ProcedureState.RUNNING:
            self._rest = RestDetector()
            if self.path is not None and self.resumes and thread.may_hold:
                return self._hold(stamp, middle, angle, thread)
            self._holder = None
            return np.zeros(3)
        velocity = None
        try:
            if not self._backs_off(stamp) and (self._tracker is not None or self._plan(middle, angle)):
                self._holder = None
                velocity = self._pursue(stamp, middle, angle, thread)
        except PlanningError as error:
            self.abort(str(error))
        return self._wait(stamp, middle, angle, thread) if velocity is None else velocity

    def _heed(self, stamp: float, thread: ThreadCondition) -> None:
        """Pause for a thread that is not known, and go on, on the path of before, once it is."""
        if self.state is ProcedureState.RUNNING and thread.problem:
            self.pause(thread.problem)
            self.resumes, self._waits_since = True, stamp
        elif self.resumes and not thread.problem:
            self.state, self.reason, self.resumes = ProcedureState.RUNNING, "", False
        elif self.resumes:
            self.reason = thread.problem
            if not thread.may_hold:
                self._waits_since = stamp  # for something else than the thread
            elif stamp - self._waits_since > self._max_wait:
                self.abort(f"given up after a wait of {self._max_wait:g} s: {thread.problem}")

    def _wait(self, stamp: float, middle: Vector, angle: float, thread: ThreadCondition) -> Vector:
        """Return the command where there is no path to track: to back off, or to keep the needle in place."""
        if self.state is not ProcedureState.RUNNING:
            return np.zeros(3)
        return self._back_off if self._backs_off(stamp) else self._hold(stamp, middle, angle, thread)

    def _backs_off(self, stamp: float) -> bool:
        return 0.0 < self._back_off_until - stamp <= BACK_OFF_TIME  # no longer, where time was set back

    def _pursue(self, stamp: float, middle: Vector, angle: float, thread: ThreadCondition) -> Vector | None:
        """Return the command on the path; None where that has ended, and the next one begins with the next pose."""
        goal = self.procedure.goals[self.goal]
        on_the_way = self.path is not None and self._reached + 1 < len(self.path.ends)
        is_met = self._is_tight(goal, thread) if isinstance(goal, Tighten) else self.judge.is_met
        assert self._tracker is not None
        assert self.path is not None
        is_last = self.goal + 1 == len(self.procedure.goals)
        if isinstance(goal, Wait):
            self._goal_since = self._goal_since if self._goal_since <= stamp else stamp
            if stamp - self._goal_since >= goal.time:
                self._next_goal()
                return None
            held = stamp, middle, angle, self.procedure.limits[self.goal].speed
            return self._tracker.compute_command(*held, thread.slowdown, thread.pull, thread.age, hold=True).twist
        # A thread may be wound or tight long before the end of the path, as its free end moves too.
        is_far = self.path.ends[self._reached] > self.travel + 2.0 * PROGRESS
        if isinstance(goal, Tighten) or (isinstance(goal, Wrap) and is_last):
            is_enough = is_met
        else:
            is_enough = isinstance(goal, ThreadGoal) and not isinstance(goal, KeepSide) and self.judge.miss <= WELL_MET
        if is_enough:
            self._next_goal()
            return None
        if isinstance(goal, ThreadGoal) and self._strays():
            if self.judge.is_met and not isinstance(goal, KeepSide):
                self._next_goal()
                return None
            rest = self.path.part(self.travel, self.path.length)
            self._replan(stamp, np.zeros(3), self.judge.missing(self.goal))
            self._left = rest
            return None
        if self._pending is None and is_far and isinstance(goal, Wrap) and not is_last:
            if self.travel >= self._handover:
                self._plan_ahead(goal)
        elif self._pending is not None and self.travel >= self._handover:
            if not self.judge.is_met:
                self._pending, self._handover = None, self.travel + PROGRESS
            else:
                self._begin_goal(self.goal + 1)
                self._tracker = None
                try:
                    is_planned = self._plan(middle, angle)
                except PlanningError:
                    is_planned = False  # there may be a way from where the needle is now
                return self._pursue(stamp, middle, angle, thread) if is_planned else None
        if self._tracker.travel > PROGRESS:
            self.pursuit.replans = 0
        if (left := self.path.length - self._tracker.travel) < self.pursuit.left - PROGRESS:
            self.pursuit.detours, self.pursuit.left = 0, left
        at = stamp, middle, angle, self._allowed_speed(thread)
        command = self._tracker.compute_command(*at, thread.slowdown, thread.pull, thread.age)
        if command.done:
            self._at_end(goal, middle)
            return None
        if on_the_way and is_met and command.travel >= self.path.ends[self._reached]:
            self._begin_goal(self.goal + 1)
            self._reached += 1
        elif on_the_way and command.travel > self.path.ends[self._reached] + 0.5 * PROGRESS:
            self._miss(goal, middle)
            return None
        commanded = bool(command.twist.any())
        rests = self._rest.update(stamp, middle, angle, self.planner.lever, commanded, command.travel)
        if rests or command.error > max(OFF_PATH, min(0.5 * self._tracker.leeway, MAX_OFF_PATH)):
            beside = self.planner.beside(middle, angle)
            pulled = "" if self._compensates else " with motion_compensation of the coil bridge off"
            stopped, what = (command.twist, "rests") if rests else (np.zeros(3), "is off its path")
            self._replan(stamp, stopped, f"the needle {what}{beside}{pulled}")
            return None
        return command.twist

    def _at_end(self, goal: Goal, middle: Vector) -> None:
        """Go on from the end of a path: to the next goal, or anew where this one is not reached."""
        if isinstance(goal, Tighten):  # else it would have ended before
            self.abort(f"the thread is not tight at the end of goal {self.goal + 1}")
            return
        assert self._begin is not None
        is_there = not isinstance(goal, PlaceGoal) or math.dist(middle, place_of(goal, self._begin)) <= goal.tolerance
        if is_there and self.judge.is_met:
            self._next_goal()
        else:
            self._miss(goal, middle)

    def _miss(self, goal: Goal, middle: Vector) -> None:
        """Plan a goal anew that is not met at the end of its path; one of a place to the other side of that."""
        self.pursuit.misses += 1
        off = np.zeros(2)
        assert self._begin is not None
        if isinstance(goal, PlaceGoal):
            off = place_of(goal, self._begin) - middle
        if self.pursuit.misses > MAX_MISSES:
            if not self.judge.is_met:
                missing = self.judge.missing(self.goal)
            else:
                assert isinstance(goal, PlaceGoal)
                by = f"by {1e3 * math.hypot(*off):.2f} mm, with a tolerance of {1e3 * goal.tolerance:.2f} mm"
                missing = f"the needle misses its place {by}"
            self.abort(f"goal {self.goal + 1} is given up: {missing}, however it is planned")
            return
        assert self.path is not None
        aim, leeway = self.pursuit.aim + off, 0.5 * float(self.path.leeway[-1])  # a place that is off by less is free
        self.pursuit.aim = aim * min(1.0, leeway / max(math.hypot(*aim), 1e-12))
        self._drop_path()

    def _strays(self) -> bool:
        """Return whether, by a forecast, what is left of the path does not lead the thread to its goal any more."""
        assert self.path is not None
        if self._foreseen is None and self.travel >= self._foresees_at and self._thread is not None:
            left = self.path.part(self.travel, self.path.length)
            self._foreseen = self._submit(partial(self.planner.leads_to, self.procedure, self.goal, left, self._thread))
        elif self._foreseen is not None and self._foreseen.done():
            leads, self._foreseen = self._foreseen.result(), None
            self._foresees_at = self.travel + 2.0 * PROGRESS
            return not leads
        return False

    def _plan(self, middle: Vector, angle: float) -> bool:
        """Plan from a pose, or go on with that; return whether there is a path to track."""
        planned, self._planned = self._planned, None
        if planned is not None and self.planner.begins(planned, middle, angle):
            self._pending = plan_now(lambda: planned)
        if self._pending is None:
            self._ask_for_path(self.goal, middle, angle)
        assert self._pending is not None
        if not self._pending.done():
            return False
        pending, self._pending = self._pending, None
        self._foresees_at = 2.0 * PROGRESS
        try:
            self.path = pending.result()
        except PlanningError:
            if self._left is None:
                raise
            self.path, self._foresees_at = self._left, math.inf
        self._left = None
        self._tracker, self._reached, self._handover = self.planner.tracker(self.path), 0, 0.0
        return True

    def _plan_ahead(self, goal: Wrap) -> None:
        """Plan the next goal while the needle goes on, where a wrap will be met before the end of its path.

        A needle that waits for its path close to a coil's axis is pulled aside.
        """
        assert self.path is not None
        at = self.travel + PROGRESS
        poses = np.array([[*middle, angle] for middle, angle in map(self.path.at, np.linspace(self.travel, at, 5))])
        centre, led = centre_of(self.planner.scene, goal.around), self.planner.led
        swept = winding(led(np.empty((0, 2)), poses, 0.0), centre)  # more than which the thread does not wind meanwhile
        if self._thread is None or self.judge.left_to_wind * math.copysign(1.0, goal.swept) > abs(swept):
            return
        then = winding(led(self._thread, poses, self.procedure.limits[self.goal].speed), centre)
        if left_to_wind(self.procedure.windings[self.goal], then) == 0.0:
            self._handover = at
            self._ask_for_path(self.goal + 1, *self.path.at(at))

    def _ask_for_path(self, goal: int, middle: Vector, angle: float) -> None:
        assert self._begin is not None
        at = self.procedure, goal, middle, angle, self._begin.copy(), self._thread
        known = (self.judge.crossed, self.pursuit.aim, self._left) if goal == self.goal else ()
        self._pending = self._submit(partial(self.planner.plan, *at, *known))

    def _drop_path(self) -> None:
        """Forget the path that is tracked or planned; the next pose is where a new one begins."""
        self._tracker, self._pending, self._foreseen, self._left, self._planned = None, None, None, None, None
        self._rest, self._goal_since = RestDetector(), math.nan
        self._back_off_until = -math.inf

    def _hold(self, stamp: float, middle: Vector, angle: float, thread: ThreadCondition) -> Vector:
        """Return the command that keeps the needle where it was when this began, against what pulls it."""
        limits = self.procedure.limits[self.goal]
        if self._holder is None:
            self._holder = self.planner.tracker(self.planner.standing_path(middle, angle, limits))
        at = stamp, middle, angle, limits.speed, thread.slowdown, thread.pull, thread.age
        return self._holder.compute_command(*at, hold=True).twist

    def _replan(self, stamp: float, stopped: Vector, why: str) -> None:
        """Plan the goal anew; where the needle was stopped, back off first, the way that it came."""
        self.pursuit.replans += 1
        self.pursuit.detours += 1
        if self.pursuit.replans > MAX_REPLANS or self.pursuit.detours > MAX_DETOURS:
            self.abort(f"goal {self.goal + 1} is given up: {why}, however it is planned")
            return
        self._drop_path()
        if stopped.any():
            back = -stopped * (1.0, 1.0, 0.0)  # without its turn, which would go on for all of that time
            self._back_off, self._back_off_until = back, stamp + BACK_OFF_TIME

    def _next_goal(self) -> None:
        """Plan the next goal from the next pose; or be done, unless the thread has slipped off a shape."""
        self._drop_path()
        if self.goal + 1 < len(self.procedure.goals):
            self._begin_goal(self.goal + 1)
        elif lost := self.judge.lost_winding():
            self.abort(lost)
        else:
            self.state = ProcedureState.DONE

    def _begin_goal(self, goal: int) -> None:
        self.goal, self.pursuit, self._goal_since = goal, Pursuit(), math.nan
        self.judge.begin(goal)

    def _allowed_speed(self, thread: ThreadCondition) -> float:
        """Return the speed at which tension and friction stay within the goal's limits [m/s]."""
        limits = self.procedure.limits[self.goal]
        if thread.tension > TENSION_SHARE * limits.tension:
            self._speed = max(0.0, self._speed * TENSION_SHARE * limits.tension / thread.tension)
        self._speed = min(limits.speed, max(self._speed * 1.03, 0.02 * limits.speed))
        crowded = thread.friction_nodes - limits.friction_nodes
        is_free = crowded < 0 or not thread.friction_nodes or limits.friction_nodes >= UNLIMITED
        return self._speed if is_free else 0.3 * self._speed

    def _is_tight(self, goal: Tighten, thread: ThreadCondition) -> bool:
        if goal.tension > 0.0 and thread.tension < goal.tension:
            return False
        if not goal.clearance > 0.0:
            return True
        found = thread.vertices
        return found is not None and self.planner.thread_clearance(goal.around, found) <= goal.clearance

    def _pose(self, tail: Vector, heading: Vector) -> tuple[Vector, float]:
        middle, angle = self.planner.pose(tail, heading)
        if self._unwrapped is not None:
            angle = self._unwrapped + math.remainder(angle - self._unwrapped, 2.0 * math.pi)
        self._unwrapped = angle
        return middle, angle
