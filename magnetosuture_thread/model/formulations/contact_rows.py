"""The rows of a step's program that keep the thread out of obstacles and wall, at its nodes and between them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled_uncounted
from magnetosuture_thread.geometry.obstacles import WorkspaceData, find_contacts
from magnetosuture_thread.geometry.obstacles.chords import ChordContacts, find_chord_contacts
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.formulations.step_buffers import StepBuffers
from magnetosuture_thread.model.program import SPAN, Vector

DEPTH_TOLERANCE = 1e-7  # m; a node deeper in an obstacle or the wall than is asked for is not where its barrier holds
CONTACT_COMPLIANCE = 1e-7  # compliance of a contact that has to push a node out


@compiled_uncounted
def contact_rows(
    buffers: StepBuffers,
    row: int,
    workspace: WorkspaceData,
    about: Points,
    start: Points,
    known: NDArray[np.bool_],
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
        known: nodes that have no rows, as nothing can push them, shape (n + 1,).
        interval: dt [s].
        unit: D [m].
        radius: rho [m].
        chords: whether there are rows of places between nodes.

    Returns:
        The number of rows, -1 if there is no room for them, and the greatest depth of a contact [m].
    """
    nodes, dimension = about.shape
    points, minimum = buffers.work[0], buffers.work[1]
    for i in range(nodes):
        minimum[i, 0] = minimum[i, 1] = np.inf
        for a in range(dimension):
            points[i, a] = about[i, a] * unit
    found = find_contacts(
        points, workspace, buffers.node, buffers.obstacle, buffers.distance, buffers.normal, buffers.nearest
    )
    buffers.clearance[:] = workspace.reach
    for c in range(found):
        buffers.place[c] = 0.0
        buffers.clearance[buffers.node[c]] = min(buffers.clearance[buffers.node[c]], buffers.distance[c])
    if found > 0 and chords:
        to = ChordContacts(buffers.node, buffers.obstacle, buffers.distance, buffers.normal, buffers.place)
        found = find_chord_contacts(points, workspace, unit, radius, buffers.clearance, found, to)
    if found < 0 or row + found > len(buffers.first):
        return -1, 0.0
    kept, depth = 0, 0.0
    for c in range(found):
        i, s = buffers.node[c], buffers.place[c]
        if known[i] and (s == 0.0 or known[i + 1]):
            continue
        kind = 0 if s == 0.0 else 1
        minimum[i, kind] = min(minimum[i, kind], buffers.distance[c] - radius)
        clearance = buffers.distance[c] - radius
        depth = max(depth, -clearance)
        bound = -clearance / unit
        begin, here = min(i, nodes - 3), row + kept
        for k in range(SPAN):
            weight = 1.0 - s if begin + k == i else (s if begin + k == i + 1 else 0.0)
            for a in range(dimension):
                buffers.gradient[here, k, a] = weight * buffers.normal[c, a]
                bound -= buffers.gradient[here, k, a] * (start[begin + k, a] - about[begin + k, a])
            if known[begin + k]:
                buffers.gradient[here, k] = 0.0
        buffers.first[here], buffers.value[here] = begin, clearance / unit
        buffers.lower[here], buffers.upper[here] = bound / interval, np.inf
        # A node that has to be pushed out may be held in by something else, as a chord may by its ends, that lie on
        # both sides of a shape: then as far as it goes.
        buffers.compliance[here] = CONTACT_COMPLIANCE if bound > 0.0 or s > 0.0 else 0.0
        buffers.limit[here] = np.inf
        buffers.node[kept], buffers.obstacle[kept], buffers.place[kept] = i, buffers.obstacle[c], s
        for a in range(dimension):
            buffers.normal[kept, a] = buffers.normal[c, a]
        kept += 1
    # What pushed a node or a chord pushes it again; of several corners beside a chord, the nearest one does.
    for c in range(kept):
        kind, i = 0 if buffers.place[c] == 0.0 else 1, buffers.node[c]
        pushes = buffers.value[row + c] * unit <= max(minimum[i, kind], DEPTH_TOLERANCE)
        buffers.multipliers[row + c] = buffers.push[kind, i] if pushes else 0.0
    return kept, depth


@compiled_uncounted
def stays_clear(
    buffers: StepBuffers,
    workspace: WorkspaceData,
    before: Points,
    about: Points,
    known: NDArray[np.bool_],
    unit: float,
    radius: float,
) -> bool:
    """Return whether no contact is deeper than `DEPTH_TOLERANCE`, once nodes have moved since rows were written.

    A distance changes by no more than a node moves. So it is computed again only of nodes and chords that may have got
    too close by that; a solve that ends a step moves them by micrometres.

    Args:
        buffers: its clearances are of `before`, and become those of `about` or less; contacts are overwritten.
        workspace: obstacles and wall [m].
        before: where rows were written, shape (n + 1, d) [D].
        about: where the nodes are, shape (n + 1, d) [D].
        known: nodes that have no rows, shape (n + 1,).
        unit: D [m].
        radius: rho [m].
    """
    points, clearance, minimum = buffers.work[0], buffers.clearance, radius - DEPTH_TOLERANCE
    for i in range(len(about)):
        for a in range(about.shape[1]):
            points[i, a] = about[i, a] * unit
    to = ChordContacts(buffers.node, buffers.obstacle, buffers.distance, buffers.normal, buffers.place)
    for i in range(len(about)):
        square = 0.0
        for a in range(about.shape[1]):
            square += (about[i, a] - before[i, a]) ** 2
        clearance[i] -= unit * math.sqrt(square)
        if not (clearance[i] >= minimum or known[i]):
            found = find_contacts(
                points[i : i + 1], workspace, to.node, to.obstacle, to.distance, to.normal, buffers.nearest
            )
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


@compiled_uncounted
def keep_multipliers(buffers: StepBuffers, multipliers: Vector, rows: int) -> None:
    """Keep multipliers as a guess for the next solve; of the contacts, from row `rows` on, the largest of each node.

    Of these also their forces, with those of friction.
    """
    for r in range(len(multipliers)):
        buffers.multipliers[r] = multipliers[r]
    buffers.push[:] = 0.0
    buffers.contact_force[:] = 0.0
    for r in range(rows, len(multipliers)):
        if buffers.limit[r] == np.inf:
            node, kind = buffers.node[r - rows], 0 if buffers.place[r - rows] == 0.0 else 1
            buffers.push[kind, node] = max(buffers.push[kind, node], multipliers[r])
        for k in range(SPAN):
            for a in range(buffers.contact_force.shape[1]):
                buffers.contact_force[buffers.first[r] + k, a] += buffers.gradient[r, k, a] * multipliers[r]
