"""Contact of the thread with itself in the plane, as in a film of liquid too thin for it to pass over itself.

A node near a segment of the same thread is kept on its side by the gap

    g(q) = n . (x_k - (1 - s) x_j - s x_{j+1}) - diameter,    energy k / 2 g^2 below 0

whose place s and normal n are those of the start of a step, as the node is not far from there at its end: so g is
linear. With friction, the slip of the two along the tangent adds what `friction` has for other contacts. These terms
couple nodes far apart, which is beyond the band of second derivatives: Newton's step is corrected for them by solving
for their forces first, as many unknowns as there are contacts.

Source: Sherman and Morrison 1950, Woodbury 1950. Deviation: none.
"""

from __future__ import annotations

import math

import numpy as np

from magnetosuture_thread.compiled import compiled, compiled_uncounted
from magnetosuture_thread.rig.mechanics.contact import Shapes, Vector
from magnetosuture_thread.rig.mechanics.rod import Rod, back_substitute

NORMAL = -1.0  # in place of a limit of friction, of a row that is a gap


@compiled_uncounted
def _side(q: Vector, a: int, b: int, c: int) -> float:
    """Return twice the area of the triangle of three nodes, by their first unknowns, positive counter-clockwise."""
    return float((q[b] - q[a]) * (q[c + 1] - q[a + 1]) - (q[b + 1] - q[a + 1]) * (q[c] - q[a]))


@compiled_uncounted
def _cross(q: Vector, a: int, b: int) -> bool:
    """Return whether the segments from two nodes on cross, by the nodes' first unknowns; one that is none does not."""
    if min(a, b) < 1 or max(a, b) + 3 >= q.shape[0] or abs(a - b) < 4:
        return False
    return bool(
        _side(q, a, a + 2, b) * _side(q, a, a + 2, b + 2) < 0.0
        and _side(q, b, b + 2, a) * _side(q, b, b + 2, a + 2) < 0.0
    )


@compiled_uncounted
def crosses_anew(start: Vector, end: Vector) -> bool:
    """Return whether two segments cross at the end of a step that did not at its start."""
    for a in range(1, end.shape[0] - 6, 2):
        for b in range(a + 4, end.shape[0] - 2, 2):
            if max(end[a], end[a + 2]) < min(end[b], end[b + 2]) or max(end[b], end[b + 2]) < min(end[a], end[a + 2]):
                continue
            if _cross(end, a, b) and not _cross(start, a, b):
                return True
    return False


@compiled_uncounted
def find_pairs(q: Vector, rod: Rod, shapes: Shapes, pairs: Vector) -> int:
    """Write what of the thread is near itself at the start of a step.

    What crosses itself already is free to move apart.

    Args:
        q: state at the start, shape (N,) [rad, m].
        rod: the thread.
        shapes: stiffness and friction.
        pairs: gets the first unknown of the node and of the segment, place on it, direction, and `NORMAL` or the
            limit of friction [N], shape (p, 6).

    Returns:
        How many there are, -1 if there is no room.
    """
    count, size, diameter = 0, q.shape[0], 2.0 * rod.radius
    for a in range(1, size - 1, 2):
        for b in range(1, size - 3, 2):
            between = min(abs(a - b), abs(a - b - 2)) // 2
            # Places less than half a circle of thread apart cannot touch.
            if a == b or a == b + 2 or between * rod.segment <= 0.5 * math.pi * diameter:
                continue
            ex, ey, dx, dy = q[b + 2] - q[b], q[b + 3] - q[b + 1], q[a] - q[b], q[a + 1] - q[b + 1]
            square = ex * ex + ey * ey
            s = min(max((dx * ex + dy * ey) / square, 0.0), 1.0)
            nx, ny = dx - s * ex, dy - s * ey
            gap = math.sqrt(nx * nx + ny * ny)
            # A node that is farther than half a segment from touching has no gap in a step.
            if not 0.0 < gap < diameter + 0.5 * rod.segment or _cross(q, a, b) or _cross(q, a - 2, b):
                continue
            if count + 2 > pairs.shape[0]:
                return -1
            nx, ny = nx / gap, ny / gap
            _write(pairs[count], a, b, s, nx, ny, NORMAL)
            count += 1
            if gap < diameter and shapes.friction > 0.0:
                _write(pairs[count], a, b, s, -ny, nx, shapes.friction * shapes.stiffness * (diameter - gap))
                count += 1
    return count


@compiled_uncounted
def _write(row: Vector, a: int, b: int, s: float, x: float, y: float, limit: float) -> None:
    row[0], row[1], row[2], row[3], row[4], row[5] = a, b, s, x, y, limit


@compiled_uncounted
def _place(row: Vector, r: int) -> tuple[int, float]:
    """Return one of the six unknowns of a row, by its number, and the derivative of the row's gap or slip by it."""
    s, weight = row[2], row[3 + r % 2]
    if r < 2:
        return int(row[0]) + r, weight
    return int(row[1]) + r - 2, -weight * (1.0 - s if r < 4 else s)


@compiled_uncounted
def add_pairs(
    q: Vector,
    start: Vector,
    slip: float,
    diameter: float,
    stiffness: float,
    pairs: Vector,
    second: Vector,
    gradient: Vector,
) -> float:
    """Add energy and gradient of all rows, and write the second derivative of each by its gap or slip.

    Args:
        q: state, shape (N,).
        start: at the start of the step.
        slip: that smooths friction [m].
        diameter: of the thread [m].
        stiffness: k [N/m].
        pairs: of `find_pairs`, shape (p, 6).
        second: written, shape (p,).
        gradient: added to, shape (N,).
    """
    energy = 0.0
    for row in range(pairs.shape[0]):
        along, limit = 0.0, pairs[row, 5]
        for r in range(6):
            at, weight = _place(pairs[row], r)
            along += weight * (q[at] - (start[at] if limit != NORMAL else 0.0))
        if limit == NORMAL:
            depth = max(diameter - along, 0.0)
            energy += 0.5 * stiffness * depth * depth
            force, second[row] = -stiffness * depth, stiffness if depth > 0.0 else 0.0
        else:
            root = math.sqrt(along * along + slip * slip)
            energy += limit * (root - slip)
            force, second[row] = limit * along / root, limit * slip * slip / root**3
        if force != 0.0:
            for r in range(6):
                at, weight = _place(pairs[row], r)
                gradient[at] += force * weight
    return energy


@compiled
def couple(chol: Vector, pairs: Vector, second: Vector, first_free: int, step: Vector) -> None:
    """Correct a step, found with the factor of the band alone, for the rows' second derivatives.

    Args:
        chol: the factor.
        pairs: of `find_pairs`.
        second: of `add_pairs`.
        first_free: the first unknown; those before are given.
        step: corrected, shape (N,).
    """
    rows = np.flatnonzero(second > 0.0)
    if len(rows) == 0:
        return
    size = len(rows)
    columns, matrix, force = np.zeros((size, step.shape[0])), np.zeros((size, size)), np.zeros(size)
    for i in range(size):
        for r in range(6):
            at, weight = _place(pairs[rows[i]], r)
            if at >= first_free:
                columns[i, at] += weight
        back_substitute(chol, columns[i])
    for i in range(size):
        matrix[i, i] = 1.0 / second[rows[i]]
        for r in range(6):
            at, weight = _place(pairs[rows[i]], r)
            if at >= first_free:
                force[i] += weight * step[at]
                for j in range(size):
                    matrix[i, j] += weight * columns[j, at]
    step -= np.linalg.solve(matrix, force) @ columns
