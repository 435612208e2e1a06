"""The forecaster: rolls needle, safety filter and thread out over a horizon, one forecast or a batch of them."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from queue import Empty, SimpleQueue
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.arguments import bounded, checked_arguments
from magnetosuture_thread.errors import ConfigurationError, InvalidInputError
from magnetosuture_thread.forecast.drag import NeedleDrag
from magnetosuture_thread.forecast.forecast import WALL_NAME, Forecast
from magnetosuture_thread.forecast.rollout import roll_out
from magnetosuture_thread.forecast.rollout_data import (
    MarginBuffers,
    RolloutBuffers,
    RolloutModel,
    RolloutRecord,
    RolloutState,
)
from magnetosuture_thread.forecast.start import ForecastStart
from magnetosuture_thread.geometry.arrays import as_numbers, finite_array
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import Points, chain_inside, lay_behind_needle
from magnetosuture_thread.model.formulations import RodFormulation
from magnetosuture_thread.model.formulations.rod_step import ENDED, NO_ROOM, MotionBuffers
from magnetosuture_thread.model.formulations.step_buffers import StepBuffers
from magnetosuture_thread.model.margins import FrictionLaw
from magnetosuture_thread.model.prediction import NeedlePose, check_pose
from magnetosuture_thread.model.predictor import MAX_STEP_LENGTH, ThreadPredictor
from magnetosuture_thread.model.solvers import BandedSolver
from magnetosuture_thread.model.thread import Thread
from magnetosuture_thread.safety import NeedleSafetyFilter
from magnetosuture_thread.scene import Scene

Vector = NDArray[np.float64]
Controller = Callable[[float, Vector, Vector], Vector]
"""Velocity of the tip [m/s] for the time since the start [s], the needle's tail [m] and its heading, shapes (2,)."""

MAX_HORIZON = 60.0  # s
MAX_STEPS = 20_000
MAX_BATCH = 10_000
NO_FRICTION = np.array([-math.inf, 1.0, math.inf, 0.0])


class ThreadForecaster:
    """Forecasts thread and needle under commanded velocities.

        forecaster = ThreadForecaster(thread, scene, safety)
        forecast = forecaster.forecast(ForecastStart.of_predictor(predictor), velocity, horizon=3.0)
        forecast.first_contact, forecast.minima["obstacle"].value, forecast.rest_time

    A step is what the loop does in one of its periods: the commanded velocity is slowed by the thread's friction and
    filtered by the needle's safety filter at its pose, the needle follows the filtered velocity, exactly unless its
    drag is given, and the thread follows the needle by one step of the formulation `rod`, divided as `ThreadPredictor`
    divides it. So a forecast equals stepping `NeedleSafetyFilter`, `NeedleKinematics` and `ThreadPredictor` by hand,
    but for rounding; it is compiled from end to end. Where the structured solver does not get on with a step, the
    forecast ends there and says so, as no general solver is tried.

    Args:
        thread: the thread.
        scene: dish and shapes.
        safety: the needle's safety filter in the same scene; None for that of a needle without length.
        law: the friction law that slows the needle; None for none.
        friction_averaging: time over which the nodes' speeds are averaged for it [s].
        attachment_offset: where the thread is fixed, along the heading and to its left of the needle's tail [m].
        drag: of the needle, by which the thread's pull moves it; None for one that follows the filtered velocity
            exactly.
        step: duration of a step [s].
        margin_range: margins are computed of nodes that are closer to a shape or the wall than this [m].
        contact_tolerance: a node this close to a shape or the wall touches it [m].
        residual_tolerance: the largest scaled residual with which a solution is accepted.
        max_step: steps of the thread are no longer than this [s].
        max_substeps: but a step is divided into so many at the most.
        fixed_nodes: nodes that stay where they are.
        workers: threads of the processor for a batch; None for as many as there are.

    Attributes:
        thread, scene, safety, step: see the arguments.

    Raises:
        ConfigurationError: a number is out of bounds, the segments do not resolve the scene, the safety filter is of
            another scene, or it has barriers of a user, which compiled code does not know.
        InvalidInputError: a fixed node is none of the thread's.
    """

    @checked_arguments("forecaster")
    def __init__(
        self,
        thread: Thread,
        scene: Scene,
        safety: NeedleSafetyFilter | None = None,
        *,
        law: FrictionLaw | None = None,
        friction_averaging: Annotated[float, bounded("s", 0.0, 10.0)] = 0.0,
        attachment_offset: Annotated[Sequence[float], bounded("m", -0.1, 0.1, multiple=2)] = (),
        drag: NeedleDrag | None = None,
        step: Annotated[float, bounded("s", 1e-4, 1.0)] = 1.0 / 66.0,
        margin_range: float = 2e-3,
        contact_tolerance: float = 2e-6,
        residual_tolerance: float = 1e-6,
        max_step: float = 0.02,
        max_substeps: int = 200,
        fixed_nodes: Sequence[int] = (),
        workers: Annotated[int | None, bounded("", 1, 1024)] = None,
    ) -> None:
        safety = NeedleSafetyFilter(scene) if safety is None else safety
        if safety.scene.version != scene.version:
            expected = f"the forecast's own, {scene.version}"
            raise ConfigurationError("safety filter's scene", safety.scene.version, expected)
        if law is not None and law.threshold > margin_range:
            raise ConfigurationError(
                "margin_range", margin_range, f"at least the friction threshold {law.threshold:g} m"
            )
        self.thread, self.scene, self.safety, self.step = thread, scene, safety, step
        predictor = ThreadPredictor(
            thread,
            scene,
            margin_range=margin_range,
            contact_tolerance=contact_tolerance,
            residual_tolerance=residual_tolerance,
            max_step=max_step,
            max_substeps=max_substeps,
            fixed_nodes=fixed_nodes,
        )
        formulation = predictor.formulation
        assert isinstance(formulation, RodFormulation)
        self._formulation, self._drag = formulation, drag
        around = Workspace(
            scene.obstacles, margin_range + 0.5 * thread.diameter, wall_radius=scene.dish.radius
        )  # margins are of the thread's surface
        offset = np.zeros(2)
        offset[: len(attachment_offset)] = attachment_offset
        friction = NO_FRICTION
        if law is not None:
            friction = np.array([law.threshold, law.beta, law.stuck_speed, friction_averaging])
        self._slowed = RolloutModel(
            rod=formulation.rod,
            near=formulation.workspace.data,
            around=around.data,
            needle=safety.compiled_data(),
            offset=offset,
            prescribed=np.array([0, *predictor.fixed_nodes], np.int64),
            tolerance=float(residual_tolerance),
            max_step=float(max_step),
            max_way=MAX_STEP_LENGTH * thread.segment_length,
            max_substeps=int(max_substeps),
            contact_tolerance=float(contact_tolerance),
            friction=friction,
            drag=np.zeros(5) if drag is None else drag.numbers(thread),
        )
        unslowed = friction.copy()
        unslowed[1] = 1.0  # the factor of each node; which nodes are under friction stays
        self._unslowed = self._slowed._replace(friction=unslowed)
        self._workers = max(1, os.cpu_count() or 1) if workers is None else max(1, workers)
        self._room = 2 * (thread.segments + 1)  # for contacts
        self._buffers: SimpleQueue[RolloutBuffers] = SimpleQueue()
        self._pool: ThreadPoolExecutor | None = None
        self._names = (*scene.names, WALL_NAME)

    def warm_up(self) -> None:
        """Load the compiled code by a forecast of one step, wherever in the dish the needle has room."""
        east, chord = np.array([1.0, 0.0]), self.safety.kinematics.chord
        for radius in np.linspace(0.0, 0.9, 10) * self.scene.dish.radius:
            for angle in np.linspace(0.0, 2.0 * math.pi, 12, endpoint=False):
                tail = radius * np.array([math.cos(angle), math.sin(angle)]) - [0.5 * chord, 0.0]
                if self.safety.clearance(tail, east) <= 0.0:
                    continue
                pose = NeedlePose(0.0, tail, east)
                vertices = self._straight(pose)
                self.forecast(ForecastStart(pose, vertices), np.zeros(2), self.step)
                return

    def straight(self, pose: NeedlePose) -> ForecastStart:
        """Return the start of a thread at rest, straight behind the needle, and along the wall where that is near."""
        check_pose(pose)
        return ForecastStart(pose, self._straight(pose))

    def _straight(self, pose: NeedlePose) -> Points:
        fixed = self._attached(pose)
        radius = self.scene.dish.radius - 0.5 * self.thread.diameter
        path = lay_behind_needle(fixed, pose.heading, self.thread.length, radius)
        return chain_inside(path, self.thread.segments, self.thread.segment_length, radius)

    def forecast(
        self, start: ForecastStart, commands: Vector | Controller, horizon: float = 3.0, *, slowed: bool = True
    ) -> Forecast:
        """Return what happens from a start under a command.

        Args:
            start: of needle and thread.
            commands: velocity of the tip [m/s]: one that is held, shape (2,), one for each step, shape (k, 2), or a
                function of time, tail and heading that is asked before every step, as a path follower.
            horizon: a whole number of steps to the nearest [s].
            slowed: whether the friction law slows the commands; see `friction_feedback` of the coil bridge.

        Raises:
            InvalidInputError: start or commands are not finite or of another shape, the needle is inside of a shape or
                the wall, or the horizon is not between a step and `MAX_HORIZON`.
        """
        steps = self._steps(horizon)
        self._check_start(start)
        buffers = self._take_buffers()
        try:
            if callable(commands):
                return self._controlled(start, commands, steps, buffers, slowed)
            return self._held(start, self._sequence(commands, steps), steps, buffers, slowed)
        finally:
            self._buffers.put(buffers)

    def forecasts(
        self,
        start: ForecastStart | Sequence[ForecastStart],
        commands: Sequence[Vector] | Vector,
        horizon: float = 3.0,
        *,
        slowed: bool = True,
    ) -> list[Forecast]:
        """Return a batch of forecasts, on all cores: each is equal to what `forecast` returns.

        Args:
            start: of all, or one for each.
            commands: of each: velocities to hold, shape (m, 2), or sequences, shape (m, k, 2) [m/s].
            horizon: of all [s].
            slowed: whether the friction law slows the commands.

        Raises:
            InvalidInputError: see `forecast`; or there are more than `MAX_BATCH`, or as many starts as not commands.
        """
        steps = self._steps(horizon)
        count = len(commands)
        if not 0 < count <= MAX_BATCH:
            raise InvalidInputError("commands", f"{count} of them", f"1 to {MAX_BATCH}")
        starts = [start] * count if isinstance(start, ForecastStart) else list(start)
        if len(starts) != count:
            raise InvalidInputError("starts", f"{len(starts)} of them", f"{count}, one for each command")
        for each in {id(each): each for each in starts}.values():
            self._check_start(each)
        sequences = [self._sequence(command, steps) for command in commands]

        def work(index: int) -> Forecast:
            buffers = self._take_buffers()
            try:
                return self._held(starts[index], sequences[index], steps, buffers, slowed)
            finally:
                self._buffers.put(buffers)

        if min(self._workers, count) == 1:
            return [work(index) for index in range(count)]
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self._workers, "forecast")
        return list(self._pool.map(work, range(count)))

    def _held(
        self, start: ForecastStart, commands: Points, steps: int, buffers: RolloutBuffers, slowed: bool
    ) -> Forecast:
        model = self._model(start, slowed)
        while True:
            state, record = self._begin(start, buffers), self._record(steps)
            self._set_force(start, record)
            code, done = roll_out(model, buffers, state, commands, self.step, 0, steps, record)
            if code != NO_ROOM:
                return self._result(start, record, commands, code, done)
            self._room = max(self._room, 2 * len(buffers.step.node))
            buffers = self._make_buffers()

    def _controlled(
        self, start: ForecastStart, controller: Controller, steps: int, buffers: RolloutBuffers, slowed: bool
    ) -> Forecast:
        model = self._model(start, slowed)
        state, record, commands = self._begin(start, buffers), self._record(steps), np.zeros((steps, 2))
        self._set_force(start, record)
        code, done = ENDED, 0
        while done < steps and code == ENDED:
            tail, heading = state.pose[:2].copy(), state.pose[2:].copy()
            velocity = np.asarray(controller(done * self.step, tail, heading), np.float64)
            if velocity.shape != (2,) or not np.isfinite(velocity).all():
                raise InvalidInputError("controller's command", velocity.tolist(), "two finite numbers [m/s]")
            commands[done] = velocity
            code, done = roll_out(model, buffers, state, commands, self.step, done, done + 1, record)
        if code == NO_ROOM:  # a controller may remember, so it is not asked again: the commands so far are repeated
            forecast = self._held(start, commands[: done + 1], done + 1, buffers, slowed)
            return replace(forecast, problem=f"more than {len(buffers.contacts.node)} contacts at once")
        return self._result(start, record, commands, code, done)

    def _model(self, start: ForecastStart, slowed: bool) -> RolloutModel:
        """Return the constants of a forecast that starts with this thread."""
        model, thread = self._slowed if slowed else self._unslowed, start.thread
        if thread is None or thread is self.thread:
            return model
        model = model._replace(rod=self._formulation.rod_of(thread))
        return model if self._drag is None else model._replace(drag=self._drag.numbers(self.thread, thread))

    def _result(self, start: ForecastStart, record: RolloutRecord, commands: Points, code: int, done: int) -> Forecast:
        problem = "" if code == ENDED else f"the step at {done * self.step:.3f} s has no solution within the tolerance"
        return Forecast.of(
            record,
            done,
            stamp=start.pose.stamp,
            interval=self.step,
            commanded=commands,
            problem=problem,
            shapes=self._names,
            scene_version=self.scene.version,
        )

    def _begin(self, start: ForecastStart, buffers: RolloutBuffers) -> RolloutState:
        """Return the state at the start, with the buffers as the step before it left them."""
        step = buffers.step
        step.forget()
        if start.warm_start is not None and start.interval > 0.0:
            multipliers, push, shapes, grip = start.warm_start
            step.multipliers[: len(multipliers)] = multipliers
            step.push[:], step.grip_shape[:], step.grip[:] = push, shapes, grip
        vertices = np.array(start.vertices, np.float64, order="C")
        velocities = np.zeros_like(vertices) if start.velocities is None else np.array(start.velocities, np.float64)
        heading = np.asarray(start.pose.heading, np.float64)
        pulled = self._slowed.drag[0] > 0.0 and start.needle_force is not None
        x, y = (math.nan, math.nan) if start.tip_velocity is None else np.asarray(start.tip_velocity).tolist()
        return RolloutState(
            vertices,
            np.ascontiguousarray(velocities),
            np.zeros_like(vertices),
            np.concatenate([np.asarray(start.pose.tail, np.float64), heading / np.linalg.norm(heading)]),
            np.array([x, y, start.interval]),
            np.full(3, math.nan if pulled else 0.0),  # what is no number is worked out from the force
        )

    def _set_force(self, start: ForecastStart, record: RolloutRecord) -> None:
        if start.needle_force is not None:
            record.pull[0] = start.needle_force

    def _record(self, steps: int) -> RolloutRecord:
        return RolloutRecord.of(steps, self.thread.segments + 1, len(self.scene.shapes))

    def _take_buffers(self) -> RolloutBuffers:
        with suppress(Empty):
            while True:
                buffers = self._buffers.get_nowait()
                if len(buffers.step.node) >= self._room:
                    return buffers
        return self._make_buffers()

    def _make_buffers(self) -> RolloutBuffers:
        segments, contacts = self.thread.segments, self._room
        step = StepBuffers.of(segments + 1, 2, segments, contacts)
        solver = BandedSolver().buffers(segments + 1, 2, len(step.first))
        return RolloutBuffers(step, solver, MotionBuffers.of(segments + 1, 2), MarginBuffers.of(4 * contacts))

    def _steps(self, horizon: float) -> int:
        if not bounded("s", 0.5 * self.step, MAX_HORIZON).within(horizon):
            raise InvalidInputError("horizon", horizon, f"a time from one step, {self.step:g} s, to {MAX_HORIZON:g} s")
        steps = max(1, round(horizon / self.step))
        if steps > MAX_STEPS:
            raise InvalidInputError("horizon", f"{steps} steps", f"at most {MAX_STEPS} steps of {self.step:g} s")
        return steps

    def _sequence(self, commands: Vector, steps: int) -> Points:
        """Return a velocity for each step."""
        given = as_numbers("commands", commands)
        given = finite_array("commands", given, (2,) if given.ndim == 1 else (steps, 2), bounded("m/s"))
        # A copy, as views of broadcasts are read-only, which is another type for compiled code.
        return np.array(np.broadcast_to(given, (steps, 2)), order="C")

    def _attached(self, pose: NeedlePose) -> Vector:
        (x, y), (along, left) = pose.heading, self._slowed.offset
        return np.asarray(pose.tail + np.array([along * x - left * y, along * y + left * x]))

    def _check_start(self, start: ForecastStart) -> None:
        pose, nodes = start.pose, (self.thread.segments + 1, 2)
        check_pose(pose)
        finite_array("thread's nodes", start.vertices, nodes, bounded("m", -10.0, 10.0))
        if start.velocities is not None:
            finite_array("thread's velocities", start.velocities, nodes, bounded("m/s", -10.0, 10.0))
        own, given = self.thread, start.thread or self.thread
        fixed = ("length", "segments", "diameter", "attachment")
        if any(getattr(given, name) != getattr(own, name) for name in fixed):
            raise InvalidInputError("thread of the start", given, f"one like {own} in {', '.join(fixed)}")
        gap, unit = float(np.linalg.norm(start.vertices[0] - self._attached(pose))), self.thread.segment_length
        if gap > unit:
            wanted = f"at most {unit:.2e} m"
            raise InvalidInputError("thread's first node", f"{gap:.2e} m from where it is fixed", wanted)
        for name, pair in (("tip velocity", start.tip_velocity), ("needle force", start.needle_force)):
            if pair is not None:
                finite_array(f"{name} of the start", pair, (2,), bounded())
        clearance = self.safety.clearance(pose.tail, pose.heading)
        if clearance <= 0.0:
            raise InvalidInputError("needle pose", f"{-clearance:.2e} m inside of a shape or the wall", "one outside")
