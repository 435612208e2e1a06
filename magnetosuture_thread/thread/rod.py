"""The formulation `rod`: an inextensible rod, one sparse program a step.

    minimise over u   1/2 sum_i (a u_i - v_i)' Z_i (a u_i - v_i) / a  +  E_bend(x + dt u) / dt
    subject to        |x_i - x_{i-1}| = the chord of a segment  (connectivity and compression together)
                      h_obs >= 0,  h_wall >= 0                  (obstacles and the wall of the dish, hard)

in units of the segment length D and of the drag (or mass / dt + drag) of one segment. The prescribed nodes,
the needle's tail among them, have moved before the step and are no unknowns.

In a viscous liquid Z_i is the drag, and the rate of change at the end of the step is the second-order
backward difference a u - v, with v = b times the last step's velocities, a = (1 + 2 w) / (1 + w),
b = w / (1 + w), and w = dt over the last step's dt; the first step, and one more than twice as long as
the last, has a = 1, v = 0. In air there is besides the drag, with a = 1 and v = 0, the inertia

    1/2 sum_i (m_i / dt) |u_i - (velocity_i + dt g)|^2

A uniform flow w of the medium adds Z_i w to the drag's part of Z_i v: drag is on the velocity against the medium.

The barriers are linearised about the end point that the last velocities predict, and again at the one
that each solve predicts, as the discrete-time condition h(x + dt u) >= (1 - alpha dt) h(x) with
alpha = 1 / dt, until segments are right to a thousandth and nodes to 1e-7 m, or for `MAX_SOLVES` times.
One solve is nearly always enough: the prediction is of second order already, and with the constraints'
curvature in P (`_taut`) each solve is a Newton step.

Source: [Forghani2025], controller (quadratic program over all velocities). Deviation: the objective is
dissipation and elastic energy instead of |u - kappa v|^2, the thread may not be compressed, segments have
a compliance of 1e-7 instead of slacks, and where the barriers are linearised is new; each is a measured gain.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import numpy as np

from magnetosuture_thread.geometry.barrier import COMPRESSION, CONNECTIVITY, NO_OBSTACLE, Barrier
from magnetosuture_thread.geometry.compiled import (
    TypedKernel,
    compiled_inline,
    compiled_inner,
    compiled_uncounted,
    compiled_uncounted_without_gil,
    compiled_within,
)
from magnetosuture_thread.geometry.obstacles import Workspace, WorkspaceData
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError
from magnetosuture_thread.thread import banded, mechanics
from magnetosuture_thread.thread.barriers import move_inside, segment_rows_of
from magnetosuture_thread.thread.contact_rows import (
    DEPTH_TOLERANCE,
    contact_rows,
    friction_rows,
    keep_grips,
    keep_pushes,
    knows_friction,
    stays_clear,
)
from magnetosuture_thread.thread.forces import ThreadForces, friction_of, keep_internal_forces, write_forces
from magnetosuture_thread.thread.margins import BarrierMargins, constant_column
from magnetosuture_thread.thread.material import Attachment, Thread
from magnetosuture_thread.thread.mechanics import RodProperties
from magnetosuture_thread.thread.program import (
    ABOUT,
    BEFORE,
    LAST,
    LAST_ABOUT,
    NO_SHAPE,
    SOLVED,
    START,
    VELOCITIES,
    ChainProgram,
    Indices,
    Mask,
    Residuals,
    RodBuffers,
    Solver,
    StepBuffers,
    Table,
    Vector,
    compiled_residuals,
    first_rows,
    program_view,
)
from magnetosuture_thread.thread.self_contact import SelfContact
from magnetosuture_thread.thread.solvers import BandedSolver, FallbackSolver
from magnetosuture_thread.thread.step import (
    AddedRows,
    Formulation,
    PrescribedMotion,
    StepResult,
    ThreadState,
    WarmStart,
)

STRAIN_TOLERANCE = 1e-3  # of the segments; beyond it the barriers are linearised once more
COMPLIANCE = 1e-7  # of a segment
FRICTION_TOLERANCE = 0.003  # of the limits of friction; beyond it they are taken from the solve and it is repeated
MAX_FRICTION_SOLVES = 5  # of a step; then the limits are those of the solve before
MAX_SOLVES = 8  # of a step
MAX_STEP_RATIO = 2.0  # of a step to the last one, for the second-order difference to stay stable
ENDED, NO_ROOM, UNSOLVED = range(3)  # how far `solve_step` got


class StepModel(NamedTuple):
    """The thread and what is around it, for compiled code.

    Attributes:
        rod: the thread.
        workspace: obstacles and wall, with the reach of the program's rows [m].
        tolerance: the largest residual with which a solution is accepted.
        max_solves: of a step.
        structured: whether the structured solver is to solve; if not, every solve is left to the caller.
    """

    rod: RodProperties
    workspace: WorkspaceData
    tolerance: float
    max_solves: int = MAX_SOLVES
    structured: bool = True


class StepInput(NamedTuple):
    """What a step starts from and where it leads, for compiled code.

    Attributes:
        positions: of all nodes, shape (n + 1, d) [m].
        velocities: over the last step [m/s].
        nodes: of prescribed motion, shape (k,).
        ends: where these are at the end of the step, shape (k, d) [m].
        heading: unit vector along the needle at the end of the step, shape (d,).
        interval: dt [s].
        last_interval: of the last step, 0 if there was none [s].
    """

    positions: Points
    velocities: Points
    nodes: Indices
    ends: Points
    heading: Points
    interval: float
    last_interval: float


@compiled_inline
def copy_points(given: Points, written: Points) -> None:
    """Copy positions or velocities; an assignment of slices would make an array."""
    for i in range(len(given)):
        for a in range(given.shape[1]):
            written[i, a] = given[i, a]


@compiled_within
def assemble_step(
    solves: int, model: StepModel, buffers: RodBuffers, given: StepInput, elsewhere: float, last_contacts: int
) -> tuple[int, float, bool]:
    """Write the program about a predicted end point; where that came from a solve and is exact, do not.

    Where the program in the buffers was written about, and how many contacts it has, -1 if that is not known, make it
    cheap to find that out.

    Returns the number of rows of contacts and friction, -1 if there is no room for them; how far off the barriers the
    point is: the strain, the depth, or what barriers from elsewhere are, over what is allowed, 1 or less if it is
    exact; and whether the limits of friction are still to be found.
    """
    program, motion, known, interval = buffers.program, buffers.motion, buffers.known, given.interval
    about, start = motion[ABOUT], motion[START]
    rod, workspace, segments = model.rod, model.workspace, len(about) - 1
    mechanics.chord_lengths(about, given.heading, rod.clamped, program.chords)
    strain = segment_rows(program, about, start, known, interval)
    rough, off = knows_friction(workspace.friction), max(strain / STRAIN_TOLERANCE, elsewhere)
    cheap = solves > 0 and last_contacts >= 0 and not rough and off <= 1.0
    if cheap and stays_clear(program, workspace, motion[LAST_ABOUT], about, known, rod.unit, rod.radius):
        return last_contacts, off, False
    contacts, depth = contact_rows(
        program, segments, workspace, about, start, known, interval, rod.unit, rod.radius, True
    )
    rubs = False
    if contacts > 0 and rough:
        rubbing, change = friction_rows(buffers, segments, contacts, workspace.friction, interval)
        contacts = contacts + rubbing if rubbing >= 0 else -1
        rubs = change > FRICTION_TOLERANCE and 0 < solves < MAX_FRICTION_SOLVES
    off = max(off, depth / DEPTH_TOLERANCE)
    if contacts >= 0 and (solves == 0 or off > 1.0 or rubs):
        _objective(rod, buffers, given)
    return contacts, off if solves > 0 else np.inf, rubs


@compiled_within
def _objective(rod: RodProperties, buffers: RodBuffers, given: StepInput) -> None:
    """Write P and q, with r the bending stiffness over the unit of the metric and D^4.

        P = a Z + r (dt + tau) K,    q = r (grad E(x) + tau K shift) - Z (v + flow)

    and what `tension_stiffness` and `_taut` add. `shift` is the velocity of the prescribed nodes, which have
    moved already. In air a = 1, and of Z v only the inertia's part is left; the flow acts on the drag's part alone.
    """
    program, motion, heading, interval = buffers.program, buffers.motion, given.heading, given.interval
    before, start, last, about = motion[BEFORE], motion[START], motion[LAST], motion[ABOUT]
    nodes, dimension = start.shape
    blocks, couplings, linear = program.blocks, program.couplings, program.linear
    inertia = rod.mass_per_length / interval
    scale = inertia + rod.drag_across
    rate = rod.bending_stiffness / (scale * rod.unit**4)
    inertia = inertia / scale
    mechanics.metric(about, rod.weights, inertia, rod.drag_across / scale, rod.drag_along / scale, blocks)
    mechanics.bending_gradient(start, heading, rod.clamped, rod.rest_angles, program.work, linear)
    ratio = interval / given.last_interval if given.last_interval > 0.0 else 0.0
    if inertia > 0.0 or ratio > MAX_STEP_RATIO:
        ratio = 0.0
    leading, trailing = (1.0 + 2.0 * ratio) / (1.0 + ratio), ratio / (1.0 + ratio)
    stiffness = rate * (interval + rod.bending_damping)
    for i in range(nodes):
        for a in range(dimension):
            bending = value = rate * linear[i, a]
            for b in range(dimension):
                value -= trailing * blocks[i, a, b] * last[i, b]
            value -= inertia * rod.weights[i] * (last[i, a] + interval / rod.unit * rod.gravity[a])
            for b in range(dimension):
                value -= blocks[i, a, b] * rod.flow[b] / rod.unit
            linear[i, a] = value + inertia * rod.weights[i] * rod.flow[a] / rod.unit
            buffers.drag_linear[i, a] = linear[i, a] - bending
        for a in range(dimension):
            for b in range(dimension):
                blocks[i, a, b] *= leading
                buffers.drag[i, a, b] = blocks[i, a, b]
            blocks[i, a, a] += stiffness * rod.bands[0, i]
        for apart in range(1, 4):
            couplings[apart - 1, i] = stiffness * rod.bands[apart, i]
    if rod.bending_damping > 0.0:
        weight = rate * rod.bending_damping / interval
        for i in range(nodes):
            for apart in range(-3, 4):
                if 0 <= i + apart < nodes:
                    band = weight * rod.bands[abs(apart), min(i, i + apart)]
                    for a in range(dimension):
                        linear[i, a] += band * (start[i + apart, a] - before[i + apart, a])
    mechanics.tension_stiffness(
        start, heading, rod.clamped, program.multipliers, -0.5 * rate, interval, (blocks, couplings, linear)
    )
    _taut(program, about, start, interval)


@compiled_within
def _taut(buffers: StepBuffers, about: Points, start: Points, interval: float) -> None:
    """Add the curvature of the constraints: that of -sum T_i h_i, for the segments that are pulled.

        1/2 dt sum_i T_i |w_i - w_{i-1}|^2,    w = u - (y - x) / dt

    With it each linearisation is a Newton step of Lagrange's function; without it the solves of a thread
    that is pulled hard, T dt > Z, swing from side to side and never end.
    """
    nodes, dimension = about.shape
    for i in range(nodes - 1):
        tension = max(buffers.multipliers[i], 0.0)
        weight = interval * tension
        for a in range(dimension):
            moved = about[i + 1, a] - start[i + 1, a] - about[i, a] + start[i, a]
            buffers.linear[i, a] += tension * moved
            buffers.linear[i + 1, a] -= tension * moved
            buffers.blocks[i, a, a] += weight
            buffers.blocks[i + 1, a, a] += weight
        buffers.couplings[0, i] -= weight


@compiled_inner
def segment_rows(buffers: StepBuffers, about: Points, start: Points, known: Mask, interval: float) -> float:
    """Write the rows of connectivity and compression together; return the largest |h(y)|.

        grad h(y)' u = (-h(y) - grad h(y)' (x - y)) / dt,    h_i = (D_i^2 - |y_{i+1} - y_i|^2) / 2

    with the chord D_i of each segment.
    """
    nodes, dimension = about.shape
    strain = 0.0
    for i in range(nodes - 1):
        begin, square, moved = min(i, nodes - 3), 0.0, 0.0
        shift = i - begin
        for a in range(dimension):
            buffers.gradient[i, 0, a] = buffers.gradient[i, 1, a] = buffers.gradient[i, 2, a] = 0.0
            along = about[i + 1, a] - about[i, a]
            buffers.gradient[i, shift, a], buffers.gradient[i, shift + 1, a] = along, -along
            square += along * along
            moved += along * (start[i, a] - about[i, a] - start[i + 1, a] + about[i + 1, a])
        value = 0.5 * (buffers.chords[i] ** 2 - square)
        buffers.first[i] = begin
        buffers.lower[i] = buffers.upper[i] = (-value - moved) / interval
        buffers.compliance[i] = COMPLIANCE
        if known[i] and known[i + 1]:
            # Nothing in the program can change its length, and a tension that tries would bend its neighbours.
            buffers.lower[i], buffers.upper[i], buffers.multipliers[i] = -np.inf, np.inf, 0.0
        else:
            strain = max(strain, abs(value))
    return strain


@compiled_within
def init_step(buffers: RodBuffers, given: StepInput, unit: float) -> None:
    """Begin a step, about where the thread would be if it moved on as it did: a guess of second order.

    Not after a step that was much shorter, where the velocities may be those of a sample's noise, and not
    farther than a segment: then the guess is where the thread is.

    Args:
        buffers: written.
        given: the step.
        unit: D [m].
    """
    motion, known, interval = buffers.motion, buffers.known, given.interval
    nodes, dimension = given.positions.shape
    known[:] = False
    for i in range(nodes):
        for a in range(dimension):
            motion[BEFORE, i, a] = motion[START, i, a] = given.positions[i, a] / unit
            motion[LAST, i, a] = motion[VELOCITIES, i, a] = given.velocities[i, a] / unit
    for k in range(len(given.nodes)):
        known[given.nodes[k]] = True
        for a in range(dimension):
            motion[START, given.nodes[k], a] = given.ends[k, a] / unit
    copy_points(motion[START], motion[ABOUT])
    if not (given.last_interval > 0.0 and interval <= MAX_STEP_RATIO * given.last_interval):
        return
    for i in range(nodes):
        for a in range(dimension):
            if not known[i]:
                motion[ABOUT, i, a] = motion[START, i, a] + interval * motion[LAST, i, a]
                if not abs(motion[ABOUT, i, a] - motion[START, i, a]) <= 1.0:
                    copy_points(motion[START], motion[ABOUT])
                    return


class StepProgress(NamedTuple):
    """How far a step has got.

    Attributes:
        code: `ENDED`; `NO_ROOM` for all contacts in the buffers; or `UNSOLVED`, and then the program is there for
            another solver.
        contacts: number of rows of contacts and friction.
        solves: that the step has had.
        off: how far off the barriers are over what is allowed, 1 or less if they hold; see `assemble_step`.
        status: the first of the solves that is not 0, see `banded.STATUS`.
        residuals: the largest of each kind.
    """

    code: int
    contacts: int
    solves: int
    off: float
    status: int
    residuals: tuple[float, float, float]


@compiled_uncounted_without_gil
def solve_step(
    model: StepModel,
    buffers: RodBuffers,
    solver_buffers: banded.SolverBuffers,
    given: StepInput,
    solves: int,
    elsewhere: float,
) -> tuple[int, int, int, float, int, tuple[float, float, float]]:
    """Linearise and solve until the barriers are exact, or the solves are too many, or as far as it gets.

    A linearisation that does not halve how far off the barriers are is followed by one halfway back.

    Args:
        model: the thread and what is around it.
        buffers: the step under way; it has the program in the end, its multipliers, and the end of the step.
        solver_buffers: of the structured solver.
        given: the step.
        solves: how many this step has had; with none it begins.
        elsewhere: how far off the rows are that this code does not know, see `assemble_step`.

    Returns:
        The fields of `StepProgress`, which a named tuple would take as long to return as it takes to set up a step.
    """
    about, last_about = buffers.motion[ABOUT], buffers.motion[LAST_ABOUT]
    if solves == 0:
        init_step(buffers, given, model.rod.unit)
    copy_points(about, last_about)
    primal, dual, complementarity, segments = 0.0, 0.0, 0.0, len(about) - 1
    # Numbers of a type of their own: a function is compiled again for each number that is written out.
    first, unknown, status = np.int64(0), np.int64(-1), np.int64(banded.SOLVED)
    last_off, contacts, code = np.inf, unknown, UNSOLVED
    off, rubs, halved = np.inf, False, False
    while True:
        begun, before = (first, unknown) if halved else (solves, contacts)
        contacts, assembled_off, assembled_rubs = assemble_step(begun, model, buffers, given, elsewhere, before)
        if not halved:
            off, rubs = assembled_off, assembled_rubs
            if contacts >= 0 and 1.0 < off < np.inf and off > 0.5 * last_off and solves < model.max_solves:
                # Solves that swing from side to side, as of a chord that turns about a corner: the middle is better.
                halfway(about, last_about)
                halved = True
                continue
        halved = False
        last_off = off
        copy_points(about, last_about)
        if contacts < 0:
            code = NO_ROOM
            break
        if (off <= 1.0 and not rubs) or solves == model.max_solves:
            finish_step(model, buffers, given, off)
            code = ENDED
            break
        if not model.structured:
            break
        rows = segments + contacts
        program, multipliers = program_view(buffers.program, buffers.known, rows), buffers.program.multipliers[:rows]
        word, residuals = solve_checked(program, buffers.motion[VELOCITIES], multipliers, solver_buffers, model)
        if not max(residuals) <= model.tolerance:
            break
        accept_step(buffers, model.workspace.friction, rows, given.interval)
        primal, dual = max(primal, residuals[0]), max(dual, residuals[1])
        complementarity = max(complementarity, residuals[2])
        status, solves = status if status != 0 else word, solves + 1
    return code, contacts, solves, off, status, (primal, dual, complementarity)


@compiled_inline
def halfway(points: Points, last: Points) -> None:
    """Move points halfway back to where they were last."""
    for i in range(len(points)):
        for a in range(points.shape[1]):
            points[i, a] = 0.5 * (points[i, a] + last[i, a])


@compiled_within
def solve_checked(
    program: ChainProgram, u: Points, multipliers: Vector, solver_buffers: banded.SolverBuffers, model: StepModel
) -> tuple[int, tuple[float, float, float]]:
    """Solve a program; where the residuals do not pass, again from a cold start. Return status and residuals."""
    word, residuals = np.int64(banded.SOLVED), (np.inf, np.inf, np.inf)
    for attempt in range(2):
        word, _ = banded.solve(program, u, multipliers, solver_buffers)
        residuals = compiled_residuals(program, u, multipliers)
        if max(residuals) <= model.tolerance:
            return word if attempt == 0 else np.int64(banded.RESTARTED), residuals
        u[:] = 0.0
        multipliers[:] = 0.0
    return word, residuals


@compiled_within
def finish_step(model: StepModel, buffers: RodBuffers, given: StepInput, off: float) -> None:
    """Write where the step ends, and the velocities over it; whatever else holds, nothing passes the wall."""
    about, before, unit, end = buffers.motion[ABOUT], buffers.motion[BEFORE], model.rod.unit, buffers.end
    if off > 1.0:
        move_inside(about, buffers.known, (model.workspace.wall_radius - model.rod.radius) / unit)
    for i in range(len(about)):
        for a in range(about.shape[1]):
            end[0, i, a] = about[i, a] * unit
            end[1, i, a] = (about[i, a] - before[i, a]) * (unit / given.interval)


@compiled_uncounted
def accept_step(buffers: RodBuffers, friction: Vector, rows: int, interval: float) -> None:
    """Accept the velocities and multipliers in the buffers as the solution of the first rows: keep what follows."""
    start, velocities, about = buffers.motion[START], buffers.motion[VELOCITIES], buffers.motion[ABOUT]
    segments = len(about) - 1
    keep_pushes(buffers, rows, segments)
    if knows_friction(friction):
        keep_grips(buffers.program, buffers.grips, rows, segments, friction)
    keep_internal_forces(buffers, rows, interval)
    for i in range(len(about)):
        for a in range(about.shape[1]):
            # Known nodes have moved, and have no velocity.
            about[i, a] = start[i, a] + interval * velocities[i, a]


class RodFormulation(Formulation):
    """Steps a thread by the program above; see `Formulation` for the arguments.

    Raises:
        ConfigurationError: gravity or flow has not one value for each dimension.

    Attributes:
        rod: the thread, for compiled code.
        step_model: the thread and what is around it, for compiled code.
        buffers: of the last step.
    """

    name = "rod"
    has_friction = True

    def __init__(
        self,
        thread: Thread,
        workspace: Workspace,
        solver: Solver,
        tolerance: float,
        barriers: Sequence[Barrier] = (),
    ) -> None:
        super().__init__(thread, workspace, solver, tolerance, barriers, thread.segments)
        self.buffers = RodBuffers.of(self._program, self.dimension)
        medium = thread.medium
        self.rod = RodProperties(
            thread.attachment is Attachment.CLAMPED,
            float(thread.segment_length),
            float(self._radius),
            float(thread.bending_stiffness),
            float(medium.drag_across),
            float(medium.drag_along),
            float(medium.mass_per_length),
            float(medium.bending_damping),
            self._vector("gravity", medium.gravity),
            np.ascontiguousarray(thread.rest_angles),
            mechanics.end_corrected_weights(thread.segments),
            mechanics.bending_bands(thread.segments, thread.attachment is Attachment.CLAMPED),
            self._vector("flow", medium.flow),
        )
        first = solver.first if type(solver) is FallbackSolver else solver
        self._structured = type(first) is BandedSolver  # another one's way of solving is its own
        banded_solver = first if isinstance(first, BandedSolver) else BandedSolver()
        self._solver_buffers = banded_solver.buffers(thread.segments + 1, self.dimension, len(self._program.first))
        self._solve_step, self._force_kernel = TypedKernel(solve_step), TypedKernel(write_forces)
        self._segment_kernel = TypedKernel(segment_rows_of)
        self._last_nodes = np.arange(1, self._rows + 1, dtype=np.uint32)
        self._last_nodes.flags.writeable = False
        selves = [barrier for barrier in barriers if isinstance(barrier, SelfContact)]
        self._self_contact = selves[0] if selves else None
        self.touches_itself = bool(selves)
        self._only_self_contact = len(barriers) == len(selves)
        self._rough = knows_friction(self.workspace.data.friction)
        self.step_model = StepModel(self.rod, self.workspace.data, float(tolerance), MAX_SOLVES, self._structured)

    @property
    def nodes_in_contact(self) -> Mask:
        """Which nodes shapes or wall pushed in the last step, at a node or on a chord beside it, shape (n + 1,)."""
        at_nodes, on_chords = self._program.push > 0.0
        at_nodes |= on_chords
        at_nodes[1:] |= on_chords[:-1]
        return np.asarray(at_nodes)

    def _memory(self) -> WarmStart:
        return self.buffers.memory

    def forget(self) -> None:
        """Forget the last solve; see `Formulation`."""
        super().forget()
        self.buffers.grips.shape[:], self.buffers.grips.force[:] = NO_SHAPE, 0.0

    def _vector(self, name: str, values: tuple[float, ...]) -> Vector:
        """Return a vector of the medium, zeros where it has none."""
        if len(values) not in (0, self.dimension):
            raise ConfigurationError(f"medium.{name}", values, f"{self.dimension} values, or none")
        return np.array(values, np.float64) if values else np.zeros(self.dimension)

    def check_start(self, positions: Points) -> None:
        """Refuse a thread that crosses itself where it cannot; see `Formulation`."""
        crossings = self._self_contact.crossings(positions) if self._self_contact is not None else []
        if crossings:
            places = " and ".join(f"{1e3 * self._thread.segment_length * (i + 0.5):.1f}" for i in crossings[0])
            given = f"{len(crossings)} crossings, the first at {places} mm along it"
            raise InvalidInputError("thread's nodes", given, "a thread that does not cross itself, as the scene has it")

    def step(self, state: ThreadState, drive: PrescribedMotion, interval: float) -> StepResult:
        """Move the prescribed nodes and let the thread follow; see `Formulation`.

        Compiled code takes the step as long as the structured solver gets on with it. The rows of added barriers are
        in the program from where it ends without them and one is not met.
        """
        buffers = self.buffers
        if state.interval == 0.0:
            self.forget()
        # Compiled code takes contiguous arrays.
        positions = np.ascontiguousarray(state.positions, np.float64)
        velocities = np.ascontiguousarray(state.velocities, np.float64)
        given = StepInput(positions, velocities, *drive.arrays(), float(interval), float(state.interval))
        model = self.step_model
        worst, solves, status, solver = Residuals(0.0, 0.0, 0.0), 0, SOLVED, self._solver.name
        added: AddedRows | None = None
        off = 0.0  # how far the added rows are from being met
        before = None
        if self.added:
            self.added.begin(positions, drive, interval)
            before = self.warm_start()
        while True:
            done = self.solve(given, solves, off, model)
            worst, solves = _worse(worst, done.residuals), done.solves
            status = status if status != SOLVED else banded.STATUS[done.status]
            if done.code == NO_ROOM:
                self._refuse_contacts()
            if done.code == ENDED:
                if before is not None and added is None:
                    try:
                        added = self._linearised(interval)
                    except InvalidInputError:  # of a user's barrier: the step is not taken
                        self.restore(before)
                        raise
                    if added.unmet:
                        model, off = model._replace(structured=False, max_solves=solves + MAX_SOLVES), np.inf
                        continue
                break
            rows = self._rows + done.contacts
            program = first_rows(self._program, buffers.known, rows)
            solution = self._solve(program, buffers.motion[VELOCITIES], added)
            self._program.multipliers[:rows], pushes = np.split(solution.multipliers, [rows])
            buffers.motion[VELOCITIES] = solution.velocities
            accept_step(buffers, self.workspace.data.friction, rows, interval)
            if added is not None:
                if self._only_self_contact:
                    buffers.contact_force[:] += added.force(pushes, positions.shape)
                    buffers.tail_load[:] += added.force(pushes, positions.shape)[0]
                added = self._linearised(interval)
                off = added.off
            worst, solves = _worse(worst, solution.residuals), solves + 1
            if status == SOLVED:
                status, solver = solution.status, solution.solver
        end, velocity = buffers.end.copy()
        after = ThreadState(end, velocity, interval)
        if done.off > 1.0:
            words = f"not converged in {solves} linearisations, off by {done.off:.1g} times what is allowed"
            status = f"{words}; {status}"
        loads = buffers.internal.copy(), buffers.contact_force.copy(), buffers.tail_load.copy()
        grip, own_way = buffers.grips.force.copy() if self._rough else None, self._self_contact
        passed = done.off > 1.0 and own_way is not None and own_way.passed(positions, end)
        return StepResult(after, solver, status, worst, solves, done.off <= 1.0, loads, grip, passed)

    def solve(
        self, step_input: StepInput, solves: int = 0, elsewhere: float = 0.0, model: StepModel | None = None
    ) -> StepProgress:
        """Let compiled code take a step as far as it gets; see `solve_step`. Arrays have to be contiguous."""
        model = self.step_model if model is None else model
        arguments = model, self.buffers, self._solver_buffers, step_input, solves, elsewhere
        return StepProgress(*self._solve_step(*arguments))

    def separate(self) -> RodFormulation:
        """Return the same formulation with buffers of its own, for the steps of another thread like this one."""
        other, dimension = copy(self), self.dimension
        other._program = StepBuffers.of(self._rows + 1, dimension, self._rows)
        other.buffers = RodBuffers.of(other._program, dimension)
        other._solver_buffers = BandedSolver().buffers(self._rows + 1, dimension, len(self._program.first))
        return other

    def _linearised(self, interval: float) -> AddedRows:
        motion = self.buffers.motion
        return self.added.linearised(motion[ABOUT], motion[START], self.buffers.known, interval)

    def forces(self, result: StepResult, heading: Points) -> ThreadForces:
        """Return the forces at the end of a step; see `Formulation`."""
        assert result.loads is not None
        state, (internal, contact, load) = result.state, result.loads
        tension, force = np.empty(self._rows), np.empty(self.dimension)
        moved = state.positions / self.rod.unit, state.velocities, state.interval
        moment, scale = self.write_forces(*moved, heading, (internal, load), tension, force)
        friction, use = np.zeros((2, self._rows + 1))
        if result.grip is not None:
            friction, use = friction_of(result.grip)
            friction *= scale
        return ThreadForces(tension, scale * contact, force, moment, friction, use)

    def write_forces(
        self,
        positions: Points,
        velocities: Points,
        interval: float,
        heading: Points,
        loads: tuple[Points, Vector],
        tension: Vector,
        force: Vector,
    ) -> tuple[float, float]:
        """Write tension and force at the end of a step; see `write_forces`. Arrays have to be contiguous.

        Args:
            positions: of all nodes, shape (n + 1, d) [D].
            velocities: over the step [m/s].
            interval: of the step [s].
            heading: of the needle, shape (d,).
            loads: `internal` and `tail_load` of the buffers.
            tension: written, shape (n,) [N].
            force: upon the needle, written, shape (d,) [N].

        Returns:
            The moment [N m], and the force of a unit of the loads [N].
        """
        rod = self.rod
        scale = (rod.drag_across + rod.mass_per_length / interval) * rod.unit**2
        along = np.ascontiguousarray(heading)
        arguments = rod, positions, velocities, along, *loads, scale, tension, force
        return self._force_kernel(*arguments), scale

    def warm_up(self) -> None:
        """Load what follows where the structured solver does not get on with a step; see `Formulation`."""
        super().warm_up()
        nodes, heading = self._thread.segments + 1, np.eye(self.dimension)[0]
        still, chain = np.zeros((nodes, self.dimension)), np.outer(np.arange(nodes), heading)
        accept_step(self.buffers, self.workspace.data.friction, self._rows, 1.0)
        tension, force = np.zeros(self._rows), np.zeros(self.dimension)
        self.write_forces(chain, still, 1.0, heading, (still, force), tension, force)

    def strain(self, positions: Points, heading: Points) -> Vector:
        """Return each segment's length over the chord of its arc, less one; see `Formulation`."""
        rows = self._segment_rows(positions, heading)
        return np.asarray(rows[3] / rows[4])

    def _segment_rows(self, positions: Points, heading: Points) -> Table:
        """Return value and clearance of connectivity and of compression, and the chords; see `segment_rows_of`."""
        points, rows = np.ascontiguousarray(positions), np.empty((5, self._rows))
        self._segment_kernel(self.rod, points, np.ascontiguousarray(heading), np.empty(points.shape), rows)
        return rows

    def segment_margins(self, positions: Points, heading: Points) -> list[BarrierMargins]:
        """Return connectivity and compression; see `Formulation`."""
        rows = self._segment_rows(positions, heading)
        column = constant_column(NO_OBSTACLE, self._rows, "i4")
        return [
            BarrierMargins(CONNECTIVITY, self._last_nodes, column, rows[0], rows[1]),
            BarrierMargins(COMPRESSION, self._last_nodes, column, rows[2], rows[3]),
        ]


def _worse(one: tuple[float, float, float], other: tuple[float, float, float]) -> Residuals:
    """Return the larger residual of each kind."""
    return Residuals(*(max(pair) for pair in zip(one, other, strict=True)))
