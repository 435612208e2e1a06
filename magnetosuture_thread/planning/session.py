"""The procedure of a needle planner: planned, begun, paused, resumed and given up, with all that it depends on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.planning.clearance_map import body_clearance
from magnetosuture_thread.planning.executor import ProcedureExecutor, ProcedureState, Vector
from magnetosuture_thread.planning.loop_state import LoopState
from magnetosuture_thread.planning.path import BodyPath
from magnetosuture_thread.planning.pending import PathSubmitter, plan_now
from magnetosuture_thread.planning.planner import NeedlePlanner, chain
from magnetosuture_thread.planning.procedure import Procedure, parse_procedure
from magnetosuture_thread.planning.settings import NeedlePlannerSettings
from magnetosuture_thread.scene import Dish, Scene

ENDED = (ProcedureState.DONE, ProcedureState.FAILED)


@dataclass(frozen=True)
class ProcedureStatus:
    """What a procedure does now.

    Attributes:
        state: of it; None without one.
        procedure: its name; empty without one.
        goals: kind of each goal, in order.
        goal: index of the present goal.
        goals_met: how many goals are met.
        progress: completed share of the present goal's path, 0 to 1.
        reason: why it is paused or has failed; empty else.
        resumes: whether it goes on by itself once the reason is gone.
        hold_to_run: whether it goes on only while somebody holds the page.
        clearance: minimum distance of the needle's axis from wall and shapes so far [m]; NaN before it has begun.
    """

    state: ProcedureState | None = None
    procedure: str = ""
    goals: tuple[str, ...] = ()
    goal: int = 0
    goals_met: int = 0
    progress: float = 0.0
    reason: str = ""
    resumes: bool = False
    hold_to_run: bool = False
    clearance: float = math.nan


class ProcedureSession:
    """Holds at most one procedure, and decides when it may go on.

    A pause by a person, by a command of the operator or by a coil bridge that is disarmed lasts until `resume`; one for
    a needle or thread that is not known ends by itself once they are known again.

    Pure: `now` is a monotonic time [s].

    Args:
        settings: of the planner.
        scene: dish and shapes; None until one is known.
        submit: begins to plan a path while the needle is moved; see `ProcedureExecutor`.

    Attributes:
        known: what the loop's nodes report.
        status: of the procedure.
        planned_duration: of what was planned last, at the allowed speed, without friction [s].
    """

    def __init__(self, settings: NeedlePlannerSettings, scene: Scene | None, submit: PathSubmitter = plan_now) -> None:
        self._settings, self._submit = settings, submit
        self.known = LoopState(settings)
        self.status = ProcedureStatus()
        self.planned_duration = 0.0
        self._planner: NeedlePlanner | None = None
        self._executor: ProcedureExecutor | None = None
        self._planned: list[tuple[int, BodyPath]] = []  # each with the index of its first goal
        self._shown: BodyPath | None = None
        self._pose: tuple[float, Vector, Vector] | None = None  # stamp, tail and heading
        self._by_person, self._armed = False, True
        self._clearance, self._progress = math.inf, 0.0
        if scene is not None:
            self.set_scene(scene)

    @property
    def is_running(self) -> bool:
        """Whether the procedure goes on."""
        return self._executor is not None and self._executor.state is ProcedureState.RUNNING

    @property
    def is_commanding(self) -> bool:
        """Whether the procedure commands the needle: it goes on, or keeps the needle in place."""
        return self._executor is not None and self._executor.is_commanding

    @property
    def is_active(self) -> bool:
        """Whether a procedure has begun and has not ended."""
        return self._executor is not None and self._executor.state in (ProcedureState.RUNNING, ProcedureState.PAUSED)

    def set_scene(self, scene: Scene) -> None:
        """Go by another scene; a procedure that does not fit it fails, and so does one that was only planned.

        Raises:
            ConfigurationError: the needle has no room in it; the scene of before stays.
        """
        self._planner = self._settings.planner(scene)
        self.known.scene_version = scene.version
        del self._planned[1:]  # paths of later goals, by the scene of before
        self._shown = None
        if self._executor is None:
            return
        if self._executor.state is ProcedureState.READY:
            self._executor.abort("the scene has changed since it was planned")
        self._executor.set_planner(self._planner)
        self._update_status()

    def plan(self, procedure: Procedure, now: float, *, hold_to_run: bool = False) -> tuple[BodyPath, ...]:
        """Plan a procedure from where the needle is; nothing moves before `resume`.

        Args:
            procedure: to execute.
            now: a monotonic time [s].
            hold_to_run: whether the needle moves only while somebody holds the page.

        Raises:
            ConfigurationError: it does not fit the scene.
            InvalidInputError: a procedure runs, or scene or needle are not known.
            PlanningError: there is no way to a goal.
        """
        if self.is_active:
            at = f"{self.status.procedure}, at goal {self.status.goal + 1} of {len(self.status.goals)}"
            raise InvalidInputError("procedure", procedure.name, f"none while another is executed: {at}")
        if self._planner is None:
            raise InvalidInputError("procedure", procedure.name, "a scene first, as a parameter or on its topic")
        if self._pose is None or not self.known.has_pose(now):
            raise InvalidInputError("procedure", procedure.name, "a needle that is tracked")
        executor = ProcedureExecutor(procedure, self._planner, self._submit, self._settings.thread_wait)
        paths = executor.plan(*self._pose[1:])
        self._planned, self.planned_duration, index = [], 0.0, 0
        for path in paths:
            self._planned.append((index, path))
            self.planned_duration += path.length / procedure.limits[index].speed
            index += len(chain(procedure, index))
        self._executor, self._shown = executor, None
        self._clearance, self._progress = math.inf, 0.0
        self.known.hold_to_run, self._by_person = hold_to_run, False
        self._update_status()
        return paths

    def resume(self) -> None:
        """Begin what is planned, or go on after a pause; the way is planned anew from where the needle is.

        Raises:
            InvalidInputError: nothing is planned or paused, or the coil bridge is not armed.
        """
        executor = self._executor
        if executor is None or executor.state not in (ProcedureState.READY, ProcedureState.PAUSED):
            state = "no procedure" if executor is None else f"a procedure that is {executor.state.value}"
            raise InvalidInputError("resume", state, "one that is planned or paused")
        self.check_armed()
        self.known.accept_disturbances()
        executor.start()
        self._by_person = False
        self._update_status()

    def check_armed(self) -> None:
        """Refuse to begin or to go on while the coil bridge is not armed.

        Raises:
            InvalidInputError: it is not.
        """
        if not self._armed:
            raise InvalidInputError("coil bridge", "not armed", "an armed one: a procedure does not arm it")

    def pause(self, reason: str) -> bool:
        """Rest until `resume`; return whether there was anything to pause."""
        if self._executor is None or not self.is_active:
            return False
        if self._executor.state is ProcedureState.PAUSED and not self._by_person:
            self._executor.start()  # it would go on by itself
        self._executor.pause(reason)
        self._by_person = True
        self._update_status()
        return True

    def abort(self, reason: str) -> bool:
        """Give the procedure up; return whether there was one."""
        if self._executor is None or self._executor.state in ENDED:
            return False
        self._executor.abort(reason)
        self._update_status()
        return True

    def on_bridge(self, armed: bool, drift: float) -> None:
        """Register whether the coil bridge is armed; a procedure pauses where it is not, until `resume`.

        Args:
            armed: whether it is.
            drift: velocity across the needle's chord that it compensates [m/s].
        """
        self.known.on_bridge(drift)
        self._armed = armed
        if not armed and not self._by_person:
            self.pause("the coil bridge is not armed")

    def on_pose(self, stamp: float, tail: Vector, heading: Vector, now: float) -> Vector | None:
        """Return the velocity commanded of the tip at a needle pose, shape (2,) [m/s]; None where nothing is commanded.

        A procedure that is paused by itself, for the thread, keeps the needle in place.

        Args:
            stamp: of the pose [s].
            tail: shape (2,) [m].
            heading: unit vector at the tail, shape (2,).
            now: a monotonic time [s].
        """
        planner, executor = self._planner, self._executor
        radius = math.inf if planner is None else planner.scene.dish.radius
        self.known.on_pose(now, math.hypot(*tail), radius)
        self._pose = stamp, tail, heading
        if executor is None or planner is None or not self.is_active:
            return None
        if executor.path is None and not self._by_person:
            # The needle has not been moved yet: what is found only now was there when a person began.
            self.known.accept_disturbances()
        output = executor.update(stamp, tail, heading, self.known.condition(now))
        self._progress = output.progress
        if self.is_running:
            middle, angle = planner.pose(tail, heading)
            near = body_clearance(float(middle[0]), float(middle[1]), angle, planner.body, planner.near)
            self._clearance = min(self._clearance, near)
        self._update_status()
        return output.velocity if executor.is_commanding else None

    @property
    def setpoint(self) -> tuple[Vector, float] | None:
        """Where the path wants the needle's tip, shape (2,) [m], and the chord's angle [rad]; None without one."""
        executor = self._executor
        if executor is None or executor.path is None or not (self.is_running and executor.is_tracking):
            return None
        middle, angle = executor.path.at(executor.travel)
        return middle + executor.path.lever * np.array([math.cos(angle), math.sin(angle)]), angle

    def check(self, now: float) -> None:
        """Pause a procedure that cannot go on, also where no pose comes any more."""
        if self._executor is None or self._pose is None or not self.is_commanding:
            return
        condition = self.known.condition(now)
        if condition.problem:
            self._executor.update(*self._pose, condition)
            self._update_status()

    def new_plan(self) -> Points | None:
        """Return where the middle of the needle is to go, shape (m, 2) [m]; None if that is as it was."""
        executor = self._executor
        if executor is None:
            return None
        current = executor.path if executor.path is not None else self._planned[0][1]
        if current is self._shown:
            return None
        self._shown = current
        if executor.path is None:
            ahead = [path for _, path in self._planned]
        else:
            ahead = [current, *(path for first, path in self._planned if first > executor.goal)]
        return np.vstack([path.middles for path in ahead])

    def _update_status(self) -> None:
        executor = self._executor
        assert executor is not None
        state, goals = executor.state, tuple(goal.GROUP for goal in executor.procedure.goals)
        self.status = ProcedureStatus(
            state,
            executor.procedure.name,
            goals,
            executor.goal,
            len(goals) if state is ProcedureState.DONE else executor.goal,
            self._progress,
            executor.reason,
            state is ProcedureState.PAUSED and not self._by_person,
            self.known.hold_to_run,
            self._clearance if math.isfinite(self._clearance) else math.nan,
        )


@cache
def compile_planning() -> None:
    """Compile what plans and tracks paths, where that has not been done on this machine."""
    session = ProcedureSession(NeedlePlannerSettings(settle=0.0), Scene(Dish(0.1)))
    at, heading = np.zeros(2), np.array([1.0, 0.0])
    session.on_pose(0.0, at, heading, 0.0)
    session.plan(parse_procedure({"goals": [{"go_to": {"position": [0.01, 0.0]}}]}, "warm-up"), 0.0)
    session.resume()
    session.known.on_prediction(0.0, 0.0, lambda: np.zeros((2, 2)))
    session.known.on_margins(0.0, "", 0, 1.0, session.known.scene_version)
    for k in range(2):
        session.on_pose(0.05 * k, at, heading, 0.0)
