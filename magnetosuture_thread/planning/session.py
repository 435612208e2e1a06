"""The procedure of a needle planner: planned, begun, paused, resumed and given up, with all that it depends on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import ClassVar, NamedTuple

import numpy as np

from magnetosuture_thread.coils.needle_motion import NeedleKinematics
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.scene import Dish, Scene
from magnetosuture_thread.planning.executor import (
    ENDED,
    MAX_WAIT,
    PathSubmitter,
    ProcedureExecutor,
    ProcedureState,
    ThreadCondition,
    Vector,
    plan_now,
)
from magnetosuture_thread.planning.path import BodyPath, body_clearance
from magnetosuture_thread.planning.planner import NeedlePlanner, chains, planned_duration
from magnetosuture_thread.planning.procedure import Procedure, parse_procedure
from magnetosuture_thread.settings import shared_parameters as shared
from magnetosuture_thread.settings.configuration import quantity
from magnetosuture_thread.settings.errors import InvalidInputError

NO_POSE = "no needle pose yet"
MAX_ABSENCE = 3.0  # in `pose_timeout`; without poses for longer, the needle may be elsewhere: a person looks first


@dataclass(frozen=True)
class NeedlePlannerSettings(
    shared.LifecycleSettings, shared.SceneName, shared.NeedleArc, shared.ThreadLength, shared.CommandFilter
):
    """The needle, its clearance, and for how long what is known stays known."""

    GROUP: ClassVar[str] = "needle_planner"

    pose_timeout: float = quantity(
        0.5,
        "a procedure pauses after this long without a needle pose; one that is older on arrival does not count",
        unit="s",
        minimum=0.05,
        maximum=5.0,
    )
    thread_timeout: float = quantity(
        0.5,
        "a procedure pauses after this long without valid margins of the thread",
        unit="s",
        minimum=0.05,
        maximum=5.0,
    )
    unmeasured_timeout: float = quantity(
        1.0,
        "a procedure pauses after this long without a measurement of the thread",
        unit="s",
        minimum=0.1,
        maximum=60.0,
    )
    thread_wait: float = quantity(
        MAX_WAIT,
        "a procedure that is paused because the thread is not known is given up after this long",
        unit="s",
        minimum=1.0,
        maximum=3600.0,
    )
    settle: float = quantity(
        0.5,
        "for which all must be known again before a procedure goes on by itself",
        unit="s",
        minimum=0.0,
        maximum=60.0,
    )
    hold_timeout: float = quantity(
        0.3, "the needle rests this long after the last message on procedure/hold, where it has to be held",
        unit="s", minimum=0.05, maximum=2.0,
    )  # fmt: skip
    audience: int = quantity(
        1, "subscribers to its commands that it waits for: the bridge, and any recorder", minimum=1, maximum=100
    )

    def planner(
        self, scene: Scene, coils: CoilBridgeSettings | None = None, model: ThreadModelSettings | None = None
    ) -> NeedlePlanner:
        """Return a planner for a scene, that knows axes and delay of the coil bridge's coils, and the thread model."""
        kinematics = NeedleKinematics(self.needle_length, self.needle_curvature)
        clearance = self.keep_out + self.pose_margin  # as the bridge's filter
        axes, delay = (coils.allocation().axes(), coils.motion_delay) if coils else ((), 0.0)
        return NeedlePlanner(scene, kinematics, clearance, self.thread_length, axes, model, delay)


class _Margins(NamedTuple):
    time: float
    reason: str  # why they are not valid; empty if they are
    friction_nodes: int
    slowdown: float
    scene_version: str


class LoopState:
    """Collects what the nodes of the loop report, and returns why a procedure cannot go on.

    Pure: `now` is a monotonic time [s].

    Args:
        settings: of the planner.

    Attributes:
        scene_version: of the planner's scene; empty for none.
        hold_to_run: whether a procedure goes on only while somebody holds the page.
    """

    def __init__(self, settings: NeedlePlannerSettings) -> None:
        self._settings = settings
        self.scene_version, self.hold_to_run = "", False
        self._pose, self._outside = -math.inf, ""
        self._tracker = ""
        self._margins: _Margins | None = None
        self._tension, self._pull = 0.0, np.zeros(2)
        self._vertices: Callable[[], Points | None] | None = None
        self._estimated, self._estimate_problem = -math.inf, ""
        self._disturbances: dict[float, str] = {}
        self._accepted: set[float] = set()
        self._held = -math.inf
        self._graph_problem = ""
        self._last_problem, self._last_problem_time = NO_POSE, -math.inf

    def on_pose(self, now: float, distance: float, dish_radius: float) -> None:
        """Register a needle pose, with the distance of its tail from the dish's centre [m]."""
        self._pose = now
        self._outside = "" if distance <= dish_radius else "the needle is outside of the dish"

    def on_tracker(self, problem: str) -> None:
        """Register why the tracker has no needle in a frame; empty if it has."""
        self._tracker = problem and f"the needle is not tracked: {problem}"

    def on_prediction(self, now: float, tension: float, vertices: Callable[[], Points | None]) -> None:
        """Register a predicted thread: the peak of its tension [N], and what returns its vertices.

        Where no thread is estimated any more, nothing of the last estimate counts.
        """
        self._tension = tension
        if now - self._estimated > self._settings.thread_timeout:
            self._vertices, self._estimate_problem, self._disturbances = vertices, "", {}

    def on_estimate(
        self,
        now: float,
        unmeasured_for: float,
        disturbances: Mapping[float, str],
        vertices: Callable[[], Points | None],
    ) -> None:
        """Register an estimated thread.

        Args:
            now: a monotonic time [s].
            unmeasured_for: time since the thread was measured [s].
            disturbances: forces on it that the model does not know of, as texts, each by when it was found first [s].
            vertices: returns them, shape (n + 1, 2) [m]; None where they are not valid.
        """
        self._estimated, self._vertices, self._estimate_problem = now, vertices, ""
        if not unmeasured_for <= self._settings.unmeasured_timeout:  # also where it is no number
            self._estimate_problem = f"the thread has not been measured for {unmeasured_for:.1f} s"
        self._accepted &= disturbances.keys()
        self._disturbances = dict(disturbances)

    def accept_disturbances(self) -> None:
        """Go on in spite of the forces that are known now, as a person who begins or resumes wants; new ones count."""
        self._accepted = set(self._disturbances)

    def on_bridge(self, pull: Sequence[float]) -> None:
        """Register the velocity by the thread's pull that the bridge compensates [m/s]; 0 if it is not finite."""
        self._pull = np.array(pull) if np.isfinite(pull).all() else np.zeros(2)

    def on_margins(self, now: float, reason: str, friction_nodes: int, slowdown: float, scene_version: str) -> None:
        """Register the thread's margins, or the reason why they are not valid."""
        self._margins = _Margins(now, reason, friction_nodes, slowdown, scene_version)

    def on_hold(self, now: float) -> None:
        """Register that somebody holds the page."""
        self._held = now

    def on_graph(self, problem: str) -> None:
        """Register what is wrong with the graph: nobody follows the commands, or another node commands too."""
        self._graph_problem = problem

    def shift(self, duration: float) -> None:
        """Take what is known to be younger by a time in which nothing was heard, as while a path is planned [s]."""
        self._pose += duration
        self._estimated += duration
        self._held += duration
        self._last_problem_time += duration
        if self._margins is not None:
            self._margins = self._margins._replace(time=self._margins.time + duration)

    def has_pose(self, now: float) -> bool:
        """Return whether the needle's pose is known now."""
        return now - self._pose <= self._settings.pose_timeout

    def absence_problem(self, now: float) -> str:
        """Return that the needle has not been seen for so long that a person has to look; empty if it has."""
        limit = MAX_ABSENCE * self._settings.pose_timeout
        is_known = now - self._pose <= limit
        return "" if is_known else f"the needle was not seen for more than {limit:g} s"

    def condition(self, now: float) -> ThreadCondition:
        """Return what is known, with the reason why a procedure cannot go on; that of before until it has settled.

        Where the thread alone is the reason, or all is known and has to settle, the needle may be kept in place.
        """
        needle, page = self._needle_problem(now), self._page_problem(now)
        may_hold = not (needle or page)
        problem = needle or self._thread_problem(now) or page
        if problem:
            self._last_problem, self._last_problem_time = problem, now
        elif now - self._last_problem_time < self._settings.settle:
            problem = self._last_problem
        margins = self._margins
        return ThreadCondition(
            None if self._vertices is None else self._vertices(),
            self._tension,
            0 if margins is None else margins.friction_nodes,
            1.0 if margins is None or self._settings.friction_feedback != "all" else margins.slowdown,
            problem,
            self._pull,
            may_hold,
        )

    def _page_problem(self, now: float) -> str:
        held = now - self._held <= self._settings.hold_timeout
        return "nobody holds the page" if self.hold_to_run and not held else ""

    def _needle_problem(self, now: float) -> str:
        """Return the first reason why the needle cannot be commanded; empty for none."""
        if not self.has_pose(now):
            if not math.isfinite(self._pose):
                return NO_POSE
            return self._tracker or f"no needle pose for more than {self._settings.pose_timeout:g} s"
        return self._outside or self._graph_problem  # in a frame or two it may be missed

    def _thread_problem(self, now: float) -> str:
        margins = self._margins
        if self._vertices is None:
            return "no thread yet"
        if margins is None:
            return "no margins of the thread yet"
        if margins.reason:
            return f"the thread is not known: {margins.reason}"
        if now - margins.time > self._settings.thread_timeout:
            return f"no margins of the thread for more than {self._settings.thread_timeout:g} s"
        if margins.scene_version != self.scene_version:
            return "thread_model goes by another scene"
        if self._estimate_problem:
            return self._estimate_problem
        new = [text for since, text in self._disturbances.items() if since not in self._accepted]
        # A reason names at most three forces.
        return f"an unmodelled contact: the thread is {'; '.join(new[:3])}" if new else ""


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

    A pause by a person, by a command of the operator or by a coil bridge that is disarmed lasts until `resume`, as does
    one for a needle of which there were no poses for `MAX_ABSENCE`; others for a needle or thread that is not known end
    by themselves once they are known again.

    Pure: `now` is a monotonic time [s].

    Args:
        settings: of the planner.
        scene: dish and shapes; None until one is known.
        submit: begins to plan a path while the needle is moved; see `ProcedureExecutor`.
        coils: settings of the coil bridge that follows.
        model: settings of the thread model, for forecasts.

    Attributes:
        known: what the loop's nodes report.
        planned_duration: of what was planned last, at the allowed speed, without friction [s].
    """

    def __init__(
        self,
        settings: NeedlePlannerSettings,
        scene: Scene | None,
        submit: PathSubmitter = plan_now,
        coils: CoilBridgeSettings | None = None,
        model: ThreadModelSettings | None = None,
    ) -> None:
        self._settings, self._submit, self._coils, self._model = settings, submit, coils, model
        self.known = LoopState(settings)
        self.planned_duration = 0.0
        self._planner: NeedlePlanner | None = None
        self._executor: ProcedureExecutor | None = None
        self._planned: list[tuple[int, BodyPath]] = []  # each with the index of its first goal
        self._shown: BodyPath | None = None
        self._pose: tuple[float, Vector, Vector] | None = None  # stamp, tail and heading
        self._armed, self._clearance = True, math.nan
        if scene is not None:
            self.set_scene(scene)

    @property
    def status(self) -> ProcedureStatus:
        """What the procedure does now."""
        executor = self._executor
        if executor is None:
            return ProcedureStatus()
        goals = tuple(goal.GROUP for goal in executor.procedure.goals)
        return ProcedureStatus(
            state=executor.state,
            procedure=executor.procedure.name,
            goals=goals,
            goal=executor.goal,
            goals_met=len(goals) if executor.state is ProcedureState.DONE else executor.goal,
            progress=executor.progress,
            reason=executor.reason,
            resumes=executor.resumes,
            hold_to_run=self.known.hold_to_run,
            clearance=self._clearance,
        )

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
        self._planner = self._settings.planner(scene, self._coils, self._model)
        self.known.scene_version = scene.version
        del self._planned[1:]  # paths of later goals, by the scene of before
        self._shown = None
        if self._executor is None:
            return
        if self._executor.state is ProcedureState.READY:
            self._executor.abort("the scene has changed since it was planned")
        self._executor.set_planner(self._planner)

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
            status = self.status
            at = f"{status.procedure}, at goal {status.goal + 1} of {len(status.goals)}"
            raise InvalidInputError("procedure", procedure.name, f"none while another is executed: {at}")
        if self._planner is None:
            raise InvalidInputError("procedure", procedure.name, "a scene first, as a parameter or on its topic")
        if self._pose is None or not self.known.has_pose(now):
            raise InvalidInputError("procedure", procedure.name, "a needle that is tracked")
        thread = self.known.condition(now).vertices
        paths = self._planner.plan_all(procedure, *self._planner.pose(*self._pose[1:]), thread)
        self._planned = [(index, path) for (index, _), path in zip(chains(procedure), paths, strict=True)]
        self.planned_duration = planned_duration(procedure, paths)
        self._executor = ProcedureExecutor(procedure, self._planner, self._submit, self._settings.thread_wait)
        self._shown, self._clearance = None, math.nan
        self.known.hold_to_run = hold_to_run
        return paths

    def resume(self, now: float) -> None:
        """Begin what is planned, or go on after a pause; the way is planned anew where the needle is elsewhere by then.

        Args:
            now: a monotonic time [s].

        Raises:
            InvalidInputError: nothing is planned or paused, the coil bridge is not armed, or the needle is not seen.
        """
        executor = self._executor
        if executor is None or executor.state not in (ProcedureState.READY, ProcedureState.PAUSED):
            state = "no procedure" if executor is None else f"a procedure that is {executor.state.value}"
            raise InvalidInputError("resume", state, "one that is planned or paused")
        self.check_armed()
        if problem := self.known.absence_problem(now):
            raise InvalidInputError("resume", problem, "a needle that is tracked")
        self.known.accept_disturbances()
        executor.start(self._planned[0][1] if executor.state is ProcedureState.READY else None)

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
        self._executor.pause(reason)
        return True

    def abort(self, reason: str) -> bool:
        """Give the procedure up; return whether there was one."""
        if self._executor is None or self._executor.state in ENDED:
            return False
        self._executor.abort(reason)
        return True

    def on_bridge(self, armed: bool, pull: Sequence[float]) -> None:
        """Register whether the coil bridge is armed; a procedure pauses where it is not, until `resume`.

        Args:
            armed: whether it is.
            pull: velocity that the thread's pull gives the needle, which it compensates, two numbers [m/s].
        """
        self.known.on_bridge(pull)
        self._armed = armed
        if not armed and (self.is_running or (self._executor is not None and self._executor.resumes)):
            self.pause("the coil bridge is not armed")

    def on_pose(self, stamp: float, tail: Vector, heading: Vector, now: float, age: float = 0.0) -> Vector | None:
        """Return the motion commanded at a needle pose, see `NeedleTwist`, shape (3,); None where nothing is commanded.

        A procedure that is paused by itself, for the thread, keeps the needle in place.

        Args:
            stamp: of the pose [s].
            tail: shape (2,) [m].
            heading: unit vector at the tail, shape (2,).
            now: a monotonic time [s].
            age: of the pose now [s].
        """
        self._check_absence(now)
        planner, executor = self._planner, self._executor
        radius = math.inf if planner is None else planner.scene.dish.radius
        self.known.on_pose(now, math.hypot(*tail), radius)
        self._pose = stamp, tail, heading
        if executor is None or planner is None or not self.is_active:
            return None
        if executor.path is None and (self.is_running or executor.resumes):
            # The needle has not been moved yet: what is found only now was there when a person began.
            self.known.accept_disturbances()
        velocity = executor.update(stamp, tail, heading, replace(self.known.condition(now), age=age))
        if self.is_running:
            middle, angle = planner.pose(tail, heading)
            near = body_clearance(float(middle[0]), float(middle[1]), angle, planner.body, planner.near)
            self._clearance = near if math.isnan(self._clearance) else min(self._clearance, near)
        return velocity if executor.is_commanding else None

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
        self._check_absence(now)
        if self._executor is None or self._pose is None or not self.is_commanding:
            return
        condition = self.known.condition(now)
        if condition.problem:
            self._executor.update(*self._pose, condition)

    def _check_absence(self, now: float) -> None:
        if problem := self.known.absence_problem(now):
            self.pause(f"{problem}: look, then resume")

    def new_plan(self) -> Points | None:
        """Return x, y [m] and angle [rad] of the chord where the needle is to go, shape (m, 3); None if as it was."""
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
        return np.vstack([path.poses for path in ahead])


@cache
def compile_planning() -> None:
    """Compile what plans and tracks paths, where that has not been done on this machine."""
    session = ProcedureSession(NeedlePlannerSettings(settle=0.0), Scene(Dish(0.1)))
    at, heading = np.zeros(2), np.array([1.0, 0.0])
    session.on_pose(0.0, at, heading, 0.0)
    session.plan(parse_procedure({"goals": [{"go_to": {"position": [0.01, 0.0]}}]}, "warm-up"), 0.0)
    session.resume(0.0)
    session.known.on_prediction(0.0, 0.0, lambda: np.zeros((2, 2)))
    session.known.on_margins(0.0, "", 0, 1.0, session.known.scene_version)
    for k in range(2):
        session.on_pose(0.05 * k, at, heading, 0.0)
