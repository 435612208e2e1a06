"""The predictor: steps the thread model along the needle's stamped poses."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from magnetosuture_thread.geometry.barrier import Barrier, check_barriers
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import Indices, Points, arc_lengths, chain_inside, finite_array
from magnetosuture_thread.geometry.scene import Scene, find_collision
from magnetosuture_thread.settings.configuration import Quantity, bounded, checked_arguments
from magnetosuture_thread.settings.errors import InvalidInputError, SolverError
from magnetosuture_thread.thread.barriers import SelfContact
from magnetosuture_thread.thread.margins import BarrierMargins, Margins
from magnetosuture_thread.thread.material import MATERIALS, Attachment, Thread, check_scene
from magnetosuture_thread.thread.mechanics import ThreadForces
from magnetosuture_thread.thread.paper import PaperFormulation, PaperOptions
from magnetosuture_thread.thread.prediction import MAX_COORDINATE, STARTED, NeedlePose, Prediction, check_pose
from magnetosuture_thread.thread.program import SOLVED
from magnetosuture_thread.thread.rod import RodFormulation
from magnetosuture_thread.thread.solvers import make_solver
from magnetosuture_thread.thread.step import Formulation, PrescribedMotion, StepResult, ThreadState, WarmStart

LENGTH_TOLERANCE = 0.1  # of the thread's length; as a thread is cut by hand, and a line drawn along it
MAX_STEP_LENGTH = 0.5  # segments; of a prescribed node in a sub-step
MOTION_TIME = 4e-3  # s; shorter, what the pose's noise bends counts for more, and longer, the thread has gone on


FORMULATIONS = (RodFormulation.name, PaperFormulation.name)


@checked_arguments("thread predictor")
@dataclass(frozen=True)
class PredictorOptions:
    """Numbers of a predictor that have a good default.

    Attributes:
        margin_range: margins are computed of nodes that are closer to a shape or the wall than this [m].
        contact_tolerance: a node this close to a shape or the wall touches it [m].
        residual_tolerance: the largest scaled residual with which a solution is accepted.
        max_step: intervals are divided into steps of at most this [s].
        max_substeps: but into at most so many; then the steps get longer.
    """

    margin_range: Annotated[float, bounded("m", 0.0, 2.0)] = 5e-3
    contact_tolerance: Annotated[float, bounded("m", 0.0, 1e-3)] = 2e-6
    residual_tolerance: Annotated[float, bounded("", 1e-15, 1e-2)] = 1e-6
    max_step: Annotated[float, bounded("s", 1e-5, 2.0)] = 0.02
    max_substeps: Annotated[int, bounded("", 1, 100_000)] = 200

    def substeps(self, interval: float, way: float) -> int:
        """Return into how many steps an interval [s] is divided in which the fastest node goes a way [segments]."""
        if interval <= self.max_step and way <= MAX_STEP_LENGTH:
            return 1
        wanted = max(interval / self.max_step, way / MAX_STEP_LENGTH, 1.0)
        return min(self.max_substeps, math.ceil(wanted - 1e-9))


class ThreadPredictor:
    """Predicts a thread from the needle's poses.

        predictor = ThreadPredictor.create("polyamide_7_0", length=0.019, segments=25, scene=scene)
        predictor.start(pose)
        prediction = predictor.step(next_pose)
        prediction.margins["obstacle"].minimum

    Args:
        thread: the thread.
        scene: dish and shapes; in space `Workspace` of three dimensions; None for neither wall nor shapes.
        barriers: what is enforced besides the formulation's own barriers, see `Barrier`.
        formulation: `rod`, the accurate one, or `paper`, as printed; or one that is made already, which then knows
            scene and barriers itself.
        solver: `banded` or `osqp`.
        paper: the options of the formulation `paper`.
        fixed_nodes: nodes that stay where they are at the start, as where tissue holds the thread.
        options: by name, see `PredictorOptions`.

    Attributes:
        thread: the thread.
        formulation, fixed_nodes, options: see the arguments; `scene_version` is empty without a scene.
        contact_tolerance: of the options.
        pose, state: the last ones; None before the start.
        added: the barriers that were added, with the time from which those that move count.
        reach: greatest distance of the needle's tail from the dish's centre [m].

    Raises:
        ConfigurationError: a name is unknown, a barrier or a shape cannot be used, or the segments do not resolve the
            scene: a shape is narrower than one of them, or the dish than four.
        InvalidInputError: a fixed node is none of the thread's.
    """

    @checked_arguments("thread predictor")
    def __init__(
        self,
        thread: Thread,
        scene: Scene | Workspace | None = None,
        barriers: Sequence[Barrier] = (),
        *,
        formulation: str | Formulation = "rod",
        solver: str = "banded",
        paper: PaperOptions | None = None,
        fixed_nodes: Sequence[int] = (),
        **options: object,
    ) -> None:
        self.options = chosen = PredictorOptions(**options)  # type: ignore[arg-type]
        for node in fixed_nodes:
            _check_node("fixed node", node, thread)
        workspace, self.scene_version, self._scene = Workspace((), chosen.margin_range), "", scene
        if isinstance(scene, Workspace):
            workspace = scene
        elif scene is not None:
            check_scene(thread, scene)
            # Margins are of the thread's surface, and of the half segments beside a node.
            reach = chosen.margin_range + 0.5 * (thread.diameter + thread.segment_length)
            friction = scene.friction, scene.dish.wall_friction
            workspace = Workspace(scene.obstacles, reach, 2, scene.dish.radius, *friction)
            self.scene_version = scene.version
            if formulation == RodFormulation.name and scene.dish.has_self_contact(thread.diameter):
                barriers = (*barriers, SelfContact(thread))
        if isinstance(formulation, str):
            Quantity("", choices=FORMULATIONS).checked("formulation", formulation, str)
            check_barriers(tuple(barriers))
            tolerance = chosen.residual_tolerance
            parts = thread, workspace, make_solver(solver, tolerance), tolerance
            is_rod = formulation == RodFormulation.name
            formulation = RodFormulation(*parts, barriers) if is_rod else PaperFormulation(*parts, paper, barriers)
        self.thread, self.formulation, self.contact_tolerance = thread, formulation, chosen.contact_tolerance
        self.added = formulation.added
        self.fixed_nodes = tuple(sorted(set(fixed_nodes)))
        self._nodes = np.array([0, *self.fixed_nodes], np.int64)
        # Of their positions; with a slice, for the needle's tail alone, numpy takes a tenth of the time.
        self._selected: Indices | slice = self._nodes if fixed_nodes else slice(0, 1)
        self._room_radius = workspace.wall_radius - 0.5 * thread.diameter
        # A long needle reaches over the wall by up to 2 cm, and a camera sees what is above it.
        self.reach = min(workspace.wall_radius + 0.02, MAX_COORDINATE)
        far, self._shape = self.reach + thread.length, (None, formulation.dimension)
        self._limits = bounded("m", -far, far)
        self.pose: NeedlePose | None = None
        self.state: ThreadState | None = None

    def __copy__(self) -> ThreadPredictor:
        """Return one with buffers of its own: in shared ones the steps of one would be the other's first guess."""
        return deepcopy(self)

    @classmethod
    def create(
        cls,
        material: str,
        *,
        length: float,
        segments: int,
        scene: Scene | Workspace | None = None,
        barriers: Sequence[Barrier] = (),
        attachment: str = "pinned",
        viscosity: float = 1.0,
        **options: Any,
    ) -> ThreadPredictor:
        """Return a predictor of a thread of a known material that floats in a viscous liquid.

        Args:
            material: name, one of `MATERIALS`.
            length: of the thread [m].
            segments: n.
            scene: see the class, as are the following.
            barriers: what is enforced besides.
            attachment: how the thread is fixed to the needle, a value of `Attachment`.
            viscosity: of the liquid [Pa s].
            options: further arguments of the class, by name.

        Raises:
            ConfigurationError: a name is unknown, a number is not positive, or see the class.
        """
        Quantity("", choices=tuple(MATERIALS)).checked("material", material, str)
        Quantity("", choices=tuple(kind.value for kind in Attachment)).checked("attachment", attachment, str)
        kind = Attachment(attachment)
        of = MATERIALS[material]
        thread = Thread.of(of, length=length, segments=segments, attachment=kind, viscosity=viscosity)
        return cls(thread, scene, barriers, **options)

    @property
    def started(self) -> bool:
        """Whether the thread has a shape."""
        return self.state is not None

    def warm_up(self) -> None:
        """Step a straight thread, so that no kernel is compiled in the first callback."""
        dimension = self.formulation.dimension
        east = np.eye(dimension)[0]
        path = -self.thread.segment_length * np.arange(self.thread.segments + 1)[:, None] * east
        begun = self.start_at(NeedlePose(0.0, np.zeros(dimension), east), path)
        assert begun.margins  # which are computed by kernels of their own
        with suppress(SolverError):  # an obstacle that lies here says nothing of a thread that lies elsewhere
            for count in (1, 2):
                self.step(NeedlePose(count * self.options.max_step, np.zeros(dimension), east))
        self.formulation.warm_up()
        self.reset()
        self.added.first_time = math.inf

    def reset(self) -> None:
        """Forget the thread's shape; the next call must be `start`."""
        self.pose = self.state = None

    def start(self, pose: NeedlePose, centreline: Points | None = None, *, strict: bool = True) -> Prediction:
        """Set the thread's shape from a centreline, measured or assumed, from tail to end.

        Args:
            pose: the needle at the same instant.
            centreline: polyline, shape (m, d), m >= 2 [m]. None is a thread that lies straight behind the needle, and
                where the wall is in its way, along the wall.
            strict: whether a centreline of another length than the thread's, by more than `LENGTH_TOLERANCE`, is
                refused, and a thread that lies in the wall or a shape of the scene by more than 0.1 mm. If not,
                a shorter centreline goes on straight, as where the camera measured a part, what is too long is left
                out, and the thread is pushed out of what it lies in.

        Raises:
            InvalidInputError: the pose or the centreline is not finite, or too far from the dish; the centreline is
                shorter than a segment or begins farther than one from the tail; or see `strict`.
        """
        check_pose(pose, self.reach, self.formulation.dimension)
        length, whole = self.thread.length, centreline is not None and strict
        if centreline is None:
            centreline = np.array([pose.tail, pose.tail - 2.0 * self.thread.segment_length * pose.heading])
        centreline = finite_array("centreline", centreline, self._shape, self._limits)
        if len(centreline) < 2:
            raise InvalidInputError("centreline", f"{len(centreline)} points", "at least 2")
        gap, unit = float(np.linalg.norm(centreline[0] - pose.tail)), self.thread.segment_length
        if gap > unit:
            raise InvalidInputError("centreline", f"{gap:.2e} m from the needle's tail", f"at most {unit:.2e} m")
        path = np.vstack([pose.tail, centreline[1:]])
        if arc_lengths(path)[-1] < unit:
            raise InvalidInputError("centreline", f"{arc_lengths(path)[-1]:.2e} m long", f"at least {unit:.2e} m")
        if whole and not abs(arc_lengths(path)[-1] - length) <= LENGTH_TOLERANCE * length:
            expected = f"{length:g} m, the thread's length, within {LENGTH_TOLERANCE:.0%}; strict=False takes a part"
            raise InvalidInputError("centreline", f"{arc_lengths(path)[-1]:g} m long", expected)
        chain = chain_inside(path, self.thread.segments, unit, self._room_radius)
        depth = 1e-4  # m; of a measured line within a shape, by errors of camera and scene
        if strict and isinstance(self._scene, Scene) and (name := find_collision(self._scene, chain, depth)):
            raise InvalidInputError("centreline", f"a thread that lies in {name}", "one clear of wall and shapes")
        return self.start_at(pose, chain)

    def start_at(self, pose: NeedlePose, vertices: Points) -> Prediction:
        """Set the thread's nodes.

        Args:
            pose: the needle at the same instant.
            vertices: all nodes, shape (n + 1, d) [m].

        Raises:
            InvalidInputError: the pose or a node is not finite, there are not n + 1 nodes, the first is
                farther than a segment from the tail, or segments cross where the scene does not allow it.
        """
        check_pose(pose, self.reach, self.formulation.dimension)
        shape = self.thread.segments + 1, self.formulation.dimension
        vertices = finite_array("thread's nodes", vertices, shape, self._limits)
        gap = float(np.linalg.norm(vertices[0] - pose.tail))
        if gap > self.thread.segment_length:
            nearest = f"at most {self.thread.segment_length:.2e} m"
            raise InvalidInputError("thread's first node", f"{gap:.2e} m from the needle's tail", nearest)
        self.formulation.check_start(vertices)
        self.added.first_time = min(self.added.first_time, pose.stamp)
        self.state = ThreadState.at_rest(np.array(vertices, dtype=np.float64, order="C"))
        self.pose = pose
        return self._prediction(pose)

    def follow_on(self, other: ThreadPredictor) -> None:
        """Continue from the state of another predictor, if it has started."""
        self.added.first_time, self.pose = other.added.first_time, other.pose
        self.state = other.state.resampled(other.thread, self.thread) if other.state is not None else None

    def step(self, pose: NeedlePose, prescribed: Mapping[int, Points] | None = None) -> Prediction:
        """Follow the needle to its next pose.

        The real interval between the stamps is stepped over, in sub-steps along the straight line
        between the two poses: so many that neither the time nor the way of a prescribed node, half a segment,
        is too long for one. Where a solve fails, the thread stays as it was at the last pose.

        Args:
            pose: the needle.
            prescribed: where other nodes are at the same instant, if their motion is measured: positions of
                shape (d,) by index [m].

        Raises:
            InvalidInputError: the pose is not finite, or not later than the last one; or a node of prescribed motion is
                none of the thread's, or not finite.
            SolverError: a solution's residual is above the tolerance.
        """
        if self.pose is None or self.state is None:
            raise InvalidInputError("needle pose", "a pose before the start", "a centreline first")
        check_pose(pose, self.reach, self.formulation.dimension)
        last, state = self.pose, self.state
        interval = pose.stamp - last.stamp
        if interval <= 0.0:
            raise InvalidInputError("needle pose stamp", f"{pose.stamp:.6f} s", f"later than {last.stamp:.6f} s")
        nodes, begin, end = self._prescribed(pose, state, prescribed)
        way = max(map(math.dist, begin.tolist(), end.tolist()))
        substeps = self.options.substeps(interval, way / self.thread.segment_length)

        def drive(part: float) -> PrescribedMotion:
            heading, ends = pose.heading, end
            if part < 1.0:
                ends = begin + part * (end - begin)
                heading = (1.0 - part) * last.heading + part * pose.heading
            size = math.hypot(*heading.tolist())  # 0 between opposite headings
            heading = heading / size if size > 1e-6 else pose.heading
            return PrescribedMotion(nodes, ends, heading, last.stamp + part * interval)

        results: list[StepResult] = []
        for index in range(1, substeps + 1):
            results += self._follow(state, drive, index / substeps, interval / substeps, interval)
            state = results[-1].state
        self.pose, self.state = pose, state
        velocities = None if pose.motion is None else dict(zip(nodes.tolist(), (end - begin) / interval, strict=True))
        return self._prediction(pose, interval, results, velocities)

    def _prescribed(
        self, pose: NeedlePose, state: ThreadState, prescribed: Mapping[int, Points] | None
    ) -> tuple[Indices, Points, Points]:
        """Return the nodes of prescribed motion, the needle's first, where they are, and where at the next pose."""
        nodes, begin = self._nodes, state.positions[self._selected]
        end: Points = begin.copy()
        end[0] = pose.tail
        if prescribed:
            ends = dict(zip(nodes.tolist(), end, strict=True))
            for node, position in prescribed.items():
                _check_node("node of prescribed motion", node, self.thread)
                ends[node] = finite_array(f"position of node {node}", position, self._shape[1:], self._limits)
            nodes, end = np.array(list(ends), np.int64), np.array(list(ends.values()))
            begin = state.positions[nodes]
        return nodes, begin, end

    def _follow(
        self,
        state: ThreadState,
        drive: Callable[[float], PrescribedMotion],
        part: float,
        duration: float,
        interval: float,
        halvings: int = 0,
    ) -> list[StepResult]:
        """Return the sub-step that ends at a part of the interval, or more of them where the thread is in its own way.

        Raises:
            SolverError: it would be so in the shortest of them, or see `step`.
        """
        # A sub-step in which a thread that touches itself does not converge is halved twice at the most.
        done, crowded = None, self.formulation.touches_itself and halvings < 2
        try:
            done = self.formulation.step(state, drive(part), duration)
        except SolverError:
            if not crowded:
                raise
        if done is not None and not done.passed and (done.converged or not crowded):
            return [done]
        if done is not None and done.passed and halvings == 5:
            self.formulation.forget()
            raise SolverError(done.solver, "the thread would pass through itself", math.inf, 0.0)
        try:
            middle = part - 0.5 * duration / interval
            first = self._follow(state, drive, middle, 0.5 * duration, interval, halvings + 1)
            return first + self._follow(first[-1].state, drive, part, 0.5 * duration, interval, halvings + 1)
        except SolverError:
            if done is None or done.passed:
                raise
            return [done]  # no better than it was

    def _prediction(
        self,
        pose: NeedlePose,
        interval: float = 0.0,
        results: Sequence[StepResult] = (),
        velocities: Mapping[int, Points] | None = None,
    ) -> Prediction:
        """Return the prediction of the present state.

        Args:
            pose: of the needle.
            interval: since the last one [s].
            results: of the steps that led here; none at the start.
            velocities: of the nodes of prescribed motion [m/s]; None where the needle's motion is not known.
        """
        state, formulation, tolerance = self.state, self.formulation, self.contact_tolerance
        assert state is not None
        last = results[-1] if results else None
        solver, status, residual, converged = "none", STARTED, 0.0, True
        for done in results:
            if status in (STARTED, SOLVED):  # else it is that of the first that was not solved at once
                solver, status = done.solver, done.status
            residual, converged = max(residual, done.residuals.largest), converged and done.converged
        positions, links = state.positions, last.links if last else None
        warm_start = formulation.warm_start() if results and velocities is not None else None
        # At once, as barriers may move on before they are asked again.
        added = [BarrierMargins.from_rows(rows) for rows in self.added.rows_at(pose.stamp, positions, pose.heading)]

        def compute_margins() -> Margins:
            margins = formulation.margins(positions, pose.heading, links)
            return Margins.of([*margins, *added], tolerance, self.scene_version)

        def compute_forces() -> ThreadForces | None:
            forces = formulation.forces(last, pose.heading) if last else None
            if forces is None or warm_start is None or velocities is None:
                return forces
            return self._forces_in_motion(state, pose, velocities, warm_start) or forces

        return Prediction(
            stamp=pose.stamp,
            formulation=formulation.name,
            scene_version=self.scene_version,
            positions=positions,
            strain=formulation.strain(positions, pose.heading, links),
            interval=interval,
            substeps=len(results),
            solver=solver,
            status=status,
            residual=residual,
            converged=converged,
            compute_margins=compute_margins,
            compute_forces=compute_forces,
        )

    def _forces_in_motion(
        self, state: ThreadState, pose: NeedlePose, prescribed: Mapping[int, Points], warm_start: WarmStart
    ) -> ThreadForces | None:
        """Return the forces at a pose while the needle moves as `pose.motion` says; None where a step finds none.

        They are those of a short step of first order on from the state: the drag is that of the present velocity, and
        not of the way since the last pose, which has the noise of two poses. Nothing is changed by it.
        """
        motion, formulation = pose.motion, self.formulation
        assert motion is not None
        angle = math.atan2(pose.heading[1], pose.heading[0]) + motion.turning * MOTION_TIME
        heading = np.array([math.cos(angle), math.sin(angle)])
        velocities = np.array([motion.velocity if node == 0 else prescribed[node] for node in prescribed])
        ends = state.positions[list(prescribed)] + MOTION_TIME * velocities
        moved = PrescribedMotion(np.array(list(prescribed)), ends, heading, pose.stamp)
        # After a much shorter step nothing is extrapolated from the last velocities.
        begin = ThreadState(state.positions, state.velocities, 0.1 * MOTION_TIME)
        kept = formulation.warm_start()
        formulation.restore(warm_start)
        try:
            done = formulation.step(begin, moved, MOTION_TIME)
        except SolverError:
            return None
        finally:
            formulation.restore(kept)
        return formulation.forces(done, heading) if done.converged else None


def _check_node(field: str, node: int, thread: Thread) -> None:
    """Raise `InvalidInputError` unless this is a node of the thread and not the needle's own."""
    if not (isinstance(node, (int, np.integer)) and 1 <= node <= thread.segments):
        raise InvalidInputError(field, node, f"a node from 1 to {thread.segments}; node 0 follows the needle")
