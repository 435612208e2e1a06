"""A step of the formulation `rod` in compiled code: its program, and the solves of the structured solver."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled, compiled_uncounted
from magnetosuture_thread.geometry.obstacles import WorkspaceData
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model import mechanics
from magnetosuture_thread.model.barriers import distance_barrier, moved_inside
from magnetosuture_thread.model.formulations.contact_rows import (
    DEPTH_TOLERANCE,
    contact_rows,
    keep_multipliers,
    stays_clear,
)
from magnetosuture_thread.model.formulations.friction_rows import friction_rows, keep_grips, knows_friction
from magnetosuture_thread.model.formulations.internal_forces import keep_internal_forces
from magnetosuture_thread.model.formulations.step import move_prescribed
from magnetosuture_thread.model.formulations.step_buffers import StepBuffers, program_of
from magnetosuture_thread.model.program import Vector
from magnetosuture_thread.model.solvers import banded

STRAIN_TOLERANCE = 1e-3  # of the segments; beyond it the barriers are linearised once more
COMPLIANCE = 1e-7  # of a segment
FRICTION_TOLERANCE = 0.003  # of the limits of friction; beyond it they are taken from the solve and it is repeated
MAX_FRICTION_SOLVES = 5  # of a step; then the limits are those of the solve before
MAX_STEP_RATIO = 2.0  # of a step to the last one, for the second-order difference to stay stable


class RodProperties(NamedTuple):
    """What stays the same from step to step, for compiled code."""

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
    bands: NDArray[np.float64]
    flow: Vector


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
    nodes: NDArray[np.int64]
    ends: Points
    heading: Points
    interval: float
    last_interval: float


class MotionBuffers(NamedTuple):
    """A step under way, in units of the segment length; kept from step to step, so that none pays for buffers.

    Attributes:
        before: where the nodes are, shape (n + 1, d).
        start: the same with the prescribed nodes moved.
        last: velocities over the last step.
        velocities: those of this step, better with each solve.
        about: where they lead.
        known: the prescribed nodes, shape (n + 1,).
    """

    before: Points
    start: Points
    last: Points
    velocities: Points
    about: Points
    known: NDArray[np.bool_]

    @classmethod
    def of(cls, nodes: int, dimension: int) -> MotionBuffers:
        """Return buffers for every step of a thread."""
        before, start, last, velocities, about = np.zeros((5, nodes, dimension))
        return cls(before, start, last, velocities, about, np.zeros(nodes, dtype=np.bool_))


@compiled_uncounted
def assemble_step(
    solves: int,
    rod: RodProperties,
    buffers: StepBuffers,
    workspace: WorkspaceData,
    motion: MotionBuffers,
    given: StepInput,
    elsewhere: float,
    last_about: Points,
    last_contacts: int,
) -> tuple[int, float, bool]:
    """Write the program about a predicted end point; where that came from a solve and is exact, do not.

    Where the program in the buffers was written about, and how many contacts it has, -1 if that is not known, make it
    cheap to find that out.

    Returns the number of rows of contacts and friction, -1 if there is no room for them; how far off the barriers the
    point is: the strain, the depth, or what barriers from elsewhere are, over what is allowed, 1 or less if it is
    exact; and whether the limits of friction are still to be found.
    """
    about, start, known, interval = motion.about, motion.start, motion.known, given.interval
    segments = len(about) - 1
    mechanics.chord_lengths(about, given.heading, rod.clamped, buffers.chords)
    strain = segment_rows(buffers, about, start, known, interval)
    rough, off = knows_friction(workspace), max(strain / STRAIN_TOLERANCE, elsewhere)
    cheap = solves > 0 and last_contacts >= 0 and not rough and off <= 1.0
    if cheap and stays_clear(buffers, workspace, last_about, about, known, rod.unit, rod.radius):
        return last_contacts, off, False
    contacts, depth = contact_rows(
        buffers, segments, workspace, about, start, known, interval, rod.unit, rod.radius, True
    )
    rubs = False
    if contacts > 0 and rough:
        rubbing, change = friction_rows(buffers, segments, contacts, workspace, motion.before, start, known, interval)
        contacts = contacts + rubbing if rubbing >= 0 else -1
        rubs = change > FRICTION_TOLERANCE and 0 < solves < MAX_FRICTION_SOLVES
    off = max(off, depth / DEPTH_TOLERANCE)
    if contacts >= 0 and (solves == 0 or off > 1.0 or rubs):
        _objective(rod, buffers, motion, given)
    return contacts, off if solves > 0 else np.inf, rubs


@compiled_uncounted
def _objective(rod: RodProperties, buffers: StepBuffers, motion: MotionBuffers, given: StepInput) -> None:
    """Write P and q, with r the bending stiffness over the unit of the metric and D^4.

        P = a Z + r (dt + tau) K,    q = r (grad E(x) + tau K shift) - Z (v + flow)

    and what `tension_stiffness` and `_taut` add. `shift` is the velocity of the prescribed nodes, which have
    moved already. In air a = 1, and of Z v only the inertia's part is left; the flow acts on the drag's part alone.
    """
    about, start, last, heading, interval = motion.about, motion.start, motion.last, given.heading, given.interval
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
                        linear[i, a] += band * (start[i + apart, a] - motion.before[i + apart, a])
    mechanics.tension_stiffness(
        start, heading, rod.clamped, buffers.multipliers, -0.5 * rate, interval, (blocks, couplings, linear)
    )
    _taut(buffers, about, start, interval)


@compiled_uncounted
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


@compiled_uncounted
def segment_rows(
    buffers: StepBuffers, about: Points, start: Points, known: NDArray[np.bool_], interval: float
) -> float:
    """Write the rows  grad h(y)' u = (-h(y) - grad h(y)' (x - y)) / dt; return the largest |h(y)|."""
    nodes, dimension = about.shape
    distance_barrier(about, 1, buffers.chords, buffers.value, buffers.gradient)
    strain = 0.0
    for i in range(nodes - 1):
        begin = min(i, nodes - 3)
        buffers.first[i] = begin
        bound = -buffers.value[i]
        for k in range(3):
            for a in range(dimension):
                bound -= buffers.gradient[i, k, a] * (start[begin + k, a] - about[begin + k, a])
        buffers.lower[i] = buffers.upper[i] = bound / interval
        buffers.compliance[i] = COMPLIANCE
        if known[i] and known[i + 1]:
            # Nothing in the program can change its length, and a tension that tries would bend its neighbours.
            buffers.lower[i], buffers.upper[i], buffers.multipliers[i] = -np.inf, np.inf, 0.0
        else:
            strain = max(strain, abs(buffers.value[i]))
    return strain


ENDED, NO_ROOM, UNSOLVED = range(3)  # how far `solve_step` got


@compiled
def init_step(motion: MotionBuffers, given: StepInput, unit: float) -> None:
    """Begin a step, about where the thread would be if it moved on as it did: a guess of second order.

    Not after a step that was much shorter, where the velocities may be those of a sample's noise, and not
    farther than a segment: then the guess is where the thread is.

    Args:
        motion: written.
        given: the step.
        unit: D [m].
    """
    interval, last_interval = given.interval, given.last_interval
    motion.before[:], motion.last[:] = given.positions / unit, given.velocities / unit
    motion.velocities[:] = motion.last
    motion.start[:], motion.known[:] = move_prescribed(motion.before, given.nodes, given.ends, unit)
    motion.about[:] = motion.start
    if not (last_interval > 0.0 and interval <= MAX_STEP_RATIO * last_interval):
        return
    for i in range(len(motion.start)):
        for a in range(motion.start.shape[1]):
            if not motion.known[i]:
                motion.about[i, a] = motion.start[i, a] + interval * motion.last[i, a]
                if not abs(motion.about[i, a] - motion.start[i, a]) <= 1.0:
                    motion.about[:] = motion.start
                    return


@compiled
def solve_step(
    axes: tuple[int, ...],
    rod: RodProperties,
    buffers: StepBuffers,
    workspace: WorkspaceData,
    solver_buffers: banded.SolverBuffers,
    motion: MotionBuffers,
    positions: Points,
    velocities: Points,
    nodes: NDArray[np.int64],
    ends: Points,
    heading: Points,
    interval: float,
    last_interval: float,
    tolerance: float,
    max_solves: int,
    solves: int,
    elsewhere: float,
) -> tuple[int, int, int, float, int, tuple[float, float, float]]:
    """Linearise and solve until the barriers are exact, or the solves are too many, or as far as it gets.

    A solve that does not halve how far off the barriers are is followed by one that is linearised halfway back.

    Args:
        axes: 0 to d - 1.
        rod: the thread.
        buffers: has the program in the end, and its multipliers.
        workspace: obstacles and wall [m].
        solver_buffers: of the structured solver; one without iterations leaves every solve to the caller.
        motion: where the step has got to; written.
        positions: see `StepInput`, as are the following; one tuple of them costs more when this is called from Python.
        velocities: over the last step.
        nodes: of prescribed motion.
        ends: of these.
        heading: of the needle.
        interval: of the step.
        last_interval: of the last one.
        tolerance: the largest residual with which a solution is accepted.
        max_solves: of a step.
        solves: how many this step has had; with none it sets out.
        elsewhere: how far off the rows are that this code does not know, see `assemble`.

    Returns:
        `ENDED`, `NO_ROOM` for all contacts in the buffers, or `UNSOLVED`, and then the program is there for
        another solver; the number of rows of contacts and friction; solves; how far off the barriers are, see
        `assemble_step`; the first status that is not 0, see `banded.STATUS`; the largest residual of each kind.
    """
    given = StepInput(positions, velocities, nodes, ends, heading, interval, last_interval)
    if solves == 0:
        init_step(motion, given, rod.unit)
    worst, status, segments = (0.0, 0.0, 0.0), 0, len(motion.about) - 1
    last_off, last_about, contacts = np.inf, motion.about.copy(), -1
    while True:
        contacts, off, rubs = assemble_step(
            solves, rod, buffers, workspace, motion, given, elsewhere, last_about, contacts
        )
        if contacts >= 0 and 1.0 < off < np.inf and off > 0.5 * last_off and solves < max_solves:
            # Solves that swing from side to side, as of a chord that turns about a corner: the middle is better.
            motion.about[:] = 0.5 * (motion.about + last_about)
            contacts, _, _ = assemble_step(0, rod, buffers, workspace, motion, given, elsewhere, last_about, -1)
        last_off = off
        last_about[:] = motion.about
        if contacts < 0:
            return NO_ROOM, contacts, solves, off, status, worst
        if (off <= 1.0 and not rubs) or solves == max_solves:
            if off > 1.0:  # whatever else holds, nothing passes the wall
                moved_inside(motion.about, motion.known, (workspace.wall_radius - rod.radius) / rod.unit)
            return ENDED, contacts, solves, off, status, worst
        if solver_buffers.iterations == 0:
            return UNSOLVED, contacts, solves, off, status, worst
        rows = segments + contacts
        program = program_of(buffers, motion.known, rows)
        u, multipliers = motion.velocities.copy(), buffers.multipliers[:rows].copy()
        word, _, found = banded.solve_and_check(axes, program, u, multipliers, solver_buffers)
        if not max(found) <= tolerance:
            return UNSOLVED, contacts, solves, off, status, worst
        accept_step(buffers, workspace, motion, u, multipliers, given.interval)
        worst = (max(worst[0], found[0]), max(worst[1], found[1]), max(worst[2], found[2]))
        status, solves = status if status != 0 else word, solves + 1


@compiled
def accept_step(
    buffers: StepBuffers,
    workspace: WorkspaceData,
    motion: MotionBuffers,
    velocities: Points,
    multipliers: Vector,
    interval: float,
) -> None:
    """Accept a solution: velocities, end positions, and multipliers as the guess for the next step."""
    keep_multipliers(buffers, multipliers, len(velocities) - 1)
    if knows_friction(workspace):
        keep_grips(buffers, multipliers, len(velocities) - 1, workspace)
    moved = motion.start[0] - motion.before[0]
    keep_internal_forces(buffers, motion.known, moved, velocities, multipliers, interval)
    motion.velocities[:] = velocities
    motion.about[:] = motion.start + interval * velocities  # known nodes have moved, and have no velocity
