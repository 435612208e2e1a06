"""A step of the formulation `rod` in compiled code: its program, and the solves of the structured solver."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from magnetosuture_thread.compiled import compiled_inline, compiled_inner, compiled_uncounted
from magnetosuture_thread.geometry.obstacles import WorkspaceData
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread import banded, mechanics
from magnetosuture_thread.thread.barriers import move_inside
from magnetosuture_thread.thread.contact_rows import (
    DEPTH_TOLERANCE,
    contact_rows,
    friction_rows,
    keep_grips,
    keep_multipliers,
    knows_friction,
    stays_clear,
)
from magnetosuture_thread.thread.forces import keep_internal_forces
from magnetosuture_thread.thread.program import Indices, Mask, Table, Vector
from magnetosuture_thread.thread.step_buffers import StepBuffers, program_view

STRAIN_TOLERANCE = 1e-3  # of the segments; beyond it the barriers are linearised once more
COMPLIANCE = 1e-7  # of a segment
FRICTION_TOLERANCE = 0.003  # of the limits of friction; beyond it they are taken from the solve and it is repeated
MAX_FRICTION_SOLVES = 5  # of a step; then the limits are those of the solve before
MAX_SOLVES = 8  # of a step
MAX_STEP_RATIO = 2.0  # of a step to the last one, for the second-order difference to stay stable
ENDED, NO_ROOM, UNSOLVED = range(3)  # how far `solve_step` got


class RodProperties(NamedTuple):
    """What stays the same from step to step, for compiled code; D is the segment length.

    Attributes:
        clamped: whether the thread leaves along the needle's axis.
        unit: D [m].
        radius: rho, of the thread [m].
        bending_stiffness: EI [N m^2].
        drag_across: zeta_perp [Pa s].
        drag_along: zeta_par [Pa s].
        mass_per_length: mu [kg/m].
        bending_damping: tau [s].
        gravity: shape (d,) [m/s^2].
        rest_angles: theta_i, shape (n - 1,) [rad].
        weights: of the nodes, see `mechanics.end_corrected_weights`, shape (n + 1,).
        bands: of the bending Hessian, see `mechanics.bending_bands`, shape (4, n + 1).
        flow: w of the medium, shape (d,) [m/s].
    """

    clamped: bool
    unit: float
    radius: float
    bending_stiffness: float
    drag_across: float
    drag_along: float
    mass_per_length: float
    bending_damping: float
    gravity: Vector
    rest_angles: Vector
    weights: Vector
    bands: Table
    flow: Vector


class StepModel(NamedTuple):
    """The thread and what is around it, for compiled code.

    Attributes:
        axes: 0 to d - 1.
        rod: the thread.
        workspace: obstacles and wall, with the reach of the program's rows [m].
        tolerance: the largest residual with which a solution is accepted.
        max_solves: of a step.
        structured: whether the structured solver is to solve; if not, every solve is left to the caller.
    """

    axes: banded.Axes
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


@compiled_inner
def assemble_step(
    solves: int,
    model: StepModel,
    buffers: StepBuffers,
    given: StepInput,
    elsewhere: float,
    last_contacts: int,
) -> tuple[int, float, bool]:
    """Write the program about a predicted end point; where that came from a solve and is exact, do not.

    Where the program in the buffers was written about, `last_about`, and how many contacts it has, -1 if that is not
    known, make it cheap to find that out.

    Returns the number of rows of contacts and friction, -1 if there is no room for them; how far off the barriers the
    point is: the strain, the depth, or what barriers from elsewhere are, over what is allowed, 1 or less if it is
    exact; and whether the limits of friction are still to be found.
    """
    about, start, known, interval = buffers.about, buffers.start, buffers.known, given.interval
    rod, workspace, segments = model.rod, model.workspace, len(buffers.about) - 1
    mechanics.chord_lengths(about, given.heading, rod.clamped, buffers.chords)
    strain = segment_rows(buffers, about, start, known, interval)
    rough, off = knows_friction(workspace), max(strain / STRAIN_TOLERANCE, elsewhere)
    cheap = solves > 0 and last_contacts >= 0 and not rough and off <= 1.0
    if cheap and stays_clear(buffers, workspace, buffers.last_about, about, known, rod.unit, rod.radius):
        return last_contacts, off, False
    contacts, depth = contact_rows(
        buffers, segments, workspace, about, start, known, interval, rod.unit, rod.radius, True
    )
    rubs = False
    if contacts > 0 and rough:
        rubbing, change = friction_rows(buffers, segments, contacts, workspace, interval)
        contacts = contacts + rubbing if rubbing >= 0 else -1
        rubs = change > FRICTION_TOLERANCE and 0 < solves < MAX_FRICTION_SOLVES
    off = max(off, depth / DEPTH_TOLERANCE)
    if contacts >= 0 and (solves == 0 or off > 1.0 or rubs):
        _objective(rod, buffers, given)
    return contacts, off if solves > 0 else np.inf, rubs


@compiled_inner
def _objective(rod: RodProperties, buffers: StepBuffers, given: StepInput) -> None:
    """Write P and q, with r the bending stiffness over the unit of the metric and D^4.

        P = a Z + r (dt + tau) K,    q = r (grad E(x) + tau K shift) - Z (v + flow)

    and what `tension_stiffness` and `_taut` add. `shift` is the velocity of the prescribed nodes, which have
    moved already. In air a = 1, and of Z v only the inertia's part is left; the flow acts on the drag's part alone.
    """
    about, start, last, heading, interval = buffers.about, buffers.start, buffers.last, given.heading, given.interval
    nodes, dimension = start.shape
    blocks, couplings, linear = buffers.blocks, buffers.couplings, buffers.linear
    inertia = rod.mass_per_length / interval
    scale = inertia + rod.drag_across
    rate = rod.bending_stiffness / (scale * rod.unit**4)
    inertia = inertia / scale
    mechanics.metric(about, rod.weights, inertia, rod.drag_across / scale, rod.drag_along / scale, blocks)
    mechanics.bending_gradient(start, heading, rod.clamped, rod.rest_angles, buffers.work, linear)
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
                        linear[i, a] += band * (start[i + apart, a] - buffers.before[i + apart, a])
    mechanics.tension_stiffness(
        start, heading, rod.clamped, buffers.multipliers, -0.5 * rate, interval, (blocks, couplings, linear)
    )
    _taut(buffers, about, start, interval)


@compiled_inner
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
        buffers.first[i], buffers.value[i] = begin, 0.5 * (buffers.chords[i] ** 2 - square)
        buffers.lower[i] = buffers.upper[i] = (-buffers.value[i] - moved) / interval
        buffers.compliance[i] = COMPLIANCE
        if known[i] and known[i + 1]:
            # Nothing in the program can change its length, and a tension that tries would bend its neighbours.
            buffers.lower[i], buffers.upper[i], buffers.multipliers[i] = -np.inf, np.inf, 0.0
        else:
            strain = max(strain, abs(buffers.value[i]))
    return strain


@compiled_inner
def init_step(buffers: StepBuffers, given: StepInput, unit: float) -> None:
    """Begin a step, about where the thread would be if it moved on as it did: a guess of second order.

    Not after a step that was much shorter, where the velocities may be those of a sample's noise, and not
    farther than a segment: then the guess is where the thread is.

    Args:
        buffers: written.
        given: the step.
        unit: D [m].
    """
    interval, last_interval = given.interval, given.last_interval
    nodes, dimension = given.positions.shape
    buffers.known[:] = False
    for i in range(nodes):
        for a in range(dimension):
            buffers.before[i, a] = buffers.start[i, a] = given.positions[i, a] / unit
            buffers.last[i, a] = buffers.velocities[i, a] = given.velocities[i, a] / unit
    for k in range(len(given.nodes)):
        buffers.known[given.nodes[k]] = True
        for a in range(dimension):
            buffers.start[given.nodes[k], a] = given.ends[k, a] / unit
    copy_points(buffers.start, buffers.about)
    if not (last_interval > 0.0 and interval <= MAX_STEP_RATIO * last_interval):
        return
    for i in range(nodes):
        for a in range(dimension):
            if not buffers.known[i]:
                buffers.about[i, a] = buffers.start[i, a] + interval * buffers.last[i, a]
                if not abs(buffers.about[i, a] - buffers.start[i, a]) <= 1.0:
                    copy_points(buffers.start, buffers.about)
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


@compiled_uncounted
def solve_step(
    model: StepModel,
    buffers: StepBuffers,
    solver_buffers: banded.SolverBuffers,
    given: StepInput,
    solves: int,
    elsewhere: float,
) -> StepProgress:
    """Linearise and solve until the barriers are exact, or the solves are too many, or as far as it gets.

    A solve whose residuals do not pass is repeated from a cold start. One that does not halve how far off the barriers
    are is followed by one that is linearised halfway back.

    Args:
        model: the thread and what is around it.
        buffers: the step under way; it has the program in the end, and its multipliers.
        solver_buffers: of the structured solver.
        given: the step.
        solves: how many this step has had; with none it begins.
        elsewhere: how far off the rows are that this code does not know, see `assemble_step`.
    """
    workspace, about, last_about = model.workspace, buffers.about, buffers.last_about
    if solves == 0:
        init_step(buffers, given, model.rod.unit)
    copy_points(about, last_about)
    primal, dual, complementarity, segments = 0.0, 0.0, 0.0, len(about) - 1
    # Numbers of a type of their own: a function is compiled again for each number that is written out.
    first, unknown, status = np.int64(0), np.int64(-1), np.int64(banded.SOLVED)
    last_off, contacts, code, u = np.inf, unknown, UNSOLVED, buffers.trial
    while True:
        contacts, off, rubs = assemble_step(solves, model, buffers, given, elsewhere, contacts)
        if contacts >= 0 and 1.0 < off < np.inf and off > 0.5 * last_off and solves < model.max_solves:
            # Solves that swing from side to side, as of a chord that turns about a corner: the middle is better.
            for i in range(len(about)):
                for a in range(about.shape[1]):
                    about[i, a] = 0.5 * (about[i, a] + last_about[i, a])
            contacts, _, _ = assemble_step(first, model, buffers, given, elsewhere, unknown)
        last_off = off
        copy_points(about, last_about)
        if contacts < 0:
            code = NO_ROOM
            break
        if (off <= 1.0 and not rubs) or solves == model.max_solves:
            if off > 1.0:  # whatever else holds, nothing passes the wall
                move_inside(about, buffers.known, (workspace.wall_radius - model.rod.radius) / model.rod.unit)
            code = ENDED
            break
        if not model.structured:
            break
        program = program_view(buffers, buffers.known, segments + contacts)
        multipliers = buffers.trial_multipliers[: segments + contacts]
        copy_points(buffers.velocities, u)
        for r in range(len(multipliers)):
            multipliers[r] = buffers.multipliers[r]
        word, _, found = banded.solve_and_check(model.axes, program, u, multipliers, solver_buffers)
        if not max(found) <= model.tolerance:
            u[:] = 0.0
            multipliers[:] = 0.0
            _, _, found = banded.solve_and_check(model.axes, program, u, multipliers, solver_buffers)
            if not max(found) <= model.tolerance:
                break
            word = banded.RESTARTED
        accept_step(buffers, workspace, u, multipliers, given.interval)
        primal, dual, complementarity = max(primal, found[0]), max(dual, found[1]), max(complementarity, found[2])
        status, solves = status if status != 0 else word, solves + 1
    return StepProgress(code, contacts, solves, off, status, (primal, dual, complementarity))


@compiled_uncounted
def accept_step(
    buffers: StepBuffers, workspace: WorkspaceData, velocities: Points, multipliers: Vector, interval: float
) -> None:
    """Accept a solution: velocities, end positions, and multipliers as the guess for the next step."""
    keep_multipliers(buffers, multipliers, len(velocities) - 1)
    if knows_friction(workspace):
        keep_grips(buffers, multipliers, len(velocities) - 1, workspace)
    keep_internal_forces(buffers, velocities, multipliers, interval)
    for i in range(len(velocities)):
        for a in range(velocities.shape[1]):
            buffers.velocities[i, a] = velocities[i, a]
            # Known nodes have moved, and have no velocity.
            buffers.about[i, a] = buffers.start[i, a] + interval * velocities[i, a]
