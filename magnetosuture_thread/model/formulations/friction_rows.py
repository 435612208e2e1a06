"""The rows of Coulomb friction of a step, one for each node and each chord that a shape pushes; in the plane.

A place of the thread, a node or a place s between two, that a shape pushes with the force N n dissipates mu N |t' u(s)|
as it slides with the velocity u(s) along the tangent t of the shape. That is convex in u, and its multiplier is the
force of friction. With N of the solve before, a row of friction is

    t' u(s) + c lambda = c lambda_before,    |lambda| <= mu N

Below its limit the place sticks, at its limit it slides. The compliance c makes the multipliers of many stuck places
along a taut thread unique. As lambda_before is the multiplier of the solve before, a thread at rest does not creep
however long it is held: t' u = 0 as soon as the forces do not change.

Source: Coulomb; M. Jean, J. J. Moreau 1992, contact dynamics. Deviation: the normal force is that of the solve before,
so that the program stays convex, and a step is solved again while that changes; the turning of the thread's
cross-sections is left out of its slip.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled, compiled_inline, compiled_uncounted
from magnetosuture_thread.geometry.obstacles import FRICTION, WorkspaceData
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.formulations.step_buffers import GRIPS, NO_SHAPE, StepBuffers
from magnetosuture_thread.model.program import SPAN, Vector

FRICTION_COMPLIANCE = 1e-7  # as of a segment: far below what can be measured, and exact at once for the solver


@compiled
def knows_friction(workspace: WorkspaceData) -> bool:
    """Return whether any shape or the wall has friction."""
    return bool(workspace.frames[:, FRICTION].max() > 0.0)


@compiled
def friction_rows(
    buffers: StepBuffers,
    row: int,
    contacts: int,
    workspace: WorkspaceData,
    before: Points,
    start: Points,
    known: NDArray[np.bool_],
    interval: float,
) -> tuple[int, float]:
    """Write the rows of friction of what shapes pushed in the last solve and is in contact with them now.

    Args:
        buffers: written, behind the contacts; these must be there already.
        row: the first row of the contacts.
        contacts: how many there are.
        workspace: has the coefficients of friction.
        before: where the nodes are before the step, shape (n + 1, 2) [D].
        start: the same with the prescribed nodes moved [D].
        known: the prescribed nodes, shape (n + 1,).
        interval: dt [s].

    Returns:
        The number of rows, -1 if there is no room for them; and by how much the limits differ from those of the last
        solve, over the greatest of them.
    """
    shape = buffers.grip_shape.shape
    best, aligned = np.full(shape, -1), np.zeros(shape)
    return _write_rows(buffers, row, contacts, workspace, before, start, known, interval, best, aligned)


@compiled_uncounted
def _write_rows(
    buffers: StepBuffers,
    row: int,
    contacts: int,
    workspace: WorkspaceData,
    before: Points,
    start: Points,
    known: NDArray[np.bool_],
    interval: float,
    best: NDArray[np.int64],
    aligned: NDArray[np.float64],
) -> tuple[int, float]:
    """Write the rows of `friction_rows`, with memory for the best contact of each grip and its push, -1 and 0."""
    nodes = buffers.grip.shape[1]
    for c in range(contacts):
        kind, i = 0 if buffers.place[c] == 0.0 else 1, buffers.node[c]
        slot = _slot_of(buffers, kind, i, buffers.obstacle[c])
        if slot >= 0:
            force = buffers.grip[kind, i, slot]
            push = buffers.normal[c, 0] * force[0] + buffers.normal[c, 1] * force[1]
            if push > aligned[kind, i, slot]:
                aligned[kind, i, slot], best[kind, i, slot] = push, c
    count, change, greatest = 0, 0.0, 0.0
    for kind in range(2):
        for i in range(nodes):
            for slot in range(GRIPS):
                shape = buffers.grip_shape[kind, i, slot]
                if shape == NO_SHAPE:
                    continue
                grip, limit, c = buffers.grip[kind, i, slot], 0.0, best[kind, i, slot]
                if c >= 0:
                    limit = workspace.frames[shape + 1, FRICTION] * math.sqrt(grip[0] * grip[0] + grip[1] * grip[1])
                change, greatest = max(change, abs(limit - grip[3])), max(greatest, limit, grip[3])
                if limit == 0.0:
                    continue
                at = contacts + count
                if at >= len(buffers.node):
                    return -1, 0.0
                here, begin, moved = row + at, min(i, nodes - SPAN), 0.0
                buffers.gradient[here] = 0.0
                for k in range(i, i + kind + 1):
                    share = 1.0 if kind == 0 else (1.0 - buffers.place[c] if k == i else buffers.place[c])
                    x, y = -share * buffers.normal[c, 1], share * buffers.normal[c, 0]
                    if known[k]:
                        moved += x * (start[k, 0] - before[k, 0]) + y * (start[k, 1] - before[k, 1])
                    else:
                        buffers.gradient[here, k - begin, 0], buffers.gradient[here, k - begin, 1] = x, y
                buffers.first[here], buffers.value[here] = begin, 0.0
                buffers.lower[here] = buffers.upper[here] = FRICTION_COMPLIANCE * grip[2] - moved / interval
                buffers.compliance[here], buffers.limit[here] = FRICTION_COMPLIANCE, limit
                buffers.multipliers[here] = max(min(grip[2], limit), -limit)
                buffers.node[at], buffers.obstacle[at], buffers.place[at] = i, shape, buffers.place[c]
                count += 1
    return count, change / greatest if greatest > 0.0 else 0.0


@compiled_uncounted
def keep_grips(buffers: StepBuffers, multipliers: Vector, row: int, workspace: WorkspaceData) -> None:
    """Keep the normal forces of a solve, by place and shape, and what friction there was.

    A place that more than `GRIPS` shapes with friction push at once has friction with the first of them.

    Args:
        buffers: the program's; written.
        multipliers: of all its rows, shape (r,).
        row: the first row of the contacts.
        workspace: has the coefficients of friction.
    """
    buffers.grip[:] = 0.0
    for r in range(row, len(multipliers)):
        i, shape, place = buffers.node[r - row], buffers.obstacle[r - row], buffers.place[r - row]
        kind = 0 if place == 0.0 else 1
        slot = _slot_of(buffers, kind, i, shape)
        if buffers.limit[r] < np.inf:
            buffers.grip[kind, i, slot, 2] = multipliers[r]
            buffers.grip[kind, i, slot, 3] = buffers.limit[r]
            buffers.grip[kind, i, slot, 4] = place
            continue
        if not (multipliers[r] > 0.0 and workspace.frames[shape + 1, FRICTION] > 0.0):
            continue
        if slot < 0:
            slot = _slot_of(buffers, kind, i, NO_SHAPE)
        if slot >= 0:
            buffers.grip_shape[kind, i, slot] = shape
            for a in range(2):
                buffers.grip[kind, i, slot, a] += multipliers[r] * buffers.normal[r - row, a]
    for kind in range(2):
        for i in range(buffers.grip.shape[1]):
            for slot in range(GRIPS):
                if buffers.grip[kind, i, slot, 0] == 0.0 and buffers.grip[kind, i, slot, 1] == 0.0:
                    buffers.grip_shape[kind, i, slot] = NO_SHAPE
                    buffers.grip[kind, i, slot] = 0.0


@compiled_inline
def _slot_of(buffers: StepBuffers, kind: int, node: int, shape: int) -> int:
    """Return which of the shapes of a node (kind 0) or of a chord (kind 1) this is, -1 for none."""
    for slot in range(GRIPS):
        if buffers.grip_shape[kind, node, slot] == shape:
            return slot
    return -1


def friction_of(grip: NDArray[np.float64]) -> tuple[Vector, Vector]:
    """Return friction on each node, that of chords shared by their nodes, and the greatest ratio to its limit.

    Args:
        grip: as in `StepBuffers`.
    """
    rubbed, limit, place = np.abs(grip[..., 2]), grip[..., 3], grip[..., 4]
    ratio = np.divide(rubbed, limit, out=np.zeros_like(limit), where=limit > 0.0).max(axis=2)
    first, second = ((1.0 - place) * rubbed).sum(axis=2), (place * rubbed).sum(axis=2)
    friction, use = first[0] + first[1], np.maximum(ratio[0], ratio[1])
    friction[1:] += second[1, :-1]
    use[1:] = np.maximum(use[1:], ratio[1, :-1])
    return friction, use
