"""The forecaster: rolls needle, safety filter and thread out over a horizon; where it starts, and its result."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any

import numpy as np

from magnetosuture_thread.coils.filter import NeedleSafetyFilter
from magnetosuture_thread.estimator.estimator import ThreadEstimate
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.forecast.rollout import (
    KINDS,
    NEEDLE_MARGIN,
    OBSTACLE_MARGIN,
    WALL_MARGIN,
    DragData,
    least_margins,
    nodes_under_friction,
    step_needle,
)
from magnetosuture_thread.geometry.compiled import TypedKernel
from magnetosuture_thread.geometry.obstacles import Contacts, Workspace
from magnetosuture_thread.geometry.polyline import (
    Indices,
    Mask,
    Points,
    Vector,
    as_numbers,
    chain_inside,
    finite_array,
    lay_behind_needle,
)
from magnetosuture_thread.geometry.scene import WALL_NAME, Scene
from magnetosuture_thread.settings.configuration import bounded, checked_arguments
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError
from magnetosuture_thread.thread.margins import FrictionLaw
from magnetosuture_thread.thread.material import Thread
from magnetosuture_thread.thread.prediction import NeedlePose, check_pose
from magnetosuture_thread.thread.predictor import PredictorOptions, ThreadPredictor
from magnetosuture_thread.thread.program import CONTACTS_PER_NODE, NO_SHAPE
from magnetosuture_thread.thread.rod import ENDED, NO_ROOM, RodFormulation, StepInput
from magnetosuture_thread.thread.step import WarmStart

Controller = Callable[[float, Vector, Vector], Vector]
"""Velocity of the tip [m/s] for the time since the start [s], the needle's tail [m] and its heading, shapes (2,)."""

MAX_HORIZON = 60.0  # s


@checked_arguments("forecast start", InvalidInputError)
@dataclass(frozen=True, eq=False)
class ForecastStart:
    """Needle and thread at the start of a forecast.

    Attributes:
        pose: of the needle's tail.
        vertices: of the thread, shape (n + 1, 2) [m].
        velocities: of the thread's nodes over the last step, shape (n + 1, 2) [m/s]; None for a thread at rest.
        interval: duration of that step; 0 if there was none [s].
        tip_velocity: filtered velocity of the tip before the start, shape (2,) [m/s], from which the acceleration is
            limited; None if it is not known, and then the first change is not limited.
        needle_force: of the thread upon the needle, shape (2,) [N], from which a needle with drag goes on; None if it
            is not known.
        warm_start: of the formulation, which brings friction that holds already; None for none.
    """

    pose: NeedlePose
    vertices: Points
    velocities: Points | None = None
    interval: Annotated[float, bounded("s", 0.0, 10.0)] = 0.0
    tip_velocity: Vector | None = None
    warm_start: WarmStart | None = None
    needle_force: Vector | None = None

    @classmethod
    def of_estimate(
        cls, estimate: ThreadEstimate, pose: NeedlePose, tip_velocity: Vector | None = None
    ) -> ForecastStart:
        """Return the start from an estimate.

        Args:
            estimate: of the thread.
            pose: of the needle's tail.
            tip_velocity: see the attributes.
        """
        forces = estimate.prediction.forces
        needle_force = None if forces is None else forces.needle_force
        return cls(pose, estimate.positions, tip_velocity=tip_velocity, needle_force=needle_force)

    @classmethod
    def of_predictor(
        cls,
        predictor: ThreadPredictor,
        pose: NeedlePose | None = None,
        tip_velocity: Vector | None = None,
        needle_force: Vector | None = None,
    ) -> ForecastStart:
        """Return the start from where a predictor is.

        Args:
            predictor: that has started.
            pose: of the needle's tail, where the thread is not fixed to that.
            tip_velocity: see the attributes.
            needle_force: see the attributes.

        Raises:
            InvalidInputError: it has not started.
        """
        if predictor.state is None or predictor.pose is None:
            raise InvalidInputError("predictor", "one before its start", "one that has started")
        state, pose = predictor.state, predictor.pose if pose is None else pose
        warm_start = predictor.formulation.warm_start() if state.interval > 0.0 else None
        return cls(pose, state.positions, state.velocities, state.interval, tip_velocity, warm_start, needle_force)


@dataclass(frozen=True)
class ForecastMargin:
    """The least margin of one kind over a forecast.

    Attributes:
        value: a distance [m], inf where nothing comes near: the clearance of the thread's surface from shapes or wall,
            that of nodes and half segments as in `Margins`;
            a segment's length that is left until it is taut, or until it is pressed together; the distance of the
            needle's axis from shapes and wall, less `keep_out`.
        time: since the start of the forecast [s].
        node: of the thread, 0 for the needle.
        shape: name of the shape, "wall", or empty.
    """

    value: float
    time: float
    node: int
    shape: str


@dataclass(frozen=True)
class ForecastContact:
    """When the thread first touches something.

    Attributes:
        time: since the start of the forecast, 0 where it touches already [s].
        node: of the thread that touches, or the first of a segment's two.
        shape: name of the shape, or "wall".
    """

    time: float
    node: int
    shape: str


@dataclass(frozen=True, eq=False)
class Forecast:
    """Needle and thread over a horizon of k steps, at k + 1 instants; fewer where a step has no solution.

    Attributes:
        stamp: of the needle's pose at the start [s].
        times: since then, shape (k + 1,) [s].
        vertices: of the thread, shape (k + 1, n + 1, 2) [m].
        tails: of the needle, shape (k + 1, 2) [m].
        headings: of the needle at its tail, unit vectors, shape (k + 1, 2).
        commanded: velocity of the tip in each step, shape (k, 2) [m/s].
        filtered: what the thread's friction and the safety filter leave of it, shape (k, 2) [m/s].
        slowdown: by the thread's friction in each step, shape (k,).
        margins: least margin of each kind at each instant, shape (k + 1,) [m], by "obstacle", "wall", "connectivity",
            "compression" and "needle"; see `ForecastMargin`.
        friction: nodes under friction at each instant, shape (k + 1, n + 1); see `FrictionLaw`.
        tension: greatest of all segments at each instant, 0 at the first, shape (k + 1,) [N].
        needle_force: of the thread upon the needle, 0 at the first instant, shape (k + 1, 2) [N].
        converged: whether every step ended where the barriers themselves hold.
        problem: why the forecast ends before its horizon; empty if it does not.
        shapes: names of the scene's shapes, then "wall".
        scene_version: of the scene; empty where there is none.
        margin_nodes: where the margins are, shape (k + 1, 5), in the order of the margins.
        margin_shapes: and of which shape, an index of `shapes`.
        contact_tolerance: the thread touches a shape or the wall to which it is this close [m].
        touched: shapes that changed the filtered velocity in each step, shape (k, s + 1).
    """

    stamp: float
    times: Vector
    vertices: Vector
    tails: Points
    headings: Points
    commanded: Points
    filtered: Points
    slowdown: Vector
    margins: dict[str, Vector]
    friction: Mask
    tension: Vector
    needle_force: Points
    converged: bool
    problem: str
    shapes: tuple[str, ...]
    scene_version: str
    margin_nodes: Indices = field(repr=False)
    margin_shapes: Indices = field(repr=False)
    contact_tolerance: float
    touched: Mask = field(repr=False)

    @property
    def horizon(self) -> float:
        """Time that is covered [s]."""
        return float(self.times[-1])

    @cached_property
    def minima(self) -> dict[str, ForecastMargin]:
        """The least margin of each kind over the horizon, by the kind's name."""
        return {name: self._margin(kind, int(self.margins[name].argmin())) for kind, name in enumerate(KINDS)}

    def _margin(self, kind: int, instant: int) -> ForecastMargin:
        """Return the margin of a kind at an instant."""
        node, shape = int(self.margin_nodes[instant, kind]), int(self.margin_shapes[instant, kind])
        name = self.shapes[shape] if shape != NO_SHAPE else ""
        return ForecastMargin(float(self.margins[KINDS[kind]][instant]), float(self.times[instant]), node, name)

    @cached_property
    def friction_nodes(self) -> tuple[int, ...]:
        """Nodes that are under friction at any time, rising."""
        return tuple(np.flatnonzero(self.friction.any(axis=0)).tolist())

    @cached_property
    def first_friction(self) -> float | None:
        """When the first node is under friction [s]; None if none is."""
        found = np.flatnonzero(self.friction.any(axis=1))
        return float(self.times[found[0]]) if len(found) else None

    @property
    def peak_tension(self) -> float:
        """The greatest tension of all segments and instants [N]."""
        return float(self.tension.max())

    @property
    def peak_needle_force(self) -> float:
        """The greatest pull of the thread upon the needle [N]."""
        return float(np.hypot(self.needle_force[:, 0], self.needle_force[:, 1]).max())

    @cached_property
    def first_contact(self) -> ForecastContact | None:
        """When the thread first touches a shape or the wall, and which; None if it does not."""
        both = np.array([self.margins[KINDS[kind]] for kind in (OBSTACLE_MARGIN, WALL_MARGIN)])
        touches = np.flatnonzero(both.min(axis=0) <= self.contact_tolerance)
        if not len(touches):
            return None
        instant = int(touches[0])
        margin = self._margin((OBSTACLE_MARGIN, WALL_MARGIN)[int(both[:, instant].argmin())], instant)
        return ForecastContact(margin.time, margin.node, margin.shape)

    @cached_property
    def rest_time(self) -> float | None:
        """When the needle comes to rest, to stay so until the end although it is commanded to move [s]; else None."""
        rests = (self.filtered == 0.0).all(axis=1) & (self.commanded != 0.0).any(axis=1)
        moves = np.flatnonzero(~rests)
        first = int(moves[-1]) + 1 if len(moves) else 0
        return float(self.times[first]) if first < len(rests) else None

    @property
    def stopped_by(self) -> tuple[str, ...]:
        """Names of the shapes, and "wall", at which it comes to rest; empty if it does not."""
        if self.rest_time is None:
            return ()
        return tuple(name for name, active in zip(self.shapes, self.touched[-1].tolist(), strict=True) if active)


@checked_arguments("needle drag")
@dataclass(frozen=True)
class NeedleDrag:
    """The needle's drag, by which the thread's pull moves it.

    Coils allocated for a velocity v of the tip give the needle a force along its chord and a torque. With the force F
    of the thread at its tail, the unit vector e from tail to tip, n to its left, and the chord l, the needle moves with

        u = (along v . e + F . e) / (along - thread),    w = F . n / across
        omega = (v . n) / (l / 2) - (l / 2) (F . n) / turning

    where `along` has, as that of the coil bridge, the drag `thread` of a straight thread behind the needle: with that
    thread u = v . e. Source: none; force and torque balance without inertia. Deviation: the moment of a clamped thread
    is left out; and the pull moves the needle no faster than the filtered velocity times the share of the commanded one
    that this is, as a needle that the barriers hold back leans on what they keep it from.

    Attributes:
        along: drag along the needle, that of a straight thread included [N s/m].
        across: drag across it [N s/m].
        turning: torque at 1 rad/s [N m s].
        thread: part of `along` that the thread adds; None for all of its drag along itself [N s/m].

    Raises:
        ConfigurationError: a number is not positive, or the thread's part is not less than the whole.
    """

    along: Annotated[float, bounded("N s/m", 1e-15)]
    across: Annotated[float, bounded("N s/m", 1e-15)]
    turning: Annotated[float, bounded("N m s", 1e-20)]
    thread: float | None = None

    def data(self, thread: Thread) -> DragData:
        """Return it for compiled code.

        Args:
            thread: that is driven, with which `along` was measured.

        Raises:
            ConfigurationError: the thread's part is not less than the whole.
        """
        part = thread.medium.drag_along * thread.length if self.thread is None else self.thread
        if not 0.0 <= part < self.along:
            raise ConfigurationError("needle drag along", self.along, f"more than the thread's part, {part:g} N s/m")
        whole = thread.medium.drag_across * thread.length
        return DragData(*map(float, (self.along, self.along - part, self.across, self.turning, whole)))


class _ThreadWalk:
    """The thread of one forecast, a step after the other.

    Attributes:
        positions: of all nodes, shape (n + 1, 2) [m].
        converged: whether every step ended where the barriers themselves hold.
    """

    def __init__(
        self, formulation: RodFormulation, start: ForecastStart, nodes: Indices, options: PredictorOptions
    ) -> None:
        self._formulation, self._nodes, self._options = formulation.separate(), nodes, options
        if start.warm_start is not None and start.interval > 0.0:
            self._formulation.restore(start.warm_start)
        still = np.zeros_like(start.vertices) if start.velocities is None else start.velocities
        self.positions, self._velocities = np.array([start.vertices, still], np.float64)
        self._ends, self._interval, self.converged = self.positions[nodes], float(start.interval), True

    def step(self, tail: Vector, before: Vector, heading: Vector, interval: float) -> str:
        """Follow the point where the thread is fixed, in as many steps as `ThreadPredictor`; return what fails.

        Args:
            tail: where that point is after the step, shape (2,) [m].
            before: heading of the needle before it, shape (2,).
            heading: and after it.
            interval: duration [s].
        """
        begin, end, formulation = self.positions[0].copy(), self._ends.copy(), self._formulation
        end[0] = tail
        count = self._options.substeps(interval, math.dist(begin.tolist(), tail.tolist()) / formulation.rod.unit)
        ends, mixed = end, heading
        for index in range(1, count + 1):
            if count > 1:
                part, ends = index / count, end.copy()
                ends[0] = begin + part * (tail - begin)
                mixed = (1.0 - part) * before + part * heading
                size = math.hypot(*mixed.tolist())
                mixed = mixed / size if size > 1e-6 else heading
            moved = self._nodes, ends, mixed, interval / count, self._interval
            progress = formulation.solve(StepInput(self.positions, self._velocities, *moved))
            if progress.code != ENDED:
                self.converged = False
                room = f"more than {CONTACTS_PER_NODE * len(self.positions)} contacts at once"
                return room if progress.code == NO_ROOM else "a step has no solution within the tolerance"
            (self.positions, self._velocities), self._interval = formulation.buffers.end[:2], interval / count
            self.converged = self.converged and progress.off <= 1.0
        return ""

    def write_forces(self, heading: Vector, tension: Vector, pull: Vector) -> None:
        """Write the tension of each segment and the thread's pull upon the needle [N]."""
        buffers = self._formulation.buffers
        self._formulation.write_forces((buffers.end, buffers.tail_load), self._interval, heading, tension, pull)


class ThreadForecaster:
    """Forecasts thread and needle under commanded velocities.

        forecaster = ThreadForecaster(thread, scene, safety)
        forecast = forecaster.forecast(ForecastStart.of_predictor(predictor), velocity, horizon=3.0)
        forecast.first_contact, forecast.minima["obstacle"].value, forecast.rest_time

    A step is what the loop does in one of its periods: the commanded velocity is slowed by the thread's friction and
    filtered by the needle's safety filter at its pose, the needle follows the filtered velocity, exactly unless its
    drag is given, and the thread follows the needle by one step of the formulation `rod`, divided as `ThreadPredictor`
    divides it. So a forecast equals stepping `NeedleSafetyFilter`, `NeedleKinematics` and `ThreadPredictor` by hand,
    but for rounding. Where the structured solver does not get on with a step, the forecast ends there and says so, as
    no general solver is tried. Several threads may forecast at once.

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
        fixed_nodes: nodes that stay where they are.
        options: by name, see `PredictorOptions`; `margin_range` is 2 mm by default.

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
        fixed_nodes: Sequence[int] = (),
        **options: object,
    ) -> None:
        safety = NeedleSafetyFilter(scene) if safety is None else safety
        if safety.scene.version != scene.version:
            expected = f"the forecast's own, {scene.version}"
            raise ConfigurationError("safety filter's scene", safety.scene.version, expected)
        numbers: dict[str, Any] = {"margin_range": 2e-3, **options}
        predictor = ThreadPredictor(thread, scene, fixed_nodes=fixed_nodes, **numbers)
        self.options, formulation = predictor.options, predictor.formulation
        assert isinstance(formulation, RodFormulation)
        if law is not None and law.threshold > self.options.margin_range:
            expected = f"at least the friction threshold {law.threshold:g} m"
            raise ConfigurationError("margin_range", self.options.margin_range, expected)
        self.thread, self.scene, self.safety, self.step = thread, scene, safety, float(step)
        self._formulation, self._law, self._averaging = formulation, law, float(friction_averaging)
        self._needle, self._drag = safety.compiled_data(), DragData() if drag is None else drag.data(thread)
        self._offset, self._nodes = tuple(attachment_offset), np.array([0, *predictor.fixed_nodes], np.int64)
        reach = self.options.margin_range + 0.5 * thread.diameter  # margins are of the thread's surface
        self._around = Workspace(scene.obstacles, reach, wall_radius=scene.dish.radius).data
        self._step_needle, self._friction_nodes = TypedKernel(step_needle), TypedKernel(nodes_under_friction)
        self._names = (*scene.names, WALL_NAME)

    def warm_up(self) -> None:
        """Load the compiled code, by a forecast of one step in the bare dish."""
        scene, reach = Scene(self.scene.dish), self.options.margin_range
        bare = ThreadForecaster(self.thread, scene, law=self._law, step=self.step, margin_range=reach)
        middle = NeedlePose(0.0, np.zeros(2), np.array([1.0, 0.0]))
        bare.forecast(bare.straight(middle), np.zeros(2), self.step)

    def straight(self, pose: NeedlePose) -> ForecastStart:
        """Return the start of a thread at rest, straight behind the needle, and along the wall where that is near."""
        check_pose(pose)
        radius = self.scene.dish.radius - 0.5 * self.thread.diameter
        path = lay_behind_needle(self._attached(pose.tail, pose.heading), pose.heading, self.thread.length, radius)
        return ForecastStart(pose, chain_inside(path, self.thread.segments, self.thread.segment_length, radius))

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
        steps, interval = self._steps(horizon), self.step
        self._check_start(start)
        sequence = np.zeros((steps, 2)) if callable(commands) else self._sequence(commands, steps)
        nodes, instants, drag = self.thread.segments + 1, steps + 1, self._drag
        walk, friction = _ThreadWalk(self._formulation, start, self._nodes, self.options), self._friction(start, slowed)
        heading = np.asarray(start.pose.heading, np.float64)
        pose = np.concatenate([np.asarray(start.pose.tail, np.float64), heading / np.linalg.norm(heading)])
        last = np.array([math.nan, math.nan] if start.tip_velocity is None else start.tip_velocity, np.float64)
        vertices, poses, filtered = np.empty((instants, nodes, 2)), np.empty((instants, 4)), np.zeros((steps, 2))
        slowdown, rubbed = np.ones(instants), np.zeros((instants, nodes), np.bool_)
        tension, pull = np.zeros((instants, nodes - 1)), np.zeros((instants, 2))
        touched = np.zeros((instants, len(self._names)), np.bool_)
        kinds = instants, len(KINDS)
        margin, margin_nodes = np.full(kinds, np.inf), np.zeros(kinds, np.int64)
        margin_shapes = np.full(kinds, NO_SHAPE)
        added, known = np.zeros(3), start.needle_force is not None
        if start.needle_force is not None:
            pull[0] = start.needle_force
            added[:] = math.nan if drag.along > 0.0 else 0.0  # what is no number is worked out from the force
        problem, done = "", 0
        for k in range(instants):
            vertices[k], poses[k] = walk.positions, pose
            slowdown[k] = friction(vertices[k], rubbed[k])
            if k < steps and callable(commands):
                velocity = commands(k * interval, pose[:2].copy(), pose[2:].copy())
                sequence[k] = finite_array("controller's command", velocity, (2,), bounded("m/s"))
            command = tuple(sequence[k].tolist() if k < steps else (0.0, 0.0))
            pulled = drag if k > 0 or known else DragData()
            moved = command, float(slowdown[k]), interval, last, pull[k], added, touched[k]
            least = self._step_needle(self._needle, pulled, pose, *moved)
            margin[k, NEEDLE_MARGIN], margin_shapes[k, NEEDLE_MARGIN] = least
            if k == steps:
                break
            filtered[k] = last
            if problem := walk.step(self._attached(pose[:2], pose[2:]), poses[k, 2:], pose[2:], interval):
                problem = f"{problem} at {k * interval:.3f} s"
                break
            walk.write_forces(pose[2:], tension[k + 1], pull[k + 1])
            done = k + 1
        instants = done + 1
        memory = self._contacts(), np.empty((nodes, 2)), np.empty((6, nodes - 1))
        walked = self._formulation.rod, self._around, vertices[:instants], poses[:instants, 2:].copy()
        if not least_margins(*walked, *memory, margin, margin_nodes, margin_shapes):
            raise InvalidInputError("scene", "more contacts than there is memory for", "fewer shapes")
        return Forecast(
            stamp=start.pose.stamp,
            times=interval * np.arange(float(instants)),
            vertices=vertices[:instants],
            tails=poses[:instants, :2],
            headings=poses[:instants, 2:],
            commanded=sequence[:done],
            filtered=filtered[:done],
            slowdown=slowdown[:done],
            margins={name: margin[:instants, kind] for kind, name in enumerate(KINDS)},
            friction=rubbed[:instants],
            tension=tension[:instants].max(axis=1),
            needle_force=pull[:instants],
            converged=walk.converged,
            problem=problem,
            shapes=self._names,
            scene_version=self.scene.version,
            margin_nodes=margin_nodes,
            margin_shapes=margin_shapes,
            contact_tolerance=self.options.contact_tolerance,
            touched=touched[:done],
        )

    def _friction(self, start: ForecastStart, slowed: bool) -> Callable[[Points, Mask], float]:
        """Return the friction law over one forecast: it writes the nodes under friction, and returns the slowdown."""
        law, nodes, averaging = self._law, self.thread.segments + 1, self._averaging
        if law is None:
            return lambda vertices, rubbed: 1.0
        last, velocities = np.array([start.vertices, np.zeros((nodes, 2))], np.float64)
        share = 1.0 - math.exp(-self.step / averaging) if averaging > 0.0 else 1.0
        memory = last, velocities, share, self.step, self._around, law.threshold + 0.5 * self.thread.diameter
        contacts, close = self._contacts(), np.zeros(nodes, np.int64)

        def slowdown(vertices: Points, rubbed: Mask) -> float:
            count, fastest = self._friction_nodes(vertices, *memory, contacts, close, rubbed)
            return law.beta**count if count and slowed and fastest > law.stuck_speed else 1.0

        return slowdown

    def _contacts(self) -> Contacts:
        """Return memory for all contacts of the thread's nodes."""
        return Contacts.room((CONTACTS_PER_NODE + 2 * len(self.scene.shapes)) * (self.thread.segments + 1), 2)

    def _steps(self, horizon: float) -> int:
        if not bounded("s", 0.5 * self.step, MAX_HORIZON).within(horizon):
            raise InvalidInputError("horizon", horizon, f"a time from one step, {self.step:g} s, to {MAX_HORIZON:g} s")
        steps, most = max(1, round(horizon / self.step)), 20_000
        if steps > most:
            raise InvalidInputError("horizon", f"{steps} steps", f"at most {most} steps of {self.step:g} s")
        return steps

    def _sequence(self, commands: Vector, steps: int) -> Points:
        """Return a velocity for each step."""
        given = as_numbers("commands", commands)
        given = finite_array("commands", given, (2,) if given.ndim == 1 else (steps, 2), bounded("m/s"))
        # A copy, as views of broadcasts are read-only, which is another type for compiled code.
        return np.array(np.broadcast_to(given, (steps, 2)), order="C")

    def _attached(self, tail: Vector, heading: Vector) -> Vector:
        """Return where the thread is fixed, shape (2,) [m]."""
        if not self._offset:
            return tail
        (x, y), (along, left) = heading, self._offset
        return np.asarray(tail + np.array([along * x - left * y, along * y + left * x]))

    def _check_start(self, start: ForecastStart) -> None:
        pose, nodes = start.pose, (self.thread.segments + 1, 2)
        check_pose(pose)
        finite_array("thread's nodes", start.vertices, nodes, bounded("m", -10.0, 10.0))
        if start.velocities is not None:
            finite_array("thread's velocities", start.velocities, nodes, bounded("m/s", -10.0, 10.0))
        fixed, unit = self._attached(pose.tail, pose.heading), self.thread.segment_length
        gap = float(np.linalg.norm(start.vertices[0] - fixed))
        if gap > unit:
            wanted = f"at most {unit:.2e} m"
            raise InvalidInputError("thread's first node", f"{gap:.2e} m from where it is fixed", wanted)
        for name, pair in (("tip velocity", start.tip_velocity), ("needle force", start.needle_force)):
            if pair is not None:
                finite_array(f"{name} of the start", pair, (2,), bounded())
        clearance = self.safety.clearance(pose.tail, pose.heading)
        if clearance <= 0.0:
            raise InvalidInputError("needle pose", f"{-clearance:.2e} m inside of a shape or the wall", "one outside")


def make_forecaster(
    settings: ThreadModelSettings, scene: Scene, safety: NeedleSafetyFilter | None = None, **options: Any
) -> ThreadForecaster:
    """Return a forecaster of the thread of a thread model, with its friction law.

    The thread takes one step in each of the forecast, however long: what shorter ones change is small beside what the
    needle does otherwise than forecast.

    Args:
        settings: of the thread model.
        scene: dish and shapes.
        safety: the needle's filter; None for one with the settings' needle, `keep_out` and `pose_margin`.
        options: further arguments of `ThreadForecaster`, by name; they come before those of the settings.

    Raises:
        ConfigurationError: see `ThreadForecaster`.
    """
    if safety is None:
        needle: dict[str, Any] = {
            "needle_length": settings.needle_length,
            "needle_curvature": settings.needle_curvature,
        }
        safety = NeedleSafetyFilter(scene, keep_out=settings.keep_out + settings.pose_margin, **needle)
    step = options.get("step", settings.forecast_step)
    names = "friction_averaging", "attachment_offset", "margin_range", "contact_tolerance", "residual_tolerance"
    chosen: dict[str, Any] = {name: getattr(settings, name) for name in (*names, "fixed_nodes")}
    # The longest step is a little longer, against rounding.
    chosen |= {"law": settings.friction_law(), "step": step, "max_step": max(settings.max_step, 1.001 * step)}
    return ThreadForecaster(settings.thread(), scene, safety, **{**chosen, **options})
