"""The rows of a step's program for contacts with obstacles and wall, at nodes and between them, and for their friction.

Friction is Coulomb's, in the plane. A place of the thread, a node or a place s between two, that a shape pushes with
the force N n dissipates mu N |t' u(s)| as it slides with the velocity u(s) along the tangent t of the shape. That is
convex in u, and its multiplier is the force of friction. With N of the solve before, a row of friction is

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

from magnetosuture_thread.geometry.chords import find_chord_contacts
from magnetosuture_thread.geometry.compiled import compiled_inline, compiled_inner, compiled_uncounted, compiled_within
from magnetosuture_thread.geometry.obstacles import WorkspaceData, find_contacts
from magnetosuture_thread.geometry.polyline import Points, Vector
from magnetosuture_thread.thread.program import CONTACT, GRIPS, NO_SHAPE, SPAN, GripBuffers, RodBuffers, StepBuffers

DEPTH_TOLERANCE = 1e-7  # m; a node deeper in an obstacle or the wall than is asked for is not where its barrier holds


@compiled_uncounted
def contact_rows(
    buffers: StepBuffers,
    row: int,
    workspace: WorkspaceData,
    about: Points,
    start: Points,
    interval: float,
    unit: float,
    radius: float,
    chords: bool,
) -> tuple[int, float]:
    """Write the rows  n' u(s) >= (-h(y) - n' (x - y)(s)) / dt  of the contacts near y, with h = sd(y(s)) - rho.

    A contact is at a node, s = 0, or at a place s between node i and the next, where u(s) = (1 - s) u_i + s u_{i+1},
    and so x and y. In the end their nodes and obstacles, the wall among them, are the first of the buffers's.

    Args:
        buffers: written, from a row on.
        row: the first of these rows.
        workspace: obstacles and wall [m].
        about: y, shape (n + 1, d) [D].
        start: x, shape (n + 1, d) [D].
        interval: dt [s].
        unit: D [m].
        radius: rho [m].
        chords: whether there are rows of places between nodes.

    Returns:
        The number of rows, -1 if there is no room for them, and the greatest depth of a contact [m].
    """
    nodes, dimension = about.shape
    points, minimum, contacts, clearances = buffers.work[0], buffers.work[1], buffers.contacts, buffers.clearance
    # Fields of a large tuple are taken out of it once: to compile each access takes as long as the arithmetic.
    node, obstacle, place = contacts.node, contacts.obstacle, contacts.place
    distance, normal = contacts.distance, contacts.normal
    gradient, lower, upper, push, known = buffers.gradient, buffers.lower, buffers.upper, buffers.push, buffers.known
    first, compliance, limit, multipliers = buffers.first, buffers.compliance, buffers.limit, buffers.multipliers
    for i in range(nodes):
        minimum[i, 0] = minimum[i, 1] = np.inf
        for a in range(dimension):
            points[i, a] = about[i, a] * unit
    found = find_contacts(points, workspace, contacts)
    clearances[:] = workspace.reach
    for c in range(found):
        place[c] = 0.0
        clearances[node[c]] = min(clearances[node[c]], distance[c])
    if found > 0 and chords:
        found = find_chord_contacts(points, workspace, unit, radius, clearances, found, contacts)
    if found < 0 or row + found > len(first):
        return -1, 0.0
    kept, depth = 0, 0.0
    for c in range(found):
        i, s = node[c], place[c]
        if known[i] and (s == 0.0 or known[i + 1]):
            continue
        kind = 0 if s == 0.0 else 1
        clearance = distance[c] - radius
        minimum[i, kind] = min(minimum[i, kind], clearance)
        depth = max(depth, -clearance)
        bound = -clearance / unit
        begin, here = min(i, nodes - 3), row + kept
        for k in range(SPAN):
            weight = 1.0 - s if begin + k == i else (s if begin + k == i + 1 else 0.0)
            for a in range(dimension):
                gradient[here, k, a] = weight * normal[c, a]
                bound -= gradient[here, k, a] * (start[begin + k, a] - about[begin + k, a])
            if known[begin + k]:
                gradient[here, k] = 0.0
        first[here] = begin
        lower[here], upper[here] = bound / interval, np.inf
        # A node that has to be pushed out may be held in by something else, as a chord may by its ends, that lie on
        # both sides of a shape: then as far as it goes.
        compliance[here] = 1e-7 if bound > 0.0 or s > 0.0 else 0.0
        limit[here] = np.inf
        node[kept], obstacle[kept], place[kept] = i, obstacle[c], s
        distance[kept] = distance[c]
        for a in range(dimension):
            normal[kept, a] = normal[c, a]
        kept += 1
    # What pushed a node or a chord pushes it again; of several corners beside a chord, the nearest one does.
    for c in range(kept):
        kind, i = 0 if place[c] == 0.0 else 1, node[c]
        pushes = distance[c] - radius <= max(minimum[i, kind], DEPTH_TOLERANCE)
        multipliers[row + c] = push[kind, i] if pushes else 0.0
    return kept, depth


@compiled_inner
def stays_clear(
    buffers: StepBuffers, workspace: WorkspaceData, before: Points, about: Points, unit: float, radius: float
) -> bool:
    """Return whether no contact is deeper than `DEPTH_TOLERANCE`, once nodes have moved since rows were written.

    A distance changes by no more than a node moves. So it is computed again only of nodes and chords that may have got
    too close by that; a solve that ends a step moves them by micrometres.

    Args:
        buffers: its clearances are of `before`, and become those of `about` or less; contacts are overwritten.
        workspace: obstacles and wall [m].
        before: where rows were written, shape (n + 1, d) [D].
        about: where the nodes are, shape (n + 1, d) [D].
        unit: D [m].
        radius: rho [m].
    """
    points, clearance, minimum, known = buffers.work[0], buffers.clearance, radius - DEPTH_TOLERANCE, buffers.known
    for i in range(len(about)):
        for a in range(about.shape[1]):
            points[i, a] = about[i, a] * unit
    to = buffers.contacts
    for i in range(len(about)):
        square = 0.0
        for a in range(about.shape[1]):
            square += (about[i, a] - before[i, a]) ** 2
        clearance[i] -= unit * math.sqrt(square)
        if not (clearance[i] >= minimum or known[i]):
            found = find_contacts(points[i : i + 1], workspace, to)
            clearance[i] = workspace.reach
            for c in range(found):
                clearance[i] = min(clearance[i], to.distance[c])
            if found < 0 or not clearance[i] >= minimum:
                return False
    found = find_chord_contacts(points, workspace, unit, radius, clearance, 0, to)
    for c in range(found):
        if to.distance[c] < minimum and not (known[to.node[c]] and known[to.node[c] + 1]):
            return False
    return found >= 0


@compiled_within
def keep_pushes(buffers: RodBuffers, rows: int, row: int) -> None:
    """Keep what contacts push nodes and segments with, and their forces with those of friction.

    Args:
        buffers: of the program that was solved, with its multipliers; written.
        rows: of the program.
        row: the first row of the contacts.
    """
    program, contacts, force = buffers.program, buffers.program.contacts, buffers.end[CONTACT]
    first, gradient, multipliers, push = program.first, program.gradient, program.multipliers, program.push
    force[:] = 0.0
    push[:] = 0.0
    for r in range(row, rows):
        if program.limit[r] == np.inf:
            node, kind = contacts.node[r - row], 0 if contacts.place[r - row] == 0.0 else 1
            push[kind, node] = max(push[kind, node], multipliers[r])
        for k in range(SPAN):
            for a in range(force.shape[1]):
                force[first[r] + k, a] += gradient[r, k, a] * multipliers[r]


@compiled_uncounted
def knows_friction(friction: Vector) -> bool:
    """Return whether any shape or the wall has friction."""
    largest = 0.0
    for k in range(len(friction)):
        largest = max(largest, friction[k])
    return largest > 0.0


@compiled_within
def friction_rows(rod: RodBuffers, row: int, count: int, friction: Vector, interval: float) -> tuple[int, float]:
    """Write the rows of friction of what shapes pushed in the last solve and is in contact with them now.

    Args:
        rod: its rows are written behind the contacts; these must be there already.
        row: the first row of the contacts.
        count: how many contacts there are.
        friction: coefficients of the wall, then of each shape.
        interval: dt [s].

    Returns:
        The number of rows, -1 if there is no room for them; and by how much the limits differ from those of the last
        solve, over the greatest of them.
    """
    buffers, grips, known, contacts = rod.program, rod.grips, rod.program.known, rod.program.contacts
    best, before, start = grips.contact, rod.motion.before, rod.motion.start
    shapes, forces, gradient, lower, upper = grips.shape, grips.force, buffers.gradient, buffers.lower, buffers.upper
    node, obstacle, place, normal = contacts.node, contacts.obstacle, contacts.place, contacts.normal
    first, compliance, limits, multipliers = buffers.first, buffers.compliance, buffers.limit, buffers.multipliers
    nodes = len(known)
    best[:] = -1
    for c in range(count):
        kind, i = 0 if place[c] == 0.0 else 1, node[c]
        slot = _slot_of(grips, kind, i, obstacle[c])
        if slot >= 0:
            force, other = forces[kind, i, slot], best[kind, i, slot]
            push = normal[c, 0] * force[0] + normal[c, 1] * force[1]
            least = normal[other, 0] * force[0] + normal[other, 1] * force[1] if other >= 0 else 0.0
            if push > least:
                best[kind, i, slot] = c
    written, change, greatest = 0, 0.0, 0.0
    for kind in range(2):
        for i in range(nodes):
            for slot in range(GRIPS):
                shape = shapes[kind, i, slot]
                if shape == NO_SHAPE:
                    continue
                grip, limit, c = forces[kind, i, slot], 0.0, best[kind, i, slot]
                if c >= 0:
                    limit = friction[shape + 1] * math.sqrt(grip[0] * grip[0] + grip[1] * grip[1])
                change, greatest = max(change, abs(limit - grip[3])), max(greatest, limit, grip[3])
                if limit == 0.0:
                    continue
                at = count + written
                if at >= len(node):
                    return -1, 0.0
                here, begin, moved = row + at, min(i, nodes - SPAN), 0.0
                gradient[here] = 0.0
                for k in range(i, i + kind + 1):
                    share = 1.0 if kind == 0 else (1.0 - place[c] if k == i else place[c])
                    x, y = -share * normal[c, 1], share * normal[c, 0]
                    if known[k]:
                        moved += x * (start[k, 0] - before[k, 0]) + y * (start[k, 1] - before[k, 1])
                    else:
                        gradient[here, k - begin, 0], gradient[here, k - begin, 1] = x, y
                first[here] = begin
                # As of a segment: far below what can be measured, and exact at once for the solver.
                compliance[here], limits[here] = 1e-7, limit
                lower[here] = upper[here] = compliance[here] * grip[2] - moved / interval
                multipliers[here] = max(min(grip[2], limit), -limit)
                node[at], obstacle[at], place[at] = i, shape, place[c]
                written += 1
    return written, change / greatest if greatest > 0.0 else 0.0


@compiled_within
def keep_grips(buffers: StepBuffers, grips: GripBuffers, rows: int, row: int, friction: Vector) -> None:
    """Keep the normal forces of a solve, by place and shape, and what friction there was.

    A place that more than `GRIPS` shapes with friction push at once has friction with the first of them.

    Args:
        buffers: of the program that was solved, with its multipliers.
        grips: written.
        rows: of the program.
        row: the first row of the contacts.
        friction: coefficients of the wall, then of each shape.
    """
    contacts, multipliers, limits = buffers.contacts, buffers.multipliers, buffers.limit
    shapes, forces = grips.shape, grips.force
    forces[:] = 0.0
    for r in range(row, rows):
        i, shape, place = contacts.node[r - row], contacts.obstacle[r - row], contacts.place[r - row]
        kind = 0 if place == 0.0 else 1
        slot = _slot_of(grips, kind, i, shape)
        if limits[r] < np.inf:
            forces[kind, i, slot, 2] = multipliers[r]
            forces[kind, i, slot, 3] = limits[r]
            forces[kind, i, slot, 4] = place
            continue
        if not (multipliers[r] > 0.0 and friction[shape + 1] > 0.0):
            continue
        if slot < 0:
            slot = _slot_of(grips, kind, i, NO_SHAPE)
        if slot >= 0:
            shapes[kind, i, slot] = shape
            for a in range(2):
                forces[kind, i, slot, a] += multipliers[r] * contacts.normal[r - row, a]
    for kind in range(2):
        for i in range(forces.shape[1]):
            for slot in range(GRIPS):
                if forces[kind, i, slot, 0] == 0.0 and forces[kind, i, slot, 1] == 0.0:
                    shapes[kind, i, slot] = NO_SHAPE
                    forces[kind, i, slot] = 0.0


@compiled_inline
def _slot_of(grips: GripBuffers, kind: int, node: int, shape: int) -> int:
    """Return which of the shapes of a node (kind 0) or of a chord (kind 1) this is, -1 for none."""
    for slot in range(GRIPS):
        if grips.shape[kind, node, slot] == shape:
            return slot
    return -1
