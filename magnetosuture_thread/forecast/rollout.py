"""A forecast in compiled code: needle, safety filter and thread, step after step, and what is recorded of each."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled, compiled_without_gil
from magnetosuture_thread.forecast.rollout_data import (
    COMPRESSION_MARGIN,
    CONNECTIVITY_MARGIN,
    NEEDLE_MARGIN,
    OBSTACLE_MARGIN,
    WALL_MARGIN,
    RolloutBuffers,
    RolloutModel,
    RolloutRecord,
    RolloutState,
)
from magnetosuture_thread.geometry.obstacles import WALL, find_contacts
from magnetosuture_thread.geometry.obstacles.chords import MAX_ELONGATION
from magnetosuture_thread.geometry.obstacles.half_segments import half_segment_distance
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model import mechanics
from magnetosuture_thread.model.formulations.rod_forces import write_forces
from magnetosuture_thread.model.formulations.rod_step import (
    ENDED,
    NO_ROOM,
    UNSOLVED,
    accept_step,
    solve_step,
)
from magnetosuture_thread.model.formulations.step_buffers import program_of
from magnetosuture_thread.model.solvers import banded
from magnetosuture_thread.safety.certificate import PosedNeedle
from magnetosuture_thread.safety.motion import (
    filter_velocity,
    moved_needle,
    needle_margin,
    pose_needle,
)

MAX_SOLVES = 8  # in a step, as of `RodFormulation`


@compiled
def thread_step(
    model: RolloutModel, buffers: RolloutBuffers, state: RolloutState, ends: Points, heading: Points, interval: float
) -> tuple[int, bool]:
    """Move the prescribed nodes to their ends and let the thread follow, as `RodFormulation.step` does.

    Returns:
        `ENDED`, `NO_ROOM`, or `UNSOLVED` where the structured solver does not get on even from a cold start; and
        whether the barriers themselves hold.
    """
    axes, rod, motion, solves = (0, 1), model.rod, buffers.motion, 0
    while True:
        code, contacts, solves, off, _, _ = solve_step(
            axes,
            rod,
            buffers.step,
            model.near,
            buffers.solver,
            motion,
            state.positions,
            state.velocities,
            model.prescribed,
            ends,
            heading,
            interval,
            state.last[2],
            model.tolerance,
            MAX_SOLVES,
            solves,
            0.0,
        )
        if code == NO_ROOM:
            return NO_ROOM, False
        if code == ENDED:
            break
        rows = len(state.positions) - 1 + contacts
        program = program_of(buffers.step, motion.known, rows)
        u, multipliers = np.zeros(state.positions.shape), np.zeros(rows)
        _, _, found = banded.solve_and_check(axes, program, u, multipliers, buffers.solver)
        if not max(found) <= model.tolerance:
            return UNSOLVED, False
        accept_step(buffers.step, model.near, motion, u, multipliers, interval)
        solves += 1
    state.positions[:] = motion.about * rod.unit
    state.velocities[:] = (motion.about - motion.before) * (rod.unit / interval)
    state.last[2] = interval
    return ENDED, off <= 1.0


@compiled
def follow_needle(
    model: RolloutModel, buffers: RolloutBuffers, state: RolloutState, before: NDArray[np.float64], interval: float
) -> tuple[int, bool]:
    """Let the thread follow the needle from one pose, `before`, to that of the state; as `ThreadPredictor.step` does.

    Returns:
        See `thread_step`.
    """
    pose, offset, nodes = state.pose, model.offset, model.prescribed
    begin, end, ends = np.empty((len(nodes), 2)), np.empty((len(nodes), 2)), np.empty((len(nodes), 2))
    for k in range(len(nodes)):
        begin[k] = state.positions[nodes[k]]
    end[:] = begin
    end[0, 0] = pose[0] + offset[0] * pose[2] - offset[1] * pose[3]
    end[0, 1] = pose[1] + offset[0] * pose[3] + offset[1] * pose[2]
    way = math.hypot(end[0, 0] - begin[0, 0], end[0, 1] - begin[0, 1])
    wanted = max(interval / model.max_step, way / model.max_way, 1.0)
    substeps = int(min(float(model.max_substeps), math.ceil(wanted - 1e-9)))
    converged = True
    for index in range(1, substeps + 1):
        part = index / substeps
        ends[:] = begin + part * (end - begin)
        x, y = (1.0 - part) * before[2] + part * pose[2], (1.0 - part) * before[3] + part * pose[3]
        size = math.sqrt(x * x + y * y)
        heading = np.array([x / size, y / size]) if size > 1e-6 else pose[2:].copy()
        code, holds = thread_step(model, buffers, state, ends, heading, interval / substeps)
        if code != ENDED:
            return code, False
        converged = converged and holds
    return ENDED, converged


@compiled
def record_margins(
    model: RolloutModel, buffers: RolloutBuffers, state: RolloutState, k: int, record: RolloutRecord
) -> bool:
    """Record the least margins of the thread at an instant, what it touches, and its nodes under friction.

    Clearances are of nodes and half segments, as those of `Margins`, and say what touches; friction is of nodes.

    Returns:
        Whether the buffers had room for all contacts.
    """
    rod, positions, to = model.rod, state.positions, buffers.contacts
    nodes, count = len(positions), 0
    margin, node, shape = record.margin[k], record.node[k], record.shape[k]
    if len(model.around.frames) > 1 or model.around.wall_radius < np.inf:
        count = find_contacts(positions, model.around, to.node, to.obstacle, to.distance, to.normal, to.nearest)
    if count < 0:
        return False
    close = np.zeros(nodes, np.int64)
    for c in range(count):
        clearance, i, o = to.distance[c] - rod.radius, to.node[c], to.obstacle[c]
        kind = WALL_MARGIN if o == WALL else OBSTACLE_MARGIN
        if clearance < margin[kind]:
            margin[kind], node[kind], shape[kind] = clearance, i, o
        if o != WALL and clearance < model.friction[0] and i > 0 and to.nearest[c]:
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
    chords = buffers.step.chords  # of where the thread is: of the last linearisation, that showed that it is there
    if k == 0:
        mechanics.chord_lengths(positions / rod.unit, state.pose[2:], rod.clamped, chords)
    for i in range(nodes - 1):
        length = math.hypot(positions[i + 1, 0] - positions[i, 0], positions[i + 1, 1] - positions[i, 1])
        for kind in (CONNECTIVITY_MARGIN, COMPRESSION_MARGIN):
            left = rod.unit - length if kind == CONNECTIVITY_MARGIN else length - chords[i] * rod.unit
            if left < margin[kind]:
                margin[kind], node[kind] = left, i + 1
    return True


@compiled
def friction_slowdown(model: RolloutModel, state: RolloutState, rubbed: NDArray[np.bool_]) -> float:
    """Return the factor on the needle's speed of the friction law at an instant."""
    count, fastest = 0, 0.0
    for i in range(len(rubbed)):
        if rubbed[i]:
            count += 1
            fastest = max(fastest, math.hypot(state.averaged[i, 0], state.averaged[i, 1]))
    return float(model.friction[1] ** count) if count > 0 and fastest > model.friction[2] else 1.0


@compiled
def add_pull(
    model: RolloutModel,
    state: RolloutState,
    needle: PosedNeedle,
    velocity: tuple[float, float],
    commanded: float,
    pull: Points,
) -> None:
    """Approach the motion that the thread's pull adds to that of a tip velocity [m/s]; see `NeedleDrag`.

        c <- c + (c*(F) - c) / (1 + r)

    with the ratio r of the drag that the whole thread would have broadside to the needle's: so the pull of the last
    step, which falls with the needle's velocity, does not make the two swing. The result is bounded by the share of the
    commanded speed [m/s] that the velocity is.
    """
    drag, added, lever = model.drag, state.added, 0.5 * model.needle.body.chord
    ex, ey = needle.chord_x, needle.chord_y
    speed = math.hypot(velocity[0], velocity[1])
    speed *= min(1.0, speed / commanded) if commanded > 0.0 else 0.0
    along, across = pull[0] * ex + pull[1] * ey, pull[1] * ex - pull[0] * ey
    forwards = velocity[0] * ex + velocity[1] * ey
    full = ((drag[0] * forwards + along) / drag[1] - forwards, across / drag[2], -lever * across / drag[3])
    ratio = (drag[4] / drag[1], drag[4] / drag[2], lever * lever * drag[4] / drag[3])
    begins = np.isnan(added[0])
    for k in range(3):
        added[k] = full[k] if begins else added[k] + (full[k] - added[k]) / (1.0 + ratio[k])
        limit = speed if k < 2 else (speed / lever if lever > 0.0 else 0.0)
        added[k] = max(-limit, min(limit, added[k]))


@compiled
def record_instant(
    model: RolloutModel,
    buffers: RolloutBuffers,
    state: RolloutState,
    needle: PosedNeedle,
    k: int,
    record: RolloutRecord,
) -> bool:
    """Record an instant; return whether the buffers had room for all contacts."""
    rod = model.rod
    record.vertices[k], record.poses[k] = state.positions, state.pose
    margin, shape = needle_margin(model.needle, needle)
    record.margin[k, NEEDLE_MARGIN], record.shape[k, NEEDLE_MARGIN] = margin, shape
    interval = state.last[2]
    if k > 0 and interval > 0.0:
        tension = np.empty(len(state.positions) - 1)
        scale = (rod.drag_across + rod.mass_per_length / interval) * rod.unit**2
        step, points = buffers.step, state.positions / rod.unit
        heading, internal, load = state.pose[2:], step.internal, step.tail_load
        write_forces(rod, points, state.velocities, heading, internal, load, scale, tension, record.pull[k])
        record.tension[k] = tension.max()
    return record_margins(model, buffers, state, k, record)


@compiled_without_gil
def roll_out(
    model: RolloutModel,
    buffers: RolloutBuffers,
    state: RolloutState,
    commands: Points,
    interval: float,
    first: int,
    last: int,
    record: RolloutRecord,
) -> tuple[int, int]:
    """Integrate needle, filter and thread over the steps `first` to `last`, the latter not included.

    Args:
        model: what stays the same.
        buffers: as the last step left them; written.
        state: at the begin of the first step; written.
        commands: velocity of the tip in each step, shape (k, 2) [m/s].
        interval: duration of a step [s].
        first: step; before step 0 the instant of the start is recorded.
        last: step.
        record: written.

    Returns:
        `ENDED`; `NO_ROOM` for all contacts in the buffers; or `UNSOLVED` where a step of the thread has no solution
        within the tolerance. And the number of steps that are recorded.
    """
    pose = state.pose
    limited = first > 0 or state.last[0] == state.last[0]  # not a number: the velocity before is not known
    needle = pose_needle(model.needle, pose[0], pose[1], pose[2], pose[3])
    if first == 0 and not record_instant(model, buffers, state, needle, 0, record):
        return NO_ROOM, 0
    averaging = model.friction[3]
    share = 1.0 - math.exp(-interval / averaging) if averaging > 0.0 else 1.0
    for k in range(first, last):
        record.slowdown[k] = friction_slowdown(model, state, record.rubbed[k])
        x, y = filter_velocity(
            model.needle,
            needle,
            (commands[k, 0], commands[k, 1]),
            record.slowdown[k],
            (state.last[0], state.last[1]),
            interval if limited else np.inf,
            record.touched[k],
        )
        record.filtered[k, 0], record.filtered[k, 1] = x, y
        before = pose.copy()
        if model.drag[0] > 0.0 and (k > 0 or np.isnan(state.added[0])):  # at the start where the pull is known
            commanded = min(math.hypot(commands[k, 0], commands[k, 1]), model.needle.max_speed)
            add_pull(model, state, needle, (x, y), commanded, record.pull[k])
        moved_needle(model.needle, pose, (x, y), state.added, interval)
        state.last[0], state.last[1], limited = x, y, True
        code, converged = follow_needle(model, buffers, state, before, interval)
        if code != ENDED:
            return code, k
        for i in range(len(state.positions)):
            for a in range(2):
                moved = (state.positions[i, a] - record.vertices[k, i, a]) / interval
                state.averaged[i, a] += share * (moved - state.averaged[i, a])
        record.converged[k + 1] = converged
        needle = pose_needle(model.needle, pose[0], pose[1], pose[2], pose[3])
        if not record_instant(model, buffers, state, needle, k + 1, record):
            return NO_ROOM, k
    return ENDED, last
