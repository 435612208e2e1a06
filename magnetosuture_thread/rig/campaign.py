"""One run of a procedure in the closed loop: what its seed varies, its figures, and whether it succeeded."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from magnetosuture_thread.geometry.obstacles import measure, pack_obstacles
from magnetosuture_thread.geometry.polyline import Points, Vector
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.planning import executor
from magnetosuture_thread.planning.path import BodyPath
from magnetosuture_thread.planning.planner import NeedlePlanner, PlanningError, planned_duration
from magnetosuture_thread.planning.procedure import Procedure, ProcedureLimits, ThreadGoal, Wait, Wrap
from magnetosuture_thread.planning.verdict import centre_of, winding
from magnetosuture_thread.rig.closed_loop import LATENCY, ClosedLoop, LoopFrame, LoopRecorder
from magnetosuture_thread.rig.ground_truth import GoalTruth
from magnetosuture_thread.rig.rig import Rig
from magnetosuture_thread.rig.setups import Setup
from magnetosuture_thread.settings.errors import ConfigurationError, SolverError

MAX_TIME = 600.0  # s; of a run
# What a run must keep to succeed, besides its goals, and one and a half times its ideal time.
KEEP_OUT_TOLERANCE = 5e-6  # m
PENETRATION_TOLERANCE = 1e-6  # m
MAX_REST = 3.0  # s


@dataclass(frozen=True, eq=False)
class Variation:
    """The truth of one run.

    Attributes:
        seed: that it is drawn by.
        setup: with the rig's settings as they are in truth; those of the nodes are as before.
        losses: share of the frames that get lost.
        latency: from a frame to the command that follows from it [s].
    """

    seed: int
    setup: Setup
    losses: float = 0.05
    latency: float = LATENCY


def vary(setup: Setup, seed: int) -> Variation:
    """Return the truth of the run with a seed.

    Uniformly drawn: the start within 1 mm and 0.15 rad, the thread's start curvature by 30 %, the viscosity by 30 % (of
    needle and thread alike), the bending stiffness by 50 %, each coil by 5 %, the thread's friction from 0 to 0.3. A
    start in the wall or a shape is drawn anew.

    Raises:
        ConfigurationError: no start is free, of needle and thread.
    """
    random = np.random.default_rng([seed, 0])
    rig, scene = setup.rig, setup.scene

    def factor(share: float) -> float:
        return float(1.0 + share * random.uniform(-1.0, 1.0))

    liquid = factor(0.3)
    liquids = {name: getattr(rig, name) * liquid for name in ("viscosity", "thread_drag_across", "thread_drag_along")}
    stiffness = rig.thread_bending_stiffness * factor(0.5)
    friction = float(random.uniform(0.0, 0.3))
    gains = np.array(rig.coil_gains or 1.0) * (1.0 + 0.05 * random.uniform(-1.0, 1.0, len(rig.coil_angles)))
    changes: dict[str, Any] = {**liquids, "thread_bending_stiffness": stiffness, "thread_friction": friction}
    changed = replace(rig, seed=seed, coil_gains=tuple(gains.tolist()), **changes)
    x, y, heading = rig.needle_start
    for _ in range(100):
        dx, dy = 1e-3 * random.uniform(-1.0, 1.0, 2)
        turned = math.remainder(heading + 0.15 * random.uniform(-1.0, 1.0), math.tau)
        start = (x + float(dx), y + float(dy), turned)
        curvature = rig.thread_start_curvature * factor(0.3)
        drawn = replace(changed, needle_start=start, thread_start_curvature=curvature)
        try:
            drawn.check_scene(scene)
        except ConfigurationError:
            continue
        return Variation(seed, replace(setup, rig=drawn).with_scene(scene))
    expected = "a start with room around it"
    try:
        rig.check_scene(scene)
    except ConfigurationError as error:  # what is in the way, with the start as it is
        expected += f": {error.expectation}"
    raise ConfigurationError("rig_simulator.needle_start", list(rig.needle_start), expected)


@dataclass
class RunFigures:
    """The figures of a run, all of them in the ground truth of the simulation but for the friction.

    Attributes:
        time_s: from the start of the procedure to its end.
        ideal_time_s: of the path planned at the start, and of what a new one to a goal of the thread is longer than the
            rest of the old one, at the allowed speed, slowed by friction as it was in the run.
        min_needle_clearance_m: of the needle's axis from wall and shapes.
        max_thread_penetration_m: of a node of the thread into wall or shapes.
        longest_rest_s: for which the needle did not move, but in a `wait` and while a goal of the thread is planned.
        wrap_degrees: that the thread swept at the most about the shape of the first wrap; 0 without one.
        max_tension_n: peak of the thread.
        max_friction_nodes: under friction at once, by the model.
        max_tension_excess_n: of the tension above the limit of the goal that was pursued; negative if it stayed below.
        max_friction_excess: of the nodes under friction above that goal's limit.
    """

    time_s: float = 0.0
    ideal_time_s: float = 0.0
    min_needle_clearance_m: float = math.inf
    max_thread_penetration_m: float = 0.0
    longest_rest_s: float = 0.0
    wrap_degrees: float = 0.0
    max_tension_n: float = 0.0
    max_friction_nodes: int = 0
    max_tension_excess_n: float = -math.inf
    max_friction_excess: int = -executor.UNLIMITED

    def beyond_limits(self, keep_out: float) -> dict[str, str]:
        """Return what a run did not keep: by the name of the figure, what was found and what is allowed.

        A run without a path has no ideal time, and has failed for that.

        Args:
            keep_out: of the bridge [m].
        """
        clearance, allowed = self.min_needle_clearance_m, keep_out - KEEP_OUT_TOLERANCE
        deep, rest, ratio = self.max_thread_penetration_m, self.longest_rest_s, 1.5 * self.ideal_time_s
        tension, friction = self.max_tension_excess_n, self.max_friction_excess
        near = f"the needle's axis {1e3 * clearance:.3f} mm from wall or shape ({1e3 * allowed:.3f} allowed)"
        within = f"a node of the thread {1e6 * deep:.1f} µm in wall or shape"
        strong = f"a tension {1e3 * tension:.3g} mN above the limit of its goal"
        checks = (
            ("min_needle_clearance_m", clearance < allowed, near),
            ("max_thread_penetration_m", deep > PENETRATION_TOLERANCE, within),
            ("longest_rest_s", rest > MAX_REST, f"a rest of {rest:.1f} s ({MAX_REST:g} allowed)"),
            ("max_tension_n", tension > 0.0, strong),
            ("max_friction_nodes", friction > 0, f"{friction} more nodes under friction than its goal allows"),
            ("time_s", self.time_s > ratio > 0.0, f"{self.time_s:.0f} s ({ratio:.0f} allowed)"),
        )
        return {name: words for name, is_broken, words in checks if is_broken}


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
        figures: of the run so far.
        closest: the instant with the minimum clearance; None before the first frame.
    """

    def __init__(
        self, planner: NeedlePlanner, scene: Scene, limits: Sequence[ProcedureLimits], wrap: Wrap | None
    ) -> None:
        self._planner, self._wrap, self._scene, self._limits = planner, wrap, scene, limits
        self._packed = pack_obstacles(scene.obstacles, scene.dish.radius)
        self.figures = RunFigures()
        self.closest: RunInstant | None = None
        self._last: deque[RunInstant] = deque()
        self._angle = 0.0  # of the needle's chord [rad]
        self._anchor = (0.0, math.inf, math.inf, math.inf)

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
        figures, limits, nodes = self.figures, self._limits[goal], frame.condition.friction_nodes
        if instant.clearance < figures.min_needle_clearance_m:
            figures.min_needle_clearance_m, self.closest = instant.clearance, instant
        figures.max_thread_penetration_m = max(figures.max_thread_penetration_m, -self._distance(frame.thread))
        figures.max_tension_n = max(figures.max_tension_n, frame.tension)
        figures.max_friction_nodes = max(figures.max_friction_nodes, nodes)
        figures.max_tension_excess_n = max(figures.max_tension_excess_n, frame.tension - limits.tension)
        figures.max_friction_excess = max(figures.max_friction_excess, nodes - limits.friction_nodes)
        if self._wrap is not None:
            swept = math.degrees(winding(frame.thread, centre_of(self._scene, self._wrap.around)))
            figures.wrap_degrees = max(figures.wrap_degrees, abs(swept))
        # Not wrapped at a half turn, over which noise would be a turn of the needle.
        self._angle += math.remainder(angle - self._angle, 2.0 * math.pi)
        at = (frame.time, float(middle[0]), float(middle[1]), self._planner.lever * self._angle)
        if not running or math.dist(at[1:], self._anchor[1:]) > 5e-5:  # m: it does not rest
            self._anchor = at
        figures.longest_rest_s = max(figures.longest_rest_s, frame.time - self._anchor[0])
        self._last.append(instant)
        while self._last[0].frame.time < frame.time - 4.0:
            self._last.popleft()

    def last_instants(self) -> tuple[RunInstant, ...]:
        """Return instants of the last seconds, evenly spaced, the last frame among them."""
        count = min(6, len(self._last))
        return tuple(self._last[round(index)] for index in np.linspace(0, len(self._last) - 1, count))

    def _distance(self, points: Points) -> float:
        size = len(points), len(self._packed.shapes)
        distances, normals = np.empty(size), np.empty((*size, 2))
        measure(np.ascontiguousarray(points), self._packed, distances, normals)
        wall = self._scene.dish.radius - float(np.hypot(*points.T).max())
        return min(wall, float(distances.min(initial=math.inf)))


@dataclass(frozen=True)
class RunResult:
    """The result of a run.

    Attributes:
        seed: of the run.
        success: whether all goals were reached, in truth too, and all limits held.
        reason: why not; empty if so.
        goals_met: how many were.
        figures: of the run.
        simulated_s: simulated time that the run took, with the time before the procedure began.
        last_instants: of the last seconds of a run that failed, in order; empty of one that succeeded.
        closest_instant: of a run that failed, when its needle was nearest to wall or shape; None of one that succeeded.
    """

    seed: int
    success: bool
    reason: str
    goals_met: int
    figures: RunFigures
    simulated_s: float
    last_instants: tuple[RunInstant, ...] = ()
    closest_instant: RunInstant | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values, in the unit that each name ends with."""
        outcome = {"seed": self.seed, "success": self.success, "reason": self.reason, "goals_met": self.goals_met}
        return {**outcome, **asdict(self.figures)}


def check_run(procedure: Procedure, setup: Setup, variation: Variation) -> None:
    """Refuse a procedure for which there is no way from where a run begins.

    Args:
        procedure: to run.
        setup: what the nodes believe.
        variation: the truth.

    Raises:
        ConfigurationError: it does not fit the scene.
        PlanningError: there is no way to a goal.
    """
    x, y, angle = variation.setup.rig.needle_start
    planner = setup.planner.planner(setup.scene, model=setup.model)
    planner.plan_all(procedure, *planner.pose(np.array([x, y]), np.array([math.cos(angle), math.sin(angle)])))


def run_procedure(
    procedure: Procedure,
    setup: Setup,
    variation: Variation,
    *,
    camera: bool = False,
    recorder: LoopRecorder | None = None,
) -> RunResult:
    """Run a procedure until it ends; return what came of it.

    Args:
        procedure: to run.
        setup: what the nodes believe.
        variation: the truth.
        camera: whether frames are rendered and tracked, else the tracker's noise is added to the truth.
        recorder: gets what the nodes would publish; None for nobody.

    Raises:
        ConfigurationError: the procedure does not fit the scene.
    """
    planner = setup.planner.planner(setup.scene, setup.coils, setup.model)
    planner.check(procedure)
    pilot, rig = _Pilot(procedure, planner), Rig(variation.setup.rig, setup.scene)
    execution = pilot.executor
    late = {"losses": variation.losses, "latency": variation.latency}
    loop = ClosedLoop(setup, rig, pilot, variation.seed, camera=camera, recorder=recorder, **late)
    wraps = [goal for goal in procedure.goals if isinstance(goal, Wrap)]
    extremes = RunExtremes(planner, setup.scene, procedure.limits, wraps[0] if wraps else None)
    figures, truth_of_goals = extremes.figures, GoalTruth(procedure, setup.scene)
    began, replanned, weighted, way, before = math.nan, 0.0, 0.0, 0.0, 0.0
    pursued: tuple[int, BodyPath | None, float] = 0, None, 0.0  # goal, path, and what is left of it [m]
    reason = f"not done after {MAX_TIME:g} s"
    try:
        while rig.time < MAX_TIME:
            frame = loop.step()
            if frame is None:
                continue
            running, path = execution.state is executor.ProcedureState.RUNNING, execution.path
            goal = procedure.goals[execution.goal]
            is_planned = isinstance(goal, ThreadGoal) and not execution.is_tracking
            is_moving = running and not is_planned and not isinstance(goal, Wait)
            extremes.update(frame, is_moving, execution.goal, None if path is None else path.middles)
            middle, _ = planner.pose(frame.tail, np.array([math.cos(frame.heading), math.sin(frame.heading)]))
            met = execution.goal if execution.state is not executor.ProcedureState.DONE else len(procedure.goals)
            truth_of_goals.update(met, middle, frame.tail, frame.thread)
            if math.isnan(began) and running:
                began = frame.time
            last, known, left = pursued
            is_anew = path is not known and execution.goal == last and isinstance(procedure.goals[last], ThreadGoal)
            if is_anew and path is not None and known is not None:
                replanned += max(0.0, path.length - left) / procedure.limits[last].speed
            if execution.is_tracking and path is not None:
                pursued = execution.goal, path, path.length - execution.travel
            ahead = max(0.0, execution.travel - before)
            before = execution.travel
            way, weighted = way + ahead, weighted + ahead / frame.condition.slowdown
            fault = loop.bridge.latch.latched_reason  # after which the needle rests for good
            if fault or execution.state in executor.ENDED:
                reason = fault or execution.reason
                break
    except SolverError as error:
        reason = f"{type(error).__name__}: {error}"
    figures.time_s = rig.time - began if math.isfinite(began) else rig.time
    figures.ideal_time_s = (pilot.planned_duration + replanned) * (weighted / way if way > 0.0 else 1.0)
    reached = execution.state is executor.ProcedureState.DONE
    limits = figures.beyond_limits(setup.coils.keep_out).values()
    reasons = [*filter(None, [reason]), *truth_of_goals.failures(reached), *limits]
    met = len(procedure.goals) if reached else execution.goal
    instants, closest = extremes.last_instants() if reasons else (), extremes.closest if reasons else None
    words = "; ".join(reasons)
    return RunResult(variation.seed, not reasons, words, met, figures, rig.time, instants, closest)


class _Pilot:
    """Executes a procedure as the needle planner does: it is planned as a whole before it begins.

    Paths that are asked for later are ready as long after that as planning takes, counted by the states of the lattice
    that are looked at, so that a run is the same on any machine.

    Attributes:
        executor: of the procedure.
        planned_duration: of the paths that were planned before it began, at their goals' speeds [s]; 0 without a way.
    """

    def __init__(self, procedure: Procedure, planner: NeedlePlanner) -> None:
        self.executor = executor.ProcedureExecutor(procedure, planner, self._submit)
        self.planned_duration, self._now = 0.0, 0.0

    def __call__(self, stamp: float, tail: Vector, heading: Vector, thread: executor.ThreadCondition) -> Vector:
        """Return the motion of the needle, and begin as soon as the thread is known."""
        self._now, execution = stamp, self.executor
        if execution.state is executor.ProcedureState.READY and not thread.problem:
            try:
                pose = execution.planner.pose(tail, heading)
                paths = execution.planner.plan_all(execution.procedure, *pose, thread.vertices)
                self.planned_duration = planned_duration(execution.procedure, paths)
                execution.start(paths[0])
            except PlanningError as error:
                execution.abort(str(error))
        return self.executor.update(stamp, tail, heading, thread)

    def _submit(self, task: Callable[[], BodyPath]) -> executor.PendingPath:
        before = self.executor.planner.looked
        path = executor.plan_now(task)
        # A core of a laptop looks at 500,000 states a second.
        due = self._now + (self.executor.planner.looked - before) / 5e5
        return cast(executor.PendingPath, SimpleNamespace(done=lambda: self._now >= due - 1e-9, result=path.result))
