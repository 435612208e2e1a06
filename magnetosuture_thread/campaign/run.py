"""One run of a procedure in the closed loop, and what came of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from magnetosuture_thread.campaign.extremes import RunExtremes, RunInstant
from magnetosuture_thread.campaign.limits import RunFigures
from magnetosuture_thread.campaign.loop import ClosedLoop, LoopFrame, LoopRecorder, Vector
from magnetosuture_thread.campaign.variation import Variation
from magnetosuture_thread.errors import SolverError
from magnetosuture_thread.geometry.polyline import arc_lengths
from magnetosuture_thread.planning.executor import (
    ProcedureExecutor,
    ProcedureState,
    ThreadCondition,
)
from magnetosuture_thread.planning.path import BodyPath
from magnetosuture_thread.planning.pending import PendingPath, plan_now
from magnetosuture_thread.planning.planner import NeedlePlanner, PlanningError, chain
from magnetosuture_thread.planning.procedure import Procedure, Wrap
from magnetosuture_thread.rig.rig import Rig
from magnetosuture_thread.setups import Setup

MAX_TIME = 600.0  # s; of a run
PLANNING_TIME = 0.2  # s; in which a path is planned: 0.01 in the open, 0.5 through a gap and around a shape


@dataclass(frozen=True)
class RunResult:
    """What came of a run.

    Attributes:
        seed: of the run.
        success: whether all goals were reached, and all limits held.
        reason: why not; empty if so.
        reached: whether all goals were reached.
        goals_met: how many were.
        figures: of the run.
        simulated_s: simulated time that the run took, with the time before the procedure began.
        last_instants: of the last seconds of a run that failed, in order; empty of one that succeeded.
        closest_instant: of a run that failed, when its needle was nearest to wall or shape; None of one that succeeded.
    """

    seed: int
    success: bool
    reason: str
    reached: bool
    goals_met: int
    figures: RunFigures
    simulated_s: float
    last_instants: tuple[RunInstant, ...] = ()
    closest_instant: RunInstant | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values, in the unit that each name ends with."""
        found = {"seed": self.seed, "success": self.success, "reason": self.reason, "goals_met": self.goals_met}
        return {**found, **asdict(self.figures)}


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
    planner = _planner(setup)
    planner.plan_all(procedure, *planner.pose(np.array([x, y]), np.array([math.cos(angle), math.sin(angle)])))


def _planner(setup: Setup) -> NeedlePlanner:
    kinematics, settings = setup.coils.needle().kinematics, setup.coils
    clearance = settings.keep_out + settings.pose_margin
    return NeedlePlanner(setup.scene, kinematics, clearance, setup.model.thread_length, settings.coil_angles)


def run_procedure(
    procedure: Procedure,
    setup: Setup,
    variation: Variation,
    *,
    camera: bool = False,
    follower: bool = False,
    recorder: LoopRecorder | None = None,
) -> RunResult:
    """Run a procedure, or the path follower of the setup for comparison, until it ends; return what came of it.

    Args:
        procedure: to run.
        setup: what the nodes believe.
        variation: the truth.
        camera: whether frames are rendered and tracked, else the tracker's noise is added to the truth.
        follower: whether the setup's path follower commands in place of the procedure.
        recorder: gets what the nodes would publish; None for nobody.

    Raises:
        ConfigurationError: the procedure does not fit the scene.
    """
    planner = _planner(setup)
    planner.check(procedure)
    pilot, leader = _Pilot(procedure, planner), _Follower(setup) if follower else None
    executor = pilot.executor
    rig = Rig(variation.setup.rig, setup.scene)
    loop = ClosedLoop(
        setup,
        rig,
        pilot.compute_command if leader is None else leader.compute_command,
        variation.seed,
        camera=camera,
        losses=variation.losses,
        coil_gains=variation.coil_gains,
        recorder=recorder,
    )
    wraps = [goal for goal in procedure.goals if isinstance(goal, Wrap)]
    extremes = RunExtremes(planner, setup.scene, procedure.limits, wraps[0] if wraps else None)
    began, planned, weighted, way, before = math.nan, 0.0, 0.0, 0.0, 0.0
    reason = f"not done after {MAX_TIME:g} s"
    try:
        while rig.time < MAX_TIME:
            frame = loop.step()
            if frame is None:
                continue
            running = executor.state is ProcedureState.RUNNING or (leader is not None and rig.began < math.inf)
            extremes.update(frame, running, executor.goal, None if executor.path is None else executor.path.middles)
            if math.isnan(began) and running:
                began = frame.time
                planned = _planned_time(executor, frame) if leader is None else leader.ideal_time
            ahead = max(0.0, executor.travel - before)
            before = executor.travel
            way, weighted = way + ahead, weighted + ahead / frame.condition.slowdown
            if executor.state in (ProcedureState.DONE, ProcedureState.FAILED):
                reason = executor.reason
                break
            if leader is not None and leader.progress >= 1.0:
                reason = "the path of the follower, which knows no goals, has ended"
                break
    except SolverError as error:
        reason = f"{type(error).__name__}: {error}"
    figures = RunFigures(
        rig.time - began if math.isfinite(began) else rig.time,
        planned * (weighted / way if way > 0.0 else 1.0),
        extremes.clearance,
        extremes.penetration,
        extremes.rest,
        extremes.wrapped,
        extremes.tension,
        extremes.friction_nodes,
        extremes.tension_excess,
        extremes.friction_excess,
    )
    reached = executor.state is ProcedureState.DONE
    reasons = [*filter(None, [reason]), *figures.beyond_limits(setup.coils.keep_out).values()]
    return RunResult(
        variation.seed,
        not reasons,
        "; ".join(reasons),
        reached,
        len(procedure.goals) if reached else executor.goal,
        figures,
        rig.time,
        extremes.last_instants() if reasons else (),
        extremes.closest if reasons else None,
    )


def _planned_time(executor: ProcedureExecutor, frame: LoopFrame) -> float:
    """Return the time of the paths from here to the end at their goals' speeds [s]; 0, and end it, without a way."""
    heading = np.array([math.cos(frame.heading), math.sin(frame.heading)])
    try:
        paths = executor.plan(frame.tail, heading)
    except PlanningError as error:
        executor.abort(str(error))
        return 0.0
    time, index, procedure = 0.0, 0, executor.procedure
    for path in paths:  # one for the goals of each chain, whose limits are the same
        time += path.length / procedure.limits[index].speed
        index += len(chain(procedure, index))
    return time


@dataclass(frozen=True)
class _PlannedPath:
    """A path that is known after the time that planning takes."""

    path: PendingPath
    is_due: Callable[[], bool]

    def done(self) -> bool:
        return self.is_due()

    def result(self) -> BodyPath:
        return self.path.result()


class _Pilot:
    """Executes a procedure as the needle planner does: paths are ready `PLANNING_TIME` after they are asked for."""

    def __init__(self, procedure: Procedure, planner: NeedlePlanner) -> None:
        self.executor = ProcedureExecutor(procedure, planner, self._submit)
        self._now = 0.0

    def compute_command(self, stamp: float, tail: Vector, heading: Vector, thread: ThreadCondition) -> Vector:
        """Return the velocity of the tip, and begin as soon as the thread is known."""
        self._now = stamp
        if self.executor.state is ProcedureState.READY and not thread.problem:
            self.executor.start()
        return self.executor.update(stamp, tail, heading, thread).velocity

    def _submit(self, task: Callable[[], BodyPath]) -> PendingPath:
        due = self._now + PLANNING_TIME
        return _PlannedPath(plan_now(task), lambda: self._now >= due - 1e-9)


class _Follower:
    """Commands as the path follower of the setup, up to the end of its path."""

    def __init__(self, setup: Setup) -> None:
        self._follower, self.progress = setup.follower.follower(), 0.0
        points = np.reshape((*setup.rig.needle_start[:2], *setup.follower.waypoints), (-1, 2))
        self.ideal_time = float(arc_lengths(points)[-1]) / setup.follower.speed

    def compute_command(self, stamp: float, tail: Vector, heading: Vector, thread: ThreadCondition) -> Vector:
        """Return the velocity of the tip."""
        command = self._follower.compute_command(stamp, tail, heading)
        self.progress = command.progress
        return command.velocity
