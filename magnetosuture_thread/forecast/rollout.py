"""The needle, the friction law and the least margins of a forecast, in compiled code."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from magnetosuture_thread.coils.certificate import FilterData, PosedNeedle, pose_needle
from magnetosuture_thread.coils.needle_motion import filter_velocity, moved_needle, needle_margin
from magnetosuture_thread.geometry.chords import MAX_ELONGATION
from magnetosuture_thread.geometry.compiled import compiled, compiled_uncounted, compiled_within
from magnetosuture_thread.geometry.obstacles import WALL, Contacts, WorkspaceData, find_contacts, half_segment_distance
from magnetosuture_thread.geometry.polyline import Indices, Mask, Points, Table, Vector
from magnetosuture_thread.thread.barriers import link_margins
from magnetosuture_thread.thread.mechanics import RodProperties

OBSTACLE_MARGIN, WALL_MARGIN, CONNECTIVITY_MARGIN, COMPRESSION_MARGIN, NEEDLE_MARGIN = range(5)
"""Columns of the margins of a forecast."""
KINDS = ("obstacle", "wall", "connectivity", "compression", "needle")

Pair = tuple[float, float]


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


@compiled_within
def add_pull(
    data: FilterData, drag: DragData, needle: PosedNeedle, velocity: Pair, commanded: float, pull: Vector, added: Vector
) -> None:
    """Approach the motion that the thread's pull adds to that of a tip velocity [m/s]; see `NeedleDrag`.

        c <- c + (c*(F) - c) / (1 + r)

    with the ratio r of the drag that the whole thread would have broadside to the needle's: so the pull of the last
    step, which falls with the needle's velocity, does not make the two swing. The result is bounded by the share of the
    commanded speed [m/s] that the velocity is.
    """
    lever, ex, ey = 0.5 * data.body.chord, needle.chord_x, needle.chord_y
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
    begins = math.isnan(added[0])
    for k in range(3):
        added[k] = full[k] if begins else added[k] + (full[k] - added[k]) / (1.0 + ratio[k])
        limit = speed if k < 2 else (speed / lever if lever > 0.0 else 0.0)
        added[k] = max(-limit, min(limit, added[k]))


@compiled
def step_needle(
    data: FilterData,
    drag: DragData,
    pose: Vector,
    command: Pair,
    slowdown: float,
    interval: float,
    last: Vector,
    pull: Vector,
    added: Vector,
    touched: Mask,
) -> tuple[float, int]:
    """Filter a command at the needle's pose, and move the needle.

    Args:
        data: of the safety filter.
        drag: of the needle.
        pose: tail [m] and heading, written, shape (4,).
        command: velocity of the tip [m/s].
        slowdown: by the thread's friction.
        interval: duration of the step [s].
        last: filtered velocity of the last step, not a number where it is not known; written, shape (2,) [m/s].
        pull: of the thread upon the needle, shape (2,) [N].
        added: what the pull adds to the needle's motion, see `moved_needle`; written, shape (3,).
        touched: written: shapes, then the wall, that changed the velocity, shape (s + 1,).

    Returns:
        The margin of the needle at the pose before, see `needle_margin`, and of which shape it is.
    """
    needle = pose_needle(data, pose[0], pose[1], pose[2], pose[3])
    margin, shape = needle_margin(data, needle)
    elapsed = np.inf if math.isnan(last[0]) else interval
    velocity = filter_velocity(data, needle, command, slowdown, (last[0], last[1]), elapsed, touched)
    if drag.along > 0.0:
        commanded = min(math.hypot(command[0], command[1]), data.max_speed)
        add_pull(data, drag, needle, velocity, commanded, pull, added)
    moved_needle(data, pose, velocity, added, interval)
    last[0], last[1] = velocity
    return margin, shape


@compiled_uncounted
def nodes_under_friction(
    positions: Points,
    last: Points,
    velocities: Points,
    share: float,
    interval: float,
    around: WorkspaceData,
    limit: float,
    contacts: Contacts,
    close: Indices,
    rubbed: Mask,
) -> tuple[int, float]:
    """Write which nodes are closer than a limit to two shapes or more, the needle's aside; see `FrictionLaw`.

    Args:
        positions: nodes, shape (n + 1, 2) [m].
        last: where they were; written, as positions are.
        velocities: averaged over time, see `NodeMotion`; written, shape (n + 1, 2) [m/s].
        share: of the new velocity in the average.
        interval: since `last` [s].
        around: shapes, with a reach of at least the limit.
        limit: distance of a node from a shape [m].
        contacts: memory.
        close: memory, shape (n + 1,).
        rubbed: written, shape (n + 1,).

    Returns:
        How many nodes they are, and the greatest speed of them [m/s].
    """
    close[:] = 0
    for c in range(find_contacts(positions, around, contacts)):
        if contacts.obstacle[c] != WALL and contacts.nearest[c] and contacts.distance[c] < limit:
            close[contacts.node[c]] += 1
    count, fastest = 0, 0.0
    for i in range(len(close)):
        for a in range(2):
            velocities[i, a] += share * ((positions[i, a] - last[i, a]) / interval - velocities[i, a])
            last[i, a] = positions[i, a]
        rubbed[i] = i > 0 and close[i] >= 2
        if rubbed[i]:
            count, fastest = count + 1, max(fastest, math.hypot(velocities[i, 0], velocities[i, 1]))
    return count, fastest


@compiled_uncounted
def least_margins(
    rod: RodProperties,
    around: WorkspaceData,
    vertices: Table,
    headings: Points,
    contacts: Contacts,
    work: Table,
    rows: Table,
    margin: Table,
    node: Indices,
    shape: Indices,
) -> bool:
    """Write the least margin of each kind of the thread at each instant, where it is and of which shape.

    Args:
        rod: the thread.
        around: shapes and wall, with the reach of the margins.
        vertices: shape (k, n + 1, 2) [m].
        headings: of the needle, shape (k, 2).
        contacts: memory.
        work: memory, shape (n + 1, 2).
        rows: memory, shape (6, n).
        margin: written, inf before, shape (k, 5) [m]; see `KINDS`.
        node: written, shape (k, 5).
        shape: written, shape (k, 5).

    Returns:
        Whether there was room for all contacts.
    """
    for k in range(len(vertices)):
        points, least = vertices[k], margin[k]
        link_margins(rod, points, headings[k], work, rows)
        for kind in (CONNECTIVITY_MARGIN, COMPRESSION_MARGIN):
            for i in range(rows.shape[1]):
                left = rows[1, i] if kind == CONNECTIVITY_MARGIN else rows[3, i]
                if left < least[kind]:
                    least[kind], node[k, kind] = left, i + 1
        count = find_contacts(points, around, contacts)
        if count < 0:
            return False
        for part in range(2):
            for c in range(count):
                i, o, clearance = contacts.node[c], contacts.obstacle[c], contacts.distance[c] - rod.radius
                kind = WALL_MARGIN if o == WALL else OBSTACLE_MARGIN
                # No point of a half segment is nearer than its node by more than its length.
                if part == 1 and clearance - MAX_ELONGATION * 0.5 * rod.unit < least[kind]:
                    clearance = half_segment_distance(points, i, o, contacts.distance[c], around) - rod.radius
                if clearance < least[kind]:
                    least[kind], node[k, kind], shape[k, kind] = clearance, i, o
    return True
