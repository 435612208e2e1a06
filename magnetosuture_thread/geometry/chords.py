"""Contacts of a chain's segments, between its nodes: with discs, balls and corners of polygons."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.compiled import compiled_inline, compiled_uncounted, compiled_within
from magnetosuture_thread.geometry.obstacles import EDGE_WIDTH, Contacts, WorkspaceData
from magnetosuture_thread.geometry.polyline import Points

Vector = tuple[float, float, float]
"""A point or a direction; its third coordinate is 0 in the plane."""

CONE = 0.25
"""Sine of the angle by which a segment may lie flatter than what is next to a corner: on a rounded one that is made
of many, a segment turns from one to the next within a step, and has the rows of both."""

REACH = 0.12
"""Part of the nodes' reach within which a chord has a row; where it moves farther in a step, it has one in the next
linearisation."""

MAX_ELONGATION = 2.0
"""Length of a chord over that of its segment, from which on it is only on its way to where it will be."""


class Chord(NamedTuple):
    """A segment: where it begins, its unit direction, and its length [m]."""

    start: Vector
    along: Vector
    length: float


@compiled_inline
def _write(count: int, place: float, distance: float, normal: Vector, node: int, obstacle: int, to: Contacts) -> int:
    """Write a contact; return the new count, -1 if there is no room."""
    if count < 0 or count >= len(to.node):
        return -1
    to.node[count], to.obstacle[count], to.distance[count], to.place[count] = node, obstacle, distance, place
    for a in range(to.normal.shape[1]):
        to.normal[count, a] = normal[a]
    return count + 1


@compiled_within
def _corner(chord: Chord, numbers: NDArray[np.float64], k: int, reach: float) -> tuple[float, float, Vector]:
    """Return place, distance and normal of a polygon's corner, the start of edge k; a place of -1 for none.

    The corner sticks out, its projection is on the chord, and no edge beside it is nearer: the normal, across the
    chord and outwards, lies between those of the edges. A chord on the corner's inner side has a negative distance.
    """
    # Most corners are beside the chord or far from it, so that is asked first.
    x, y = numbers[k] - chord.start[0], numbers[k + 1] - chord.start[1]
    ux, uy, _ = chord.along
    s, aside = x * ux + y * uy, x * uy - y * ux
    none = -1.0, 0.0, chord.along
    if not (0.0 < s < chord.length and abs(aside) <= max(reach, 0.5 * chord.length)):
        return none
    turn = numbers[k + 7] * numbers[k + 5] - numbers[k + 8] * numbers[k + 4]
    sign = 1.0 if ux * numbers[k + 10] - uy * numbers[k + 9] >= 0.0 else -1.0
    nx, ny, distance = -sign * uy, sign * ux, sign * aside
    if (
        not turn > 0.0
        or nx * numbers[k + 4] + ny * numbers[k + 5] > CONE
        or nx * numbers[k + 7] + ny * numbers[k + 8] < -CONE
        or not -0.5 * chord.length < distance <= reach
    ):
        return none
    return s / chord.length, distance, (nx, ny, 0.0)


@compiled_within
def _round(chord: Chord, centre: Vector, reach: float) -> tuple[float, float, Vector]:
    """Return place, distance from the centre and normal of a disc or ball; a place of -1 for none."""
    to = centre[0] - chord.start[0], centre[1] - chord.start[1], centre[2] - chord.start[2]
    s = to[0] * chord.along[0] + to[1] * chord.along[1] + to[2] * chord.along[2]
    x, y, z = s * chord.along[0] - to[0], s * chord.along[1] - to[1], s * chord.along[2] - to[2]
    length = math.sqrt(x * x + y * y + z * z)
    if not (0.0 < s < chord.length and 0.0 < length <= reach):
        return -1.0, 0.0, chord.along
    return s / chord.length, length, (x / length, y / length, z / length)


@compiled_within
def _bulge(points: Points, i: int, s: float, normal: Vector) -> float:
    """Return how far a segment's arc is from its chord at a place s, along a normal: s (1 - s) / 2 of its turn."""
    turn = 0.0
    for j in (i, i + 1):
        if 0 < j < len(points) - 1:
            for a in range(points.shape[1]):
                turn -= 0.5 * normal[a] * (points[j + 1, a] - 2.0 * points[j, a] + points[j - 1, a])
    return 0.5 * s * (1.0 - s) * max(turn, 0.0)


@compiled_uncounted
def find_chord_contacts(
    points: Points,
    data: WorkspaceData,
    segment: float,
    radius: float,
    clearance: NDArray[np.float64],
    count: int,
    to: Contacts,
) -> int:
    """Write where the chords between nodes are closest to what sticks out of obstacles; what nodes touch is not in it.

    The distance from a corner is that of the chord. That from a disc or ball of radius R is of the arc: at a
    place s it lies beyond the chord by what the thread turns there, with second differences c and the normal n, and by
    no more than an arc on the surface, with the thread's radius rho:

        min(-s (1 - s) n . (c_i + c_{i+1}) / 4, (R + rho) (1 - cos(D / (2 (R + rho)))))

    So a straight thread touches with its chords, and around a disc nodes lie on the surface. The wall of a dish needs
    no rows: inside of a circle a chord is farther from it than its ends.

    Args:
        points: nodes, shape (n + 1, d) [m].
        data: `Workspace.data`.
        segment: D [m].
        radius: rho [m].
        clearance: of each node, its distance from the nearest obstacle or less, shape (n + 1,) [m]. No point of a chord
            is closer to it than half of what both ends are, less the chord's length: far chords cost nothing.
        count: contacts that are in the arrays already.
        to: written from there on.

    Returns:
        The number of contacts with those before; -1 when there are more than the arrays have room for.
    """
    reach, discs = REACH * data.reach, len(data.discs)
    for i in range(len(points) - 1):
        if clearance[i] >= data.reach and clearance[i + 1] >= data.reach:
            continue
        start = points[i, 0], points[i, 1], points[i, 2] if points.shape[1] == 3 else 0.0
        x, y = points[i + 1, 0] - start[0], points[i + 1, 1] - start[1]
        z = points[i + 1, 2] - start[2] if points.shape[1] == 3 else 0.0
        length = math.sqrt(x * x + y * y + z * z)
        if not 0.0 < length < MAX_ELONGATION * segment or clearance[i] + clearance[i + 1] - length > 2.0 * reach:
            continue
        chord = Chord(start, (x / length, y / length, z / length), length)
        # A corner beside the chord is no farther from its middle than this.
        far = 0.5 * length + max(reach, 0.5 * length)
        x, y = start[0] + 0.5 * x, start[1] + 0.5 * y
        for o in range(len(data.order)):
            s = data.order[o]
            if s < discs:
                disc = data.discs[s]
                place, distance, normal = _round(chord, (disc[0], disc[1], disc[3]), disc[2] + reach)
                if place >= 0.0:
                    outer = disc[2] + radius
                    most = outer * (1.0 - math.cos(min(0.5 * segment / outer, 1.5)))
                    distance += min(_bulge(points, i, place, normal), most) - disc[2]
                    count = _write(count, place, distance, normal, i, o, to)
                continue
            for block in range(data.polygons[s - discs, 0], data.polygons[s - discs, 1]):
                dx, dy, near = x - data.circles[block, 0], y - data.circles[block, 1], far + data.circles[block, 2]
                if dx * dx + dy * dy > near * near:
                    continue
                first = data.ranges[block, 0]
                for edge in range(first, first + data.ranges[block, 1]):
                    place, distance, normal = _corner(chord, data.edges, edge * EDGE_WIDTH, reach)
                    if place >= 0.0:
                        count = _write(count, place, distance, normal, i, o, to)
        if count < 0:
            return -1
    return count
