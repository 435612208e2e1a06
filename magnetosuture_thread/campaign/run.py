"""One run of a procedure in the closed loop, and what came of it."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.campaign.loop import ClosedLoop, Controller, LoopFrame, Vector
from magnetosuture_thread.campaign.variation import Variation
from magnetosuture_thread.errors import SolverError
from magnetosuture_thread.planning.executor import ProcedureExecutor, ProcedureState, ThreadCondition
from magnetosuture_thread.planning.planner import NeedlePlanner, PlanningError
from magnetosuture_thread.planning.procedure import Procedure, Wrap
from magnetosuture_thread.rig.rig import Rig
from magnetosuture_thread.safety.barriers import measure
from magnetosuture_thread.safety.packed_scene import pack_scene
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.setups import Setup

MAX_TIME = 600.0  # s; of a run
MAX_SLOWNESS = 1.5  # times the ideal time
MAX_REST = 3.0  # s
REST_WAY = 5e-5  # m; of the tip, that a needle covers if it does not rest
KEEP_OUT_TOLERANCE = 5e-6  # m
PENETRATION_TOLERANCE = 1e-6  # m
LAST_FRAMES = 4.0  # s; that are kept for the report


@dataclass(frozen=True)
class RunResult:
    """What came of a run. All of it is of the simulated truth, none as measured or predicted.

    Attributes:
        seed: of the run.
        success: whether all goals were reached, and all limits held.
        reason: why not; empty if so.
        time_s: from the start of the procedure to its end.
        ideal_time_s: of the path planned at the start, at the allowed speed, slowed by friction as it was in the run.
        min_needle_clearance_m: of the needle's axis from wall and shapes.
        max_thread_penetration_m: of a node of the thread into wall or shapes.
        longest_rest_s: for which the needle did not move, while the procedure ran.
        wrap_degrees: that the thread swept at the most about the shape of the first wrap; 0 without one.
        max_tension_n: peak of the thread.
        max_friction_nodes: under friction at once, by the model.
        last_frames: the last seconds of a run that failed.
    """

    seed: int
    success: bool
    reason: str
    time_s: float
    ideal_time_s: float
    min_needle_clearance_m: float
    max_thread_penetration_m: float
    longest_rest_s: float
    wrap_degrees: float
    max_tension_n: float
    max_friction_nodes: int
    last_frames: tuple[LoopFrame, ...] = ()


class _Record:
    """Keeps the extremes of a run."""

    def __init__(self, planner: NeedlePlanner, scene: Scene, wrap: Wrap | None) -> None:
        self._planner, self._wrap, self._scene = planner, wrap, scene
        self._packed = pack_scene(scene)
        self.clearance, self.penetration, self.rest, self.wrapped = math.inf, 0.0, 0.0, 0.0
        self.tension, self.friction_nodes, self.over = 0.0, 0, ""
        self.last: deque[LoopFrame] = deque()
        self._anchor: tuple[float, float, float, float] | None = None

    def update(self, frame: LoopFrame, running: bool) -> None:
        """Take a frame."""
        heading = np.array([math.cos(frame.heading), math.sin(frame.heading)])
        middle, angle = self._planner.pose(frame.tail, heading)
        c, s = math.cos(angle), math.sin(angle)
        axis = self._planner.body @ np.array([[c, s], [-s, c]]) + middle
        self.clearance = min(self.clearance, self._distance(axis))
        self.penetration = max(self.penetration, -self._distance(frame.thread))
        self.tension = max(self.tension, frame.tension)
        self.friction_nodes = max(self.friction_nodes, frame.condition.friction_nodes)
        if self._wrap is not None:
            swept = math.degrees(self._planner.swept_by(self._wrap.around, frame.thread))
            self.wrapped = max(self.wrapped, abs(swept))
        at = (frame.time, float(middle[0]), float(middle[1]), self._planner.lever * angle)
        if not running or self._anchor is None or math.dist(at[1:], self._anchor[1:]) > REST_WAY:
            self._anchor = at
        self.rest = max(self.rest, frame.time - self._anchor[0])
        self.last.append(frame)
        while self.last[0].time < frame.time - LAST_FRAMES:
            self.last.popleft()

    def _distance(self, points: np.ndarray) -> float:
        shapes = len(self._packed.shapes)
        found, normal = np.empty((len(points), shapes)), np.empty((len(points), shapes, 2))
        measure(np.ascontiguousarray(points), self._packed, found, normal)
        wall = self._scene.dish.radius - float(np.hypot(points[:, 0], points[:, 1]).max())
        return min(wall, float(found.min(initial=math.inf)))


def run_procedure(
    procedure: Procedure, setup: Setup, variation: Variation, *, camera: bool = False, follower: bool = False
) -> RunResult:
    """Run a procedure, or the path follower of the setup for comparison, until it ends; return what came of it.

    Args:
        procedure: to run.
        setup: what the nodes believe.
        variation: the truth.
        camera: whether frames are rendered and tracked, else the tracker's noise is added to the truth.
        follower: whether the setup's path follower commands in place of the procedure.

    Raises:
        ConfigurationError: the procedure does not fit the scene.
    """
    kinematics, keep_out = setup.coils.needle().kinematics, setup.coils.keep_out
    planner = NeedlePlanner(setup.scene, kinematics, keep_out, setup.model.thread_length)
    planner.check(procedure)
    executor = ProcedureExecutor(procedure, planner)
    rig = Rig(variation.setup.rig, setup.scene)
    control = _follow(setup) if follower else _execute(executor)
    gains = variation.coil_gains
    loop = ClosedLoop(setup, rig, control, variation.seed, camera=camera, losses=variation.losses, coil_gains=gains)
    wraps = [goal for goal in procedure.goals if isinstance(goal, Wrap)]
    record = _Record(planner, setup.scene, wraps[0] if wraps else None)
    began, planned, weighted, way, before = math.nan, 0.0, 0.0, 0.0, 0.0
    reason = f"not done after {MAX_TIME:g} s"
    try:
        while rig.time < MAX_TIME:
            frame = loop.step()
            if frame is None:
                continue
            running = executor.state is ProcedureState.RUNNING or (follower and rig.began < math.inf)
            record.update(frame, running)
            if math.isnan(began) and running:
                began = frame.time
                planned = _planned_length(executor, frame)
            ahead = max(0.0, executor.travel - before)
            before = executor.travel
            way, weighted = way + ahead, weighted + ahead / frame.condition.slowdown
            if executor.state in (ProcedureState.DONE, ProcedureState.FAILED):
                reason = executor.reason
                break
    except SolverError as error:
        reason = f"{type(error).__name__}: {error}"
    time = rig.time - began if math.isfinite(began) else rig.time
    slowest = min(limits.speed for limits in procedure.limits)
    ideal = planned / slowest * (weighted / way if way > 0.0 else 1.0)
    tension = min(limits.tension for limits in procedure.limits)
    nodes = min(limits.friction_nodes for limits in procedure.limits)
    checks = (
        (record.clearance < keep_out - KEEP_OUT_TOLERANCE, f"needle at {1e3 * record.clearance:.3f} mm"),
        (record.penetration > PENETRATION_TOLERANCE, f"thread {1e6 * record.penetration:.1f} um in a shape"),
        (record.rest > MAX_REST, f"a rest of {record.rest:.1f} s"),
        (record.tension > tension, f"a tension of {record.tension:.2g} N"),
        (record.friction_nodes > nodes, f"{record.friction_nodes} nodes under friction"),
        (time > MAX_SLOWNESS * ideal, f"{time:.0f} s where {ideal:.0f} s are ideal"),
    )
    reasons = [*filter(None, [reason]), *(words for broken, words in checks if broken)]
    return RunResult(
        variation.seed,
        not reasons,
        "; ".join(reasons),
        time,
        ideal,
        record.clearance,
        record.penetration,
        record.rest,
        record.wrapped,
        record.tension,
        record.friction_nodes,
        () if not reasons else tuple(record.last),
    )


def _planned_length(executor: ProcedureExecutor, frame: LoopFrame) -> float:
    """Return the length of the paths from here to the end of the procedure; 0 where there is none [m]."""
    heading = np.array([math.cos(frame.heading), math.sin(frame.heading)])
    try:
        return sum(path.length for path in executor.plan(frame.tail, heading))
    except PlanningError:
        return 0.0


def _execute(executor: ProcedureExecutor) -> Controller:
    def control(stamp: float, tail: Vector, heading: Vector, thread: ThreadCondition) -> Vector:
        if executor.state is ProcedureState.READY and not thread.problem:
            executor.start()
        return executor.update(stamp, tail, heading, thread).velocity

    return control


def _follow(setup: Setup) -> Controller:
    follower = setup.follower.follower()
    return lambda stamp, tail, heading, thread: follower.compute_command(stamp, tail, heading).velocity
