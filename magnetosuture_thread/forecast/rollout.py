"""A forecast in compiled code: needle, safety filter and thread, step after step, and what is recorded of each."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from magnetosuture_thread.coils.certificate import FilterData, pose_needle
from magnetosuture_thread.coils.needle_motion import (
    filter_velocity,
    moved_needle,
    needle_margin,
)
from magnetosuture_thread.geometry.chords import MAX_ELONGATION
from magnetosuture_thread.geometry.compiled import compiled, compiled_uncounted_without_gil, compiled_within
from magnetosuture_thread.geometry.obstacles import WALL, Contacts, WorkspaceData, find_contacts, half_segment_distance
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread import mechanics
from magnetosuture_thread.thread.banded import SolverBuffers
from magnetosuture_thread.thread.forces import write_forces
from magnetosuture_thread.thread.program import (
    ABOUT,
    BEFORE,
    Indices,
    Mask,
    RodBuffers,
    Table,
    Vector,
)
from magnetosuture_thread.thread.rod import (
    ENDED,
    NO_ROOM,
    StepInput,
    StepModel,
    copy_points,
    solve_step,
)

OBSTACLE_MARGIN, WALL_MARGIN, CONNECTIVITY_MARGIN, COMPRESSION_MARGIN, NEEDLE_MARGIN = range(5)
"""Columns of the margins that are recorded."""
KINDS = ("obstacle", "wall", "connectivity", "compression", "needle")
NO_CONTACT = -2
"""In place of a shape: nothing is touched."""

Pair = tuple[float, float]


class FrictionData(NamedTuple):
    """The friction law, see `FrictionLaw`; and the time over which the nodes' speeds are averaged for it."""

    threshold: float = -math.inf
    beta: float = 1.0
    stuck_speed: float = math.inf
    averaging: float = 0.0


class DragData(NamedTuple):
    """The drag of the needle, see `NeedleDrag`; zeros where it follows the filtered velocity exactly.

    Attributes:
        along: with the thread's [N s/m].
        bare: without it [N s/m].
        across: [N s/m].
        turning: [N m s].
        whole: of the whole thread broadside [N s/m].
    """

    along: float = 0.0
    bare: float = 0.0
    across: float = 0.0
    turning: float = 0.0
    whole: float = 0.0


class RolloutModel(NamedTuple):
    """What stays the same from step to step.

    Attributes:
        step: the thread among what is solid.
        around: obstacles and wall, with the reach of the margins.
        needle: the safety filter.
        offset: where the thread is fixed, along the heading and to its left of the needle's tail, shape (2,) [m].
        prescribed: nodes of prescribed motion, 0 first; the others stay where they are, shape (p,).
        max_step: intervals are divided into steps of at most this [s].
        max_way: of a prescribed node in such a step [m].
        max_substeps: into which an interval is divided at the most.
        contact_tolerance: the thread touches a shape or the wall to which it is this close [m].
        friction: the law that slows the needle.
        drag: of the needle.
    """

    step: StepModel
    around: WorkspaceData
    needle: FilterData
    offset: Vector
    prescribed: Indices
    max_step: float
    max_way: float
    max_substeps: int
    contact_tolerance: float
    friction: FrictionData
    drag: DragData


class RolloutState(NamedTuple):
    """Needle and thread while they move; written.

    Attributes:
        positions: of all nodes, shape (n + 1, 2) [m].
        velocities: of all nodes over the last step, shape (n + 1, 2) [m/s].
        averaged: the same, averaged, for the friction law, shape (n + 1, 2) [m/s].
        pose: the needle's tail [m] and heading, shape (4,).
        last: velocity of the tip over the last step [m/s], and duration of the thread's last step, 0 for none [s],
            shape (3,).
        added: motion that the thread's pull adds to the needle's; see `moved_needle`, shape (3,).
    """

    positions: Points
    velocities: Points
    averaged: Points
    pose: Vector
    last: Vector
    added: Vector


class RolloutBuffers(NamedTuple):
    """What a rollout works with.

    Attributes:
        step: of the thread's steps.
        solver: of its solver.
        contacts: of the margins.
        ends: where prescribed nodes begin, end, and are at the end of a step, shape (3, p, 2) [m].
        pose: of the needle before a step, and its heading after a part of it, shape (6,).
        tension: of each segment, shape (n,) [N].
        close: number of shapes that each node is close to, shape (n + 1,).
    """

    step: RodBuffers
    solver: SolverBuffers
    contacts: Contacts
    ends: Table
    pose: Vector
    tension: Vector
    close: Indices


class RolloutRecord(NamedTuple):
    """What is recorded of k steps, and of the instant before them.

    Attributes:
        vertices: shape (k + 1, n + 1, 2) [m].
        poses: of the needle: tail [m] and heading, shape (k + 1, 4).
        filtered: velocity of the tip in each step, shape (k, 2) [m/s].
        touched: shapes, then the wall, that changed it, shape (k + 1, s + 1).
        slowdown: by the thread's friction in each step, shape (k,).
        margin: minimum of each kind, see `KINDS`, shape (k + 1, 5) [m].
        node: where it is, shape (k + 1, 5).
        shape: and of which shape, `WALL` for the wall, shape (k + 1, 5).
        contact: a shape that the thread touches, `NO_CONTACT` for none, and the node, shape (k + 1, 2).
        rubbed: nodes under friction, shape (k + 1, n + 1).
        tension: greatest, shape (k + 1,) [N].
        pull: of the thread upon the needle, shape (k + 1, 2) [N].
        converged: whether the barriers themselves hold, shape (k + 1,).
    """

    vertices: Table
    poses: Table
    filtered: Points
    touched: Mask
    slowdown: Vector
    margin: Table
    node: Indices
    shape: Indices
    contact: Indices
    rubbed: Mask
    tension: Vector
    pull: Points
    converged: Mask

    @classmethod
    def of(cls, steps: int, nodes: int, shapes: int) -> RolloutRecord:
        """Return an empty record."""
        instants, kinds = steps + 1, (steps + 1, len(KINDS))
        return cls(
            vertices=np.empty((instants, nodes, 2)),
            poses=np.empty((instants, 4)),
            filtered=np.zeros((steps, 2)),
            touched=np.zeros((instants, shapes + 1), np.bool_),
            slowdown=np.ones(steps),
            margin=np.full(kinds, np.inf),
            node=np.zeros(kinds, np.int64),
            shape=np.full(kinds, NO_CONTACT),
            contact=np.full((instants, 2), NO_CONTACT),
            rubbed=np.zeros((instants, nodes), np.bool_),
            tension=np.zeros(instants),
            pull=np.zeros((instants, 2)),
            converged=np.ones(instants, np.bool_),
        )


@compiled_within
def divide_motion(model: RolloutModel, buffers: RolloutBuffers, state: RolloutState, interval: float) -> int:
    """Write where prescribed nodes begin and end; return into how many steps `ThreadPredictor` divides the motion."""
    pose, offset, nodes, begin, end = state.pose, model.offset, model.prescribed, buffers.ends[0], buffers.ends[1]
    for k in range(len(nodes)):
        for a in range(2):
            begin[k, a] = end[k, a] = state.positions[nodes[k], a]
    end[0, 0] = pose[0] + offset[0] * pose[2] - offset[1] * pose[3]
    end[0, 1] = pose[1] + offset[0] * pose[3] + offset[1] * pose[2]
    way = math.hypot(end[0, 0] - begin[0, 0], end[0, 1] - begin[0, 1])
    wanted = max(interval / model.max_step, way / model.max_way, 1.0)
    return int(min(float(model.max_substeps), math.ceil(wanted - 1e-9)))


@compiled_within
def move_lead(buffers: RolloutBuffers, pose: Vector, part: float) -> None:
    """Write prescribed nodes and heading at a part of the way from the needle's pose before the step to a pose."""
    begin, end, ends, before = buffers.ends[0], buffers.ends[1], buffers.ends[2], buffers.pose
    for k in range(len(begin)):
        for a in range(2):
            ends[k, a] = begin[k, a] + part * (end[k, a] - begin[k, a])
    x, y = (1.0 - part) * before[2] + part * pose[2], (1.0 - part) * before[3] + part * pose[3]
    size = math.sqrt(x * x + y * y)
    before[4], before[5] = (x / size, y / size) if size > 1e-6 else (pose[2], pose[3])


@compiled_within
def take_step(motion: Table, unit: float, duration: float, state: RolloutState) -> None:
    """Take positions and velocities over from a step of the thread."""
    for i in range(len(state.positions)):
        for a in range(2):
            state.positions[i, a] = motion[ABOUT, i, a] * unit
            state.velocities[i, a] = (motion[ABOUT, i, a] - motion[BEFORE, i, a]) * (unit / duration)
    state.last[2] = duration


@compiled_within
def record_margins(
    model: RolloutModel, buffers: RolloutBuffers, state: RolloutState, k: int, record: RolloutRecord
) -> bool:
    """Record the least margins of the thread at an instant, what it touches, and its nodes under friction.

    Clearances are of nodes and half segments, as those of `Margins`, and say what touches; friction is of nodes.

    Returns:
        Whether the buffers had room for all contacts.
    """
    rod, positions, to = model.step.rod, state.positions, buffers.contacts
    nodes, count = len(positions), 0
    margin, node, shape = record.margin[k], record.node[k], record.shape[k]
    if len(model.around.order) > 0 or model.around.wall_radius < np.inf:
        count = find_contacts(positions, model.around, to)
    if count < 0:
        return False
    close = buffers.close
    close[:] = 0
    for c in range(count):
        clearance, i, o = to.distance[c] - rod.radius, to.node[c], to.obstacle[c]
        kind = WALL_MARGIN if o == WALL else OBSTACLE_MARGIN
        if clearance < margin[kind]:
            margin[kind], node[kind], shape[kind] = clearance, i, o
        if o != WALL and clearance < model.friction.threshold and i > 0 and to.nearest[c]:
            close[i] += 1
    for c in range(count):
        kind, i, o = WALL_MARGIN if to.obstacle[c] == WALL else OBSTACLE_MARGIN, to.node[c], to.obstacle[c]
        # No point of a half segment is nearer than its node by more than its length.
        if to.distance[c] - rod.radius - MAX_ELONGATION * 0.5 * rod.unit < margin[kind]:
            clearance = half_segment_distance(positions, i, o, to.distance[c], model.around) - rod.radius
            if clearance < margin[kind]:
                margin[kind], node[kind], shape[kind] = clearance, i, o
    nearest = OBSTACLE_MARGIN if margin[OBSTACLE_MARGIN] <= margin[WALL_MARGIN] else WALL_MARGIN
    if margin[nearest] <= model.contact_tolerance:
        record.contact[k, 0], record.contact[k, 1] = shape[nearest], node[nearest]
    for i in range(nodes):
        record.rubbed[k, i] = close[i] >= 2
    # Chords of where the thread is: of the last linearisation, that showed that it is there.
    chords = buffers.step.program.chords
    if k == 0:
        mechanics.chord_lengths(buffers.step.motion[ABOUT], state.pose[2:], rod.clamped, chords)
    for i in range(nodes - 1):
        length = math.hypot(positions[i + 1, 0] - positions[i, 0], positions[i + 1, 1] - positions[i, 1])
        for kind in (CONNECTIVITY_MARGIN, COMPRESSION_MARGIN):
            left = rod.unit - length if kind == CONNECTIVITY_MARGIN else length - chords[i] * rod.unit
            if left < margin[kind]:
                margin[kind], node[kind] = left, i + 1
    return True


@compiled_within
def friction_slowdown(model: RolloutModel, state: RolloutState, rubbed: Mask) -> float:
    """Return the factor on the needle's speed of the friction law at an instant."""
    count, fastest = 0, 0.0
    for i in range(len(rubbed)):
        if rubbed[i]:
            count += 1
            fastest = max(fastest, math.hypot(state.averaged[i, 0], state.averaged[i, 1]))
    return float(model.friction.beta**count) if count > 0 and fastest > model.friction.stuck_speed else 1.0


@compiled_within
def add_pull(model: RolloutModel, state: RolloutState, velocity: Pair, commanded: float, pull: Vector) -> None:
    """Approach the motion that the thread's pull adds to that of a tip velocity [m/s]; see `NeedleDrag`.

        c <- c + (c*(F) - c) / (1 + r)

    with the ratio r of the drag that the whole thread would have broadside to the needle's: so the pull of the last
    step, which falls with the needle's velocity, does not make the two swing. The result is bounded by the share of the
    commanded speed [m/s] that the velocity is.
    """
    drag, added, body, pose = model.drag, state.added, model.needle.body, state.pose
    lever = 0.5 * body.chord
    ex, ey = body.chord_x * pose[2] - body.chord_y * pose[3], body.chord_x * pose[3] + body.chord_y * pose[2]
    speed = math.hypot(velocity[0], velocity[1])
    speed *= min(1.0, speed / commanded) if commanded > 0.0 else 0.0
    along, across = pull[0] * ex + pull[1] * ey, pull[1] * ex - pull[0] * ey
    forwards = velocity[0] * ex + velocity[1] * ey
    full = (
        (drag.along * forwards + along) / drag.bare - forwards,
        across / drag.across,
        -lever * across / drag.turning,
    )
    ratio = (drag.whole / drag.bare, drag.whole / drag.across, lever * lever * drag.whole / drag.turning)
    begins = np.isnan(added[0])
    for k in range(3):
        added[k] = full[k] if begins else added[k] + (full[k] - added[k]) / (1.0 + ratio[k])
        limit = speed if k < 2 else (speed / lever if lever > 0.0 else 0.0)
        added[k] = max(-limit, min(limit, added[k]))


@compiled_within
def record_thread(
    model: RolloutModel, buffers: RolloutBuffers, state: RolloutState, k: int, record: RolloutRecord
) -> bool:
    """Record thread, forces and margins at an instant; return whether the buffers had room for all contacts."""
    rod, step, interval = model.step.rod, buffers.step, state.last[2]
    copy_points(state.positions, record.vertices[k])
    for a in range(4):
        record.poses[k, a] = state.pose[a]
    if k == 0:
        for i in range(len(state.positions)):
            for a in range(2):
                step.motion[ABOUT, i, a] = state.positions[i, a] / rod.unit
    if k > 0 and interval > 0.0:
        scale = (rod.drag_across + rod.mass_per_length / interval) * rod.unit**2
        heading, tension = state.pose[2:], buffers.tension
        internal, load, velocities = step.internal, step.tail_load, state.velocities
        write_forces(rod, step.motion[ABOUT], velocities, heading, internal, load, scale, tension, record.pull[k])
        record.tension[k] = tension[0]
        for i in range(len(tension)):
            record.tension[k] = max(record.tension[k], tension[i])
    return record_margins(model, buffers, state, k, record)


@compiled
def filter_at_pose(
    data: FilterData, pose: Vector, command: Pair, slowdown: float, previous: Pair, elapsed: float, touched: Mask
) -> tuple[float, int, float, float]:
    """Return margin and shape of a needle in its pose, see `needle_margin`, and the velocity that its filter leaves."""
    needle = pose_needle(data, pose[0], pose[1], pose[2], pose[3])
    margin, shape = needle_margin(data, needle)
    x, y = filter_velocity(data, needle, command, slowdown, previous, elapsed, touched)
    return margin, shape, x, y


@compiled_uncounted_without_gil
def roll_out(
    model: RolloutModel,
    buffers: RolloutBuffers,
    state: RolloutState,
    commands: Points,
    interval: float,
    first: int,
    last_step: int,
    record: RolloutRecord,
) -> tuple[int, int]:
    """Integrate needle, filter and thread over the steps `first` to `last_step`, the latter not included.

    Args:
        model: what stays the same.
        buffers: as the step before left them; written.
        state: at the begin of the first step; written.
        commands: velocity of the tip in each step, shape (k, 2) [m/s].
        interval: duration of a step [s].
        first: step; before step 0 the instant of the start is recorded.
        last_step: step.
        record: written.

    Returns:
        `ENDED`; `NO_ROOM` for all contacts in the buffers; or `UNSOLVED` where a step of the thread has no solution
        within the tolerance. And the number of steps that are recorded.
    """
    pose, last, averaging = state.pose, state.last, model.friction.averaging
    limited = last[0] == last[0]  # not a number: the velocity before is not known
    share = 1.0 - math.exp(-interval / averaging) if averaging > 0.0 else 1.0
    for k in range(first, last_step + 1):
        if (k > first or k == 0) and not record_thread(model, buffers, state, k, record):
            return NO_ROOM, max(k - 1, 0)
        command, slowdown = (0.0, 0.0), 1.0
        if k < last_step:
            command = (commands[k, 0], commands[k, 1])
            slowdown = record.slowdown[k] = friction_slowdown(model, state, record.rubbed[k])
        elapsed = interval if limited else np.inf
        margin, shape, x, y = filter_at_pose(
            model.needle, pose, command, slowdown, (last[0], last[1]), elapsed, record.touched[k]
        )
        record.margin[k, NEEDLE_MARGIN], record.shape[k, NEEDLE_MARGIN] = margin, shape
        if k == last_step:
            break
        record.filtered[k, 0], record.filtered[k, 1] = x, y
        for a in range(4):
            buffers.pose[a] = pose[a]
        if model.drag.along > 0.0 and (k > 0 or np.isnan(state.added[0])):  # at the start where the pull is known
            commanded = min(math.hypot(command[0], command[1]), model.needle.max_speed)
            add_pull(model, state, (x, y), commanded, record.pull[k])
        moved_needle(model.needle, pose, (x, y), state.added, interval)
        last[0], last[1], limited = x, y, True
        substeps = divide_motion(model, buffers, state, interval)
        duration = interval / substeps
        for index in range(1, substeps + 1):
            move_lead(buffers, pose, index / substeps)
            given = StepInput(
                state.positions,
                state.velocities,
                model.prescribed,
                buffers.ends[2],
                buffers.pose[4:],
                duration,
                last[2],
            )
            done = solve_step(model.step, buffers.step, buffers.solver, given, np.int64(0), 0.0)
            if done.code != ENDED:
                record.converged[k + 1] = False
                return done.code, k
            take_step(buffers.step.motion, model.step.rod.unit, duration, state)
            record.converged[k + 1] = record.converged[k + 1] and done.off <= 1.0
        for i in range(len(state.positions)):
            for a in range(2):
                moved = (state.positions[i, a] - record.vertices[k, i, a]) / interval
                state.averaged[i, a] += share * (moved - state.averaged[i, a])
    return ENDED, last_step
