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

import math
from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import numpy as np

from magnetosuture_thread.geometry.barrier import COMPRESSION, CONNECTIVITY, NO_OBSTACLE, Barrier
from magnetosuture_thread.geometry.compiled import (
    TypedKernel,
    compiled_inline,
    compiled_inner,
    compiled_uncounted_without_gil,
    compiled_within,
)
from magnetosuture_thread.geometry.obstacles import Workspace, WorkspaceData
from magnetosuture_thread.geometry.polyline import Indices, Mask, Points, Table, Vector
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError
from magnetosuture_thread.thread import banded, mechanics
from magnetosuture_thread.thread.barriers import SelfContact, distance_row, link_margins, move_inside
from magnetosuture_thread.thread.contact_rows import (
    DEPTH_TOLERANCE,
    contact_rows,
    friction_rows,
    keep_grips,
    keep_pushes,
    knows_friction,
    stays_clear,
)
from magnetosuture_thread.thread.margins import BarrierMargins, constant_column
from magnetosuture_thread.thread.material import Attachment, Thread
from magnetosuture_thread.thread.program import (
    CONTACT,
    END,
    END_VELOCITIES,
    NO_SHAPE,
    SOLVED,
    SPAN,
    Residuals,
    RodBuffers,
    Solver,
    StepBuffers,
    first_rows,
    program_view,
    residuals_with,
)
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

    rod: mechanics.RodProperties
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


class StepProgress(NamedTuple):
    """How far a step has got.

    Attributes:
        code: `ENDED`; `NO_ROOM` for all contacts in the buffers; or `UNSOLVED`, and then the program is there for
            another solver.
        contacts: number of rows of contacts and friction.
        solves: that the step has had.
        off: how far off the barriers are over what is allowed, 1 or less if they hold; see `_linearise`.
        status: the first of the solves that is not 0, see `banded.STATUS`.
    """

    code: int
    contacts: int
    solves: int
    off: float
    status: int


@compiled_uncounted_without_gil
def solve_step(
    model: StepModel,
    buffers: RodBuffers,
    solver_buffers: banded.SolverBuffers,
    step_input: StepInput,
    solves: int,
    elsewhere: float,
    rows: int,
) -> tuple[int, int, int, float, int]:
    """Linearise, check and solve until the barriers hold, or the solves are too many, or as far as it gets.

    Args:
        model: the thread and what is around it.
        buffers: the step under way; it has the program in the end, its multipliers, and the end of the step.
        solver_buffers: of the structured solver.
        step_input: the step.
        solves: how many this step has had; with none it begins.
        elsewhere: how far off the rows are that this code does not know, see `_linearise`.
        rows: of the program in the buffers, whose solution by another solver is there too; 0 for none.

    Returns:
        The fields of `StepProgress`, which a named tuple would take as long to return as it takes to set up a step.
    """
    motion, friction = buffers.motion, model.workspace.friction
    contacts, status = -1, banded.SOLVED
    if solves == 0:
        _begin(buffers, step_input, model.rod.unit)
    last_off = np.inf
    while True:
        if rows > 0:
            _accept(buffers, friction, rows, step_input.interval)
        contacts, off, rubs = _linearise(model, buffers, step_input, solves, elsewhere, contacts, last_off)
        last_off = off
        _copy(motion.about, motion.last_about)
        if contacts < 0:
            return NO_ROOM, contacts, solves, off, status
        if solves == model.max_solves or (off <= 1.0 and not rubs):
            _finish(model, buffers, step_input, off)
            return ENDED, contacts, solves, off, status
        _write_objective(model.rod, buffers, step_input)
        rows = len(motion.about) - 1 + contacts
        word = _solve(buffers, solver_buffers, rows, model.tolerance) if model.structured else banded.STALLED
        if word != banded.SOLVED and word != banded.RESTARTED:
            return UNSOLVED, contacts, solves, off, status
        status, solves = status if status != banded.SOLVED else word, solves + 1


@compiled_inline
def _copy(points: Points, written: Points) -> None:
    """Copy positions or velocities; an assignment of slices would make an array."""
    for i in range(len(points)):
        for a in range(points.shape[1]):
            written[i, a] = points[i, a]


@compiled_within
def _begin(buffers: RodBuffers, step_input: StepInput, unit: float) -> None:
    """Begin a step, about where the thread would be if it moved on as it did: a guess of second order.

    Not after a step that was much shorter, where the velocities may be those of a sample's noise, and not
    farther than a segment: then the guess is where the thread is.
    """
    motion, known, interval = buffers.motion, buffers.program.known, step_input.interval
    nodes, dimension = step_input.positions.shape
    known[:] = False
    buffers.residuals[:] = 0.0
    for i in range(nodes):
        for a in range(dimension):
            motion.before[i, a] = motion.start[i, a] = step_input.positions[i, a] / unit
            motion.last[i, a] = motion.velocities[i, a] = step_input.velocities[i, a] / unit
    for k in range(len(step_input.nodes)):
        known[step_input.nodes[k]] = True
        for a in range(dimension):
            motion.start[step_input.nodes[k], a] = step_input.ends[k, a] / unit
    goes_on = step_input.last_interval > 0.0 and interval <= MAX_STEP_RATIO * step_input.last_interval
    for i in range(nodes):
        for a in range(dimension):
            goes_on = goes_on and (known[i] or abs(interval * motion.last[i, a]) <= 1.0)
    for i in range(nodes):
        for a in range(dimension):
            way = interval * motion.last[i, a] if goes_on and not known[i] else 0.0
            motion.about[i, a] = motion.start[i, a] + way


@compiled_within
def _linearise(
    model: StepModel,
    buffers: RodBuffers,
    step_input: StepInput,
    solves: int,
    elsewhere: float,
    last_contacts: int,
    last_off: float,
) -> tuple[int, float, bool]:
    """Write the rows of all barriers about where the last solve leads, or halfway back where that is no better.

    Solves that swing from side to side, as of a chord that turns about a corner, do not halve how far off the barriers
    are: the middle is better.

    `last_contacts` and `last_off` are those of the last linearisation; -1 contacts where that is not in the buffers.
    `elsewhere` is how far off barriers are that this code does not know.

    Returns:
        The number of rows of contacts and friction, -1 if there is no room for them; how far off the barriers are where
        the last solve leads: the strain, the depth, or what barriers from elsewhere are, over what is allowed, 1 or
        less if it is exact; and whether the limits of friction are still to be found.
    """
    about, last_about, off, rubs = buffers.motion.about, buffers.motion.last_about, np.inf, False
    contacts = last_contacts
    for attempt in range(2):
        count = solves if attempt == 0 else 0
        contacts, now_off, now_rubs = _write_rows(model, buffers, step_input, count, elsewhere, contacts)
        if attempt == 1:
            break
        off, rubs = now_off, now_rubs
        if contacts < 0 or not 1.0 < off < np.inf or off <= 0.5 * last_off or solves >= model.max_solves:
            break
        for i in range(len(about)):
            for a in range(about.shape[1]):
                about[i, a] = 0.5 * (about[i, a] + last_about[i, a])
        contacts = -1
    return contacts, off, rubs


@compiled_within
def _write_rows(
    model: StepModel, buffers: RodBuffers, step_input: StepInput, solves: int, elsewhere: float, last_contacts: int
) -> tuple[int, float, bool]:
    """Write the rows about a predicted end point; where that came from a solve and is exact, leave them.

    Returns:
        See `_linearise`.
    """
    program, motion, interval = buffers.program, buffers.motion, step_input.interval
    about, start = motion.about, motion.start
    rod, workspace, segments = model.rod, model.workspace, len(about) - 1
    mechanics.chord_lengths(about, step_input.heading, rod.clamped, program.chords)
    strain = segment_rows(program, about, start, interval)
    rough, off = knows_friction(workspace.friction), max(strain / STRAIN_TOLERANCE, elsewhere)
    cheap = solves > 0 and last_contacts >= 0 and not rough and off <= 1.0
    if cheap and stays_clear(program, workspace, motion.last_about, about, rod.unit, rod.radius):
        return last_contacts, off, False
    contacts, depth = contact_rows(program, segments, workspace, about, start, interval, rod.unit, rod.radius, True)
    rubs = False
    if contacts > 0 and rough:
        rubbing, change = friction_rows(buffers, segments, contacts, workspace.friction, interval)
        contacts = contacts + rubbing if rubbing >= 0 else -1
        # Beyond a share of the limits they are taken from the solve, and it is repeated, up to five times.
        rubs = change > 0.003 and 0 < solves < 5
    return contacts, max(off, depth / DEPTH_TOLERANCE) if solves > 0 else np.inf, rubs


@compiled_inner
def segment_rows(buffers: StepBuffers, about: Points, start: Points, interval: float) -> float:
    """Write the rows of connectivity and compression together; return the largest |h(y)|.

        grad h(y)' u = (-h(y) - grad h(y)' (x - y)) / dt,    h_i = (D_i^2 - |y_{i+1} - y_i|^2) / 2

    with the chord D_i of each segment.
    """
    nodes, dimension = about.shape
    # Fields of a large tuple are taken out of it once: to compile each access takes as long as the arithmetic.
    gradient, lower, upper = buffers.gradient, buffers.lower, buffers.upper
    known, chords = buffers.known, buffers.chords
    first, compliance, multipliers, strain = buffers.first, buffers.compliance, buffers.multipliers, 0.0
    for i in range(nodes - 1):
        begin, moved = min(i, nodes - 3), 0.0
        value, _ = distance_row(about, i, i + 1, chords[i])
        for a in range(dimension):
            along = about[i + 1, a] - about[i, a]
            for k in range(SPAN):
                gradient[i, k, a] = along if begin + k == i else (-along if begin + k == i + 1 else 0.0)
            moved += along * (start[i, a] - about[i, a] - start[i + 1, a] + about[i + 1, a])
        bound = (-value - moved) / interval
        # A compliance as small as that of a contact, below what can be measured.
        first[i], compliance[i], lower[i], upper[i] = begin, 1e-7, bound, bound
        if known[i] and known[i + 1]:
            # Nothing in the program can change its length, and a tension that tries would bend its neighbours.
            lower[i], upper[i], multipliers[i] = -np.inf, np.inf, 0.0
        else:
            strain = max(strain, abs(value))
    return strain


@compiled_inner
def _write_objective(rod: mechanics.RodProperties, buffers: RodBuffers, step_input: StepInput) -> None:
    """Write P and q, with r the bending stiffness over the unit of the metric and D^4.

        P = a Z + r (dt + tau) K,    q = r (grad E(x) + tau K shift) - Z (v + flow)

    and what `tension_stiffness` and `_taut` add. `shift` is the velocity of the prescribed nodes, which have
    moved already. In air a = 1, and of Z v only the inertia's part is left; the flow acts on the drag's part alone.
    """
    program, motion, heading, interval = buffers.program, buffers.motion, step_input.heading, step_input.interval
    before, start, last, about = motion.before, motion.start, motion.last, motion.about
    nodes, dimension = start.shape
    blocks, couplings, linear = program.blocks, program.couplings, program.linear
    drag, drag_linear, weights, bands = buffers.drag, buffers.drag_linear, rod.weights, rod.bands
    gravity, flow, unit, damping = rod.gravity, rod.flow, rod.unit, rod.bending_damping
    inertia = rod.mass_per_length / interval
    scale = inertia + rod.drag_across
    rate = rod.bending_stiffness / (scale * unit**4)
    inertia = inertia / scale
    mechanics.metric(about, rod.weights, inertia, rod.drag_across / scale, rod.drag_along / scale, blocks)
    mechanics.bending_gradient(start, heading, rod.clamped, rod.rest_angles, program.work, linear)
    ratio = interval / step_input.last_interval if step_input.last_interval > 0.0 else 0.0
    if inertia > 0.0 or ratio > MAX_STEP_RATIO:
        ratio = 0.0
    leading, trailing = (1.0 + 2.0 * ratio) / (1.0 + ratio), ratio / (1.0 + ratio)
    stiffness = rate * (interval + damping)
    for i in range(nodes):
        for a in range(dimension):
            bending = value = rate * linear[i, a]
            for b in range(dimension):
                value -= trailing * blocks[i, a, b] * last[i, b]
            value -= inertia * weights[i] * (last[i, a] + interval / unit * gravity[a])
            for b in range(dimension):
                value -= blocks[i, a, b] * flow[b] / unit
            linear[i, a] = value + inertia * weights[i] * flow[a] / unit
            drag_linear[i, a] = linear[i, a] - bending
        for a in range(dimension):
            for b in range(dimension):
                blocks[i, a, b] *= leading
                drag[i, a, b] = blocks[i, a, b]
            blocks[i, a, a] += stiffness * bands[0, i]
        for apart in range(1, 4):
            couplings[apart - 1, i] = stiffness * bands[apart, i]
    if damping > 0.0:
        weight = rate * damping / interval
        for i in range(nodes):
            for apart in range(-3, 4):
                if 0 <= i + apart < nodes:
                    band = weight * bands[abs(apart), min(i, i + apart)]
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
    linear, blocks, couplings, multipliers = buffers.linear, buffers.blocks, buffers.couplings, buffers.multipliers
    for i in range(nodes - 1):
        tension = max(multipliers[i], 0.0)
        weight = interval * tension
        for a in range(dimension):
            moved = about[i + 1, a] - start[i + 1, a] - about[i, a] + start[i, a]
            linear[i, a] += tension * moved
            linear[i + 1, a] -= tension * moved
            blocks[i, a, a] += weight
            blocks[i + 1, a, a] += weight
        couplings[0, i] -= weight


@compiled_within
def _solve(buffers: RodBuffers, solver_buffers: banded.SolverBuffers, rows: int, tolerance: float) -> int:
    """Solve the program of the first rows; where the residuals do not pass, again from a cold start.

    Returns:
        See `banded.STATUS`; `STALLED` if neither passes.
    """
    program, u = program_view(buffers.program, rows), buffers.motion.velocities
    multipliers, worst = buffers.program.multipliers[:rows], buffers.residuals
    for attempt in range(2):
        word, _ = banded.solve(program, u, multipliers, solver_buffers)
        residuals = residuals_with(program, u, multipliers, buffers.program.work)
        if max(residuals) <= tolerance:
            for k in range(3):
                worst[k] = max(worst[k], residuals[k])
            return int(word) if attempt == 0 else banded.RESTARTED
        u[:] = 0.0
        multipliers[:] = 0.0
    return banded.STALLED


@compiled_inner
def _accept(buffers: RodBuffers, friction: Vector, rows: int, interval: float) -> None:
    """Accept the velocities and multipliers in the buffers as the solution of the first rows: keep what follows."""
    start, velocities, about = buffers.motion.start, buffers.motion.velocities, buffers.motion.about
    segments = len(about) - 1
    keep_pushes(buffers, rows, segments)
    if knows_friction(friction):
        keep_grips(buffers.program, buffers.grips, rows, segments, friction)
    mechanics.keep_internal_forces(buffers, rows, interval)
    for i in range(len(about)):
        for a in range(about.shape[1]):
            # Known nodes have moved, and have no velocity.
            about[i, a] = start[i, a] + interval * velocities[i, a]


@compiled_within
def _finish(model: StepModel, buffers: RodBuffers, step_input: StepInput, off: float) -> None:
    """Write where the step ends, and the velocities over it; whatever else holds, nothing passes the wall."""
    about, before, unit, end = buffers.motion.about, buffers.motion.before, model.rod.unit, buffers.end
    if off > 1.0:
        move_inside(about, buffers.program.known, (model.workspace.wall_radius - model.rod.radius) / unit)
    for i in range(len(about)):
        for a in range(about.shape[1]):
            end[END, i, a] = about[i, a] * unit
            end[END_VELOCITIES, i, a] = (about[i, a] - before[i, a]) * (unit / step_input.interval)
    link_margins(model.rod, end[END], step_input.heading, buffers.program.work[0], buffers.links)


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
        self, thread: Thread, workspace: Workspace, solver: Solver, tolerance: float, barriers: Sequence[Barrier] = ()
    ) -> None:
        super().__init__(thread, workspace, solver, tolerance, barriers, thread.segments)
        self.buffers = RodBuffers.of(self._program)
        medium = thread.medium
        clamped, sizes = thread.attachment is Attachment.CLAMPED, (float(thread.segment_length), float(self._radius))
        drag = float(medium.drag_across), float(medium.drag_along)
        air = float(medium.mass_per_length), float(medium.bending_damping)
        weights = mechanics.end_corrected_weights(thread.segments)
        bands = mechanics.bending_bands(thread.segments, clamped)
        gravity, flow = self._vector("gravity", medium.gravity), self._vector("flow", medium.flow)
        rest, bending = np.ascontiguousarray(thread.rest_angles), float(thread.bending_stiffness)
        self.rod = mechanics.RodProperties(clamped, *sizes, bending, *drag, *air, gravity, rest, weights, bands, flow)
        first = solver.first if type(solver) is FallbackSolver else solver
        structured = type(first) is BandedSolver  # another one's way of solving is its own
        banded_solver = first if isinstance(first, BandedSolver) else BandedSolver()
        self._solver_buffers = banded_solver.buffers(thread.segments + 1, self.dimension, len(self._program.first))
        self._solve_step, self._force_kernel = TypedKernel(solve_step), TypedKernel(mechanics.write_forces)
        self._link_kernel = TypedKernel(link_margins)
        last_nodes = np.arange(1, self._rows + 1, dtype=np.uint32)
        last_nodes.flags.writeable = False
        no_obstacle, no_bound = constant_column(NO_OBSTACLE, self._rows, "i4"), constant_column(-math.inf, self._rows)
        self._link_columns = last_nodes, no_obstacle, no_bound, constant_column(0.0, 0)
        self._self_contact = next((barrier for barrier in barriers if isinstance(barrier, SelfContact)), None)
        self.touches_itself = self._self_contact is not None
        self._only_self_contact = all(isinstance(barrier, SelfContact) for barrier in barriers)
        self._rough = knows_friction(self.workspace.data.friction)
        self.step_model = StepModel(self.rod, self.workspace.data, float(tolerance), MAX_SOLVES, structured)

    @property
    def nodes_in_contact(self) -> Mask:
        """Which nodes shapes or wall pushed in the last step, at a node or on a chord beside it, shape (n + 1,)."""
        at_nodes, on_chords = self._program.push > 0.0
        at_nodes |= on_chords
        at_nodes[1:] |= on_chords[:-1]
        return np.asarray(at_nodes)

    def _memory(self) -> WarmStart:
        program, grips = self._program, self.buffers.grips
        return program.multipliers[: self._rows], program.push, grips.shape, grips.force

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

        The rows of added barriers are in the program from where the step ends without them and one is not met.
        """
        if state.interval == 0.0:
            self.forget()
        # Compiled code takes contiguous arrays.
        positions = np.ascontiguousarray(state.positions, np.float64)
        velocities = np.ascontiguousarray(state.velocities, np.float64)
        step_input = StepInput(positions, velocities, *drive.arrays(), float(interval), float(state.interval))
        outcomes: list[tuple[str, str]] = []
        before = self.warm_start() if self.added else None
        if self.added:
            self.added.begin(positions, drive, interval)
        progress = self._complete(step_input, self.solve(step_input), outcomes)
        if before is not None:
            try:
                added = self._linearised(self.buffers.motion.about, interval)
            except InvalidInputError:  # of a user's barrier: the step is not taken
                self.restore(before)
                raise
            if added.unmet:
                solves = progress.solves
                model = self.step_model._replace(structured=False, max_solves=solves + MAX_SOLVES)
                progress = self.solve(step_input, solves, math.inf, model=model)
                progress = self._complete(step_input, progress, outcomes, model, added)
        return self._result(step_input, progress, outcomes)

    def _complete(
        self,
        step_input: StepInput,
        progress: StepProgress,
        outcomes: list[tuple[str, str]],
        model: StepModel | None = None,
        added: AddedRows | None = None,
    ) -> StepProgress:
        """Solve what compiled code leaves, with the rows of added barriers, until the step has ended.

        Args:
            step_input: of the step.
            progress: of compiled code.
            outcomes: status and solver of solves, which those of this are added to.
            model: of the solves that follow; None for the formulation's own.
            added: rows that compiled code does not know.
        """
        buffers, motion, interval = self.buffers, self.buffers.motion, step_input.interval
        outcomes.append((banded.STATUS[progress.status], self._solver.name))
        force: Points | None = None
        while progress.code == UNSOLVED:
            rows, off = self._rows + progress.contacts, 0.0
            solution = self._solve(first_rows(self._program, rows), motion.velocities, added)
            outcomes.append((solution.status, solution.solver))
            self._program.multipliers[:rows], pushes = np.split(solution.multipliers, [rows])
            motion.velocities[:] = solution.velocities
            np.maximum(buffers.residuals, solution.residuals, out=buffers.residuals)
            if added is not None:
                force = added.force(pushes, motion.velocities.shape) if self._only_self_contact else None
                added = self._linearised(motion.start + interval * motion.velocities, interval)
                off = added.off
            progress = self.solve(step_input, progress.solves + 1, off, rows, model)
            outcomes.append((banded.STATUS[progress.status], self._solver.name))
        if progress.code == NO_ROOM:
            self._refuse_contacts()
        if force is not None:
            buffers.end[CONTACT] += force
            buffers.tail_load[:] += force[0]
        return progress

    def _linearised(self, about: Points, interval: float) -> AddedRows:
        return self.added.linearised(about, self.buffers.motion.start, self._program.known, interval)

    def _result(self, step_input: StepInput, progress: StepProgress, outcomes: Sequence[tuple[str, str]]) -> StepResult:
        """Return what the buffers have of a step that has ended."""
        buffers, off, solves, barrier = self.buffers, progress.off, progress.solves, self._self_contact
        end, residuals = buffers.end.copy(), Residuals._make(buffers.residuals.tolist())
        state = ThreadState(end[END], end[END_VELOCITIES], step_input.interval)
        status, solver = outcomes[0]
        for outcome in outcomes[1:]:
            status, solver = outcome if status == SOLVED else (status, solver)
        grip, passed = buffers.grips.force.copy() if self._rough else None, False
        if off > 1.0:
            status = f"not converged in {solves} linearisations, off by {off:.1g} times what is allowed; {status}"
            passed = barrier is not None and barrier.passed(step_input.positions, state.positions)
        loads, links = (end, buffers.tail_load.copy()), buffers.links.copy()
        return StepResult(state, solver, status, residuals, solves, off <= 1.0, loads, grip, links, passed)

    def solve(
        self,
        step_input: StepInput,
        solves: int = 0,
        elsewhere: float = 0.0,
        rows: int = 0,
        model: StepModel | None = None,
    ) -> StepProgress:
        """Let compiled code take a step as far as it gets; see `solve_step`. Arrays have to be contiguous."""
        model = self.step_model if model is None else model
        arguments = model, self.buffers, self._solver_buffers, step_input, solves, elsewhere, rows
        return StepProgress._make(self._solve_step(*arguments))

    def separate(self) -> RodFormulation:
        """Return the same formulation with buffers of its own, for the steps of another thread like this one."""
        other = copy(self)
        other._program = StepBuffers.of(self._rows + 1, self.dimension, self._rows)
        other.buffers = RodBuffers.of(other._program)
        other._solver_buffers = BandedSolver().buffers(self._rows + 1, self.dimension, len(self._program.first))
        return other

    def forces(self, result: StepResult, heading: Points) -> mechanics.ThreadForces:
        """Return the forces at the end of a step; see `Formulation`."""
        assert result.loads is not None
        tension, force, (friction, use) = np.empty(self._rows), np.empty(self.dimension), np.zeros((2, self._rows + 1))
        moment, scale = self.write_forces(result.loads, result.state.interval, heading, tension, force)
        if result.grip is not None:
            friction, use = mechanics.friction_of(result.grip)
        return mechanics.ThreadForces(tension, scale * result.loads[0][CONTACT], force, moment, scale * friction, use)

    def write_forces(
        self, loads: tuple[Table, Vector], interval: float, heading: Points, tension: Vector, force: Vector
    ) -> tuple[float, float]:
        """Write tension and force on the needle at the end of a step [s]; see `write_forces` of compiled code."""
        moment, scale = self._force_kernel(self.rod, *loads, interval, np.ascontiguousarray(heading), tension, force)
        return moment, scale

    def warm_up(self) -> None:
        """Load what only some steps need; see `Formulation`."""
        super().warm_up()
        chain = np.outer(np.arange(self._rows + 1.0), np.eye(self.dimension)[0])
        loads = np.array([chain, *np.zeros((3, *chain.shape))]), np.zeros(self.dimension)
        self.write_forces(loads, 1.0, chain[1], np.empty(self._rows), np.empty(self.dimension))

    def strain(self, positions: Points, heading: Points, links: Table | None = None) -> Vector:
        """Return each segment's length over the chord of its arc, less one; see `Formulation`."""
        rows = self._link_margins(positions, heading) if links is None else links
        return np.asarray(rows[5])

    def _link_margins(self, positions: Points, heading: Points) -> Table:
        """Return connectivity, compression, chords and strain; see `link_margins`."""
        points, rows = np.ascontiguousarray(positions), np.empty_like(self.buffers.links)
        self._link_kernel(self.rod, points, np.ascontiguousarray(heading), np.empty(points.shape), rows)
        return rows

    def segment_margins(self, positions: Points, heading: Points, links: Table | None = None) -> list[BarrierMargins]:
        """Return connectivity and compression; see `Formulation`."""
        rows = self._link_margins(positions, heading) if links is None else links
        nodes, obstacle, no_bound, no_normal = self._link_columns
        return [
            BarrierMargins(CONNECTIVITY, nodes, obstacle, rows[0], rows[1], no_bound, no_normal),
            BarrierMargins(COMPRESSION, nodes, obstacle, rows[2], rows[3], no_bound, no_normal),
        ]
