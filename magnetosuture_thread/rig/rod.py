"""The thread as a discrete elastic rod: energies with gradient and band of second derivatives.

Unknowns are q = [theta, x_0, y_0, x_1, y_1, ... x_n, y_n]: the needle's heading, its tail, which is node 0, and the
thread's nodes. Every term touches three nodes in a row at most, so second derivatives have the half-width 5. They
are kept as B[i, k] = d2E / dq_i dq_{i-k}, shape (2n + 3, 6).

**Contact of the thread with itself** in the plane, as in a film of liquid too thin for it to pass over itself.
A node near a segment of the same thread is kept on its side by the gap

    g(q) = n . (x_k - (1 - s) x_j - s x_{j+1}) - diameter,    energy k / 2 g^2 below 0

whose place s and normal n are those of the start of a step, as the node is not far from there at its end: so g is
linear, as is the slip along the tangent. These terms couple nodes far apart, which is beyond the band of second
derivatives: Newton's step is corrected for them by solving for their forces first, as many unknowns as there are
contacts.

**Friction** follows Coulomb's law with the normal forces at the start of a step. A contact that pushes with the force N
adds, for its slip s along the tangent since then,

    mu N (sqrt(s^2 + e^2) - e),    e = (2 um/s) dt

to the energy of the step: a force of mu N s / sqrt(s^2 + e^2) against the slip.

Source: Sherman and Morrison 1950, Woodbury 1950. Deviation: none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np

from magnetosuture_thread.geometry.compiled import compiled, compiled_inline, compiled_uncounted
from magnetosuture_thread.geometry.polyline import Mask, Vector
from magnetosuture_thread.rig.contact import Shapes, clear, point_contacts, segment_contacts, write_row

WIDTH = 6  # of the band: half-width and diagonal
NORMAL = -1.0  # in place of a limit of friction, of a row that is a gap


class NeedleJoint(str, Enum):
    """The joint of the thread and the needle's tail."""

    PINNED = "pinned"
    CLAMPED = "clamped"


@dataclass(frozen=True)
class ThreadProperties:
    """The thread in its liquid.

    Attributes:
        length: L [m].
        segments: n.
        bending_stiffness: EI, 0 for a chain [N m^2].
        stretching_stiffness: EA [N].
        drag_across: per length, across the thread [Pa s].
        drag_along: the same along it.
        attachment: pinned, it turns freely at the needle's tail, or clamped, it leaves against the heading.
        diameter: for contact [m].
    """

    length: float
    segments: int
    bending_stiffness: float
    stretching_stiffness: float
    drag_across: float
    drag_along: float
    attachment: NeedleJoint
    diameter: float = 0.0


class Rod(NamedTuple):
    """A thread as kernels read it.

    Attributes:
        segment: length D of a segment [m].
        stretching: EA [N].
        bending: EI [N m^2].
        across: drag per length across the thread [Pa s].
        along: the same along it.
        radius: half the diameter [m].
    """

    segment: float
    stretching: float
    bending: float
    across: float
    along: float
    radius: float


class StepTerms(NamedTuple):
    """Terms that one step adds to the elastic energy, N = 2n + 3 unknowns.

    Attributes:
        begin: state at the start of the step, from which slip is measured, shape (N,) [rad, m].
        rest: state from which drag is counted, shape (N,).
        drag: of the thread's nodes, see `drag_matrices`.
        turned: resistance of the needle to (theta, x, y) in the dish's frame, shape (3, 3).
        field: flux density at tail and tip, shape (2, 2) [T].
        slip: that smooths friction [m].
        rows: of friction and of contact of the thread with itself, see `add_rows`.
    """

    begin: Vector
    rest: Vector
    drag: Vector
    turned: Vector
    field: Vector
    slip: float
    rows: Vector


class System(NamedTuple):
    """Gradient, band of second derivatives, and second derivatives of rows beyond it; rows of contacts to work in."""

    gradient: Vector
    band: Vector
    second: Vector
    contacts: Vector


@compiled
def drag_matrices(q: Vector, rod: Rod, scale: float) -> Vector:
    """Return each node's drag: half of each segment beside it, so that a free end carries half a cell.

        Z_i = scale sum D / 2 (across I - (across - along) t t')

    Args:
        q: where tangents t are taken.
        rod: the thread.
        scale: factor, 1 / (beta dt) in a step.

    Returns:
        Z_xx, Z_xy, Z_yy, shape (n + 1, 3).
    """
    drag = np.zeros(((q.shape[0] - 1) // 2, 3))
    half, less = 0.5 * rod.segment * scale, rod.across - rod.along
    for i in range(drag.shape[0] - 1):
        ex, ey = q[2 * i + 3] - q[2 * i + 1], q[2 * i + 4] - q[2 * i + 2]
        square = ex * ex + ey * ey
        for node in (i, i + 1):
            drag[node, 0] += half * (rod.across - less * ex * ex / square)
            drag[node, 1] -= half * less * ex * ey / square
            drag[node, 2] += half * (rod.across - less * ey * ey / square)
    return drag


@compiled_uncounted
def add_drag(q: Vector, rest: Vector, drag: Vector, gradient: Vector, band: Vector) -> float:
    """Add sum (x_i - rest_i)' Z_i (x_i - rest_i) / 2, the work of a step against the liquid."""
    energy = 0.0
    for i in range(drag.shape[0]):
        a = 1 + 2 * i
        dx, dy = q[a] - rest[a], q[a + 1] - rest[a + 1]
        fx, fy = drag[i, 0] * dx + drag[i, 1] * dy, drag[i, 1] * dx + drag[i, 2] * dy
        energy += 0.5 * (fx * dx + fy * dy)
        gradient[a] += fx
        gradient[a + 1] += fy
        band[a, 0] += drag[i, 0]
        band[a + 1, 1] += drag[i, 1]
        band[a + 1, 0] += drag[i, 2]
    return energy


@compiled_uncounted
def add_stretching(q: Vector, rod: Rod, gradient: Vector, band: Vector, convex: bool) -> float:
    """Add sum EA / (2 D) (l_i - D)^2; `convex` leaves out what makes second derivatives indefinite."""
    energy = 0.0
    k = rod.stretching / rod.segment
    for a in range(1, q.shape[0] - 2, 2):
        ex, ey = q[a + 2] - q[a], q[a + 3] - q[a + 1]
        size = math.sqrt(ex * ex + ey * ey)
        tx, ty = ex / size, ey / size
        force = k * (size - rod.segment)
        energy += 0.5 * force * (size - rod.segment)
        gradient[a] -= force * tx
        gradient[a + 1] -= force * ty
        gradient[a + 2] += force * tx
        gradient[a + 3] += force * ty
        turn = force / size
        if convex:
            turn = max(turn, 0.0)
        xx, xy, yy = turn + (k - turn) * tx * tx, (k - turn) * tx * ty, turn + (k - turn) * ty * ty
        for b in (a, a + 2):
            band[b, 0] += xx
            band[b + 1, 1] += xy
            band[b + 1, 0] += yy
        band[a + 2, 2] -= xx
        band[a + 2, 1] -= xy
        band[a + 3, 3] -= xy
        band[a + 3, 2] -= yy
    return energy


@compiled_uncounted
def add_bending(q: Vector, rod: Rod, gradient: Vector, band: Vector) -> float:
    """Add sum EI / D (1 - cos(phi_i)) at inner nodes, phi_i the turn from segment to segment.

        = EI / (2 D^3) sum |x_{i+1} - 2 x_i + x_{i-1}|^2

    at the length D, which stretching holds: quadratic, and EI curvature^2 D / 2 to second order.
    """
    energy = 0.0
    k = rod.bending / rod.segment**3
    for a in range(1, q.shape[0] - 4, 2):
        for r in range(a, a + 2):
            u = (q[r + 4] - q[r + 2]) - (q[r + 2] - q[r])
            energy += 0.5 * k * u * u
            gradient[r] += k * u
            gradient[r + 2] -= 2.0 * k * u
            gradient[r + 4] += k * u
            band[r, 0] += k
            band[r + 2, 0] += 4.0 * k
            band[r + 4, 0] += k
            band[r + 2, 2] -= 2.0 * k
            band[r + 4, 2] -= 2.0 * k
            band[r + 4, 4] += k
    return energy


@compiled_uncounted
def find_contacts(q: Vector, rod: Rod, shapes: Shapes, rows: Vector) -> int:
    """Write what nodes 1 ... n and segments sink into; return how many.

    Args:
        q: state, shape (N,).
        rod: the thread.
        shapes: what can be touched.
        rows: gets index of the first unknown, place on the segment (-1 for a node), depth, gradient n_x and n_y of the
            gap, and the gap's curvature at a node or the gap of a segment, shape (k, 6). What finds no row is left out.
    """
    count = 0
    for a in range(3, q.shape[0] - 1, 2):
        if not clear(q[a], q[a + 1], rod.radius, shapes):
            count = point_contacts(a, q[a], q[a + 1], rod.radius, shapes, rows, count)
    if shapes.discs.shape[0] + shapes.boxes.shape[0] == 0:
        return count
    for a in range(1, q.shape[0] - 2, 2):
        ex, ey = q[a + 2] - q[a], q[a + 3] - q[a + 1]
        reach = rod.radius + 0.75 * math.sqrt(ex * ex + ey * ey)
        if not clear(q[a] + 0.5 * ex, q[a + 1] + 0.5 * ey, reach, shapes):
            count = segment_contacts(q, a, rod.segment, rod.radius, shapes, rows, count)
    return count


@compiled_uncounted
def add_contact(q: Vector, k: float, rows: Vector, gradient: Vector, band: Vector, convex: bool) -> float:
    """Add k / 2 depth^2 of every contact, the rows of `find_contacts`.

    For a segment the gap's second derivative is that of the distance between a point and a line.
    """
    energy = 0.0
    for row in range(rows.shape[0]):
        a, s, depth, nx, ny = int(rows[row, 0]), rows[row, 1], rows[row, 2], rows[row, 3], rows[row, 4]
        energy += 0.5 * k * depth * depth
        if s < 0.0:
            bend = -rows[row, 5] * depth
            if convex:
                bend = max(bend, 0.0)
            gradient[a] -= k * depth * nx
            gradient[a + 1] -= k * depth * ny
            band[a, 0] += k * (bend + (1.0 - bend) * nx * nx)
            band[a + 1, 1] += k * (1.0 - bend) * nx * ny
            band[a + 1, 0] += k * (bend + (1.0 - bend) * ny * ny)
            continue
        ex, ey = q[a + 2] - q[a], q[a + 3] - q[a + 1]
        square = ex * ex + ey * ey
        w = ((1.0 - s) * nx, (1.0 - s) * ny, s * nx, s * ny)
        # Of the second derivative: turning, of the normal and of the place s.
        tx, ty, turn = ex / square, ey / square, 0.0 if convex else 1.0
        v = (-nx, -ny, nx, ny)
        z = ((1.0 - s) * tx, (1.0 - s) * ty, s * tx, s * ty)
        bend = rows[row, 5] / square
        for r in range(4):
            gradient[a + r] -= k * depth * w[r]
            for c in range(r + 1):
                second = turn * (z[r] * v[c] + v[r] * z[c] + bend * v[r] * v[c])
                band[a + r, r - c] += k * (w[r] * w[c] + depth * second)
    return energy


def find_friction(contacts: Vector, shapes: Shapes) -> Vector:
    """Return the rows of friction on surfaces, see `add_rows`, from those of `find_contacts` as a step begins."""
    a, s, depth, nx, ny, _ = contacts.T
    limit = shapes.friction * shapes.stiffness * depth
    return np.column_stack([np.where(s < 0.0, a, 0.0), np.where(s < 0.0, 0.0, a), s, -ny, nx, limit])


@compiled_uncounted
def factor(band: Vector) -> bool:
    """Replace a band by its Cholesky factor, row by row; return whether it was positive definite."""
    width = band.shape[1]
    for i in range(band.shape[0]):
        low = max(0, i - width + 1)
        for j in range(low, i + 1):
            total = band[i, i - j]
            for k in range(low, j):
                total -= band[i, i - k] * band[j, j - k]
            if j < i:
                band[i, i - j] = total / band[j, 0]
            elif total > 0.0:
                band[i, 0] = math.sqrt(total)
            else:
                return False
    return True


@compiled_uncounted
def back_substitute(band: Vector, right: Vector) -> None:
    """Solve in place with the factor that `factor` left."""
    size, width = band.shape
    for i in range(size):
        total = right[i]
        for j in range(max(0, i - width + 1), i):
            total -= band[i, i - j] * right[j]
        right[i] = total / band[i, 0]
    for i in range(size - 1, -1, -1):
        total = right[i]
        for j in range(i + 1, min(size, i + width)):
            total -= band[j, j - i] * right[j]
        right[i] = total / band[i, 0]


@compiled
def crossings(q: Vector) -> Mask:
    """Return which segments cross each other, shape (n, n)."""
    segments = q.shape[0] // 2 - 1
    side = np.empty((segments, segments + 1))  # of the line of each segment, on which each node is
    for i in range(segments):
        a = 2 * i + 1
        ex, ey = q[a + 2] - q[a], q[a + 3] - q[a + 1]
        for k in range(segments + 1):
            side[i, k] = ex * (q[2 * k + 2] - q[a + 1]) - ey * (q[2 * k + 1] - q[a])
    crossed = np.zeros((segments, segments), np.bool_)
    for i in range(segments):
        for j in range(segments):
            crossed[i, j] = side[i, j] * side[i, j + 1] < 0.0 and side[j, i] * side[j, i + 1] < 0.0
    return crossed


@compiled_uncounted
def find_pairs(q: Vector, rod: Rod, shapes: Shapes, crossed: Mask, rows: Vector) -> int:
    """Write what of the thread is near itself at the start of a step, see `add_rows`.

    What crosses itself already is free to move apart.

    Args:
        q: state at the start, shape (N,) [rad, m].
        rod: the thread.
        shapes: stiffness and friction.
        crossed: see `crossings`.
        rows: written, shape (p, 6).

    Returns:
        How many there are, -1 if there is no room.
    """
    count, segments, diameter = 0, crossed.shape[0], 2.0 * rod.radius
    for i in range(segments + 1):
        for j in range(segments):
            # Places less than half a circle of thread apart cannot touch.
            if i in (j, j + 1) or min(abs(i - j), abs(i - j - 1)) * rod.segment <= 0.5 * math.pi * diameter:
                continue
            a, b = 2 * i + 1, 2 * j + 1
            ex, ey, dx, dy = q[b + 2] - q[b], q[b + 3] - q[b + 1], q[a] - q[b], q[a + 1] - q[b + 1]
            s = min(max((dx * ex + dy * ey) / (ex * ex + ey * ey), 0.0), 1.0)
            nx, ny = dx - s * ex, dy - s * ey
            gap = math.sqrt(nx * nx + ny * ny)
            # A node that is farther than half a segment from touching has no gap in a step.
            if not 0.0 < gap < diameter + 0.5 * rod.segment:
                continue
            if (i < segments and crossed[i, j]) or (i > 0 and crossed[i - 1, j]):
                continue
            if count + 2 > rows.shape[0]:
                return -1
            nx, ny, segment = nx / gap, ny / gap, float(b)
            count = write_row(rows, count, a, segment, s, nx, ny, NORMAL)
            if gap < diameter and shapes.friction > 0.0:
                limit = shapes.friction * shapes.stiffness * (diameter - gap)
                count = write_row(rows, count, a, segment, s, -ny, nx, limit)
    return count


@compiled_inline
def _place(row: Vector, r: int) -> tuple[int, float]:
    """Return one of the six unknowns of a row, by its number, and the derivative of the row's gap or slip by it."""
    s, weight = row[2], row[3 + r % 2]
    if r < 2:
        return int(row[0]) + r, weight
    return int(row[1]) + r - 2, -weight * (1.0 - s if r < 4 else s)


@compiled_uncounted
def add_rows(q: Vector, terms: StepTerms, rod: Rod, stiffness: float, system: System) -> float:
    """Add what depends on a gap or slip that is linear in a step: contact of the thread with itself, and all friction.

    A row has the first unknown of a node and of a segment, 0 for neither, the place on the segment, a direction, and
    the limit of friction [N], `NORMAL` for a gap. Where it has a node and a segment, its second derivative by gap or
    slip goes to `system.second`, else into the band.
    """
    energy, diameter = 0.0, 2.0 * rod.radius
    for k in range(terms.rows.shape[0]):
        row, along = terms.rows[k], 0.0
        first, last, limit = 0 if row[0] > 0.0 else 2, 6 if row[1] > 0.0 else 2, row[5]
        for r in range(first, last):
            at, weight = _place(row, r)
            along += weight * (q[at] - (terms.begin[at] if limit != NORMAL else 0.0))
        if limit == NORMAL:
            depth = max(diameter - along, 0.0)
            energy += 0.5 * stiffness * depth * depth
            force, second = -stiffness * depth, stiffness if depth > 0.0 else 0.0
        else:
            root = math.sqrt(along * along + terms.slip * terms.slip)
            energy += limit * (root - terms.slip)
            force, second = limit * along / root, limit * terms.slip * terms.slip / root**3
        system.second[k] = second if last - first == 6 else 0.0
        for r in range(first, last if second > 0.0 else first):
            at, weight = _place(row, r)
            system.gradient[at] += force * weight
            for c in range(first, r + 1 if last - first < 6 else first):
                before, share = _place(row, c)
                system.band[at, at - before] += second * weight * share
    return energy


@compiled
def couple(chol: Vector, pairs: Vector, second: Vector, first_free: int, step: Vector) -> None:
    """Correct a step, found with the factor of the band alone, for the second derivatives of rows beyond it.

        (S^-1 + W A^-1 W') f = W step,    step - A^-1 W' f

    with the band's matrix A, the rows' derivatives W, and the second derivatives S that are not 0.

    Args:
        chol: the factor.
        pairs: the rows, see `add_rows`.
        second: their second derivatives.
        first_free: the first unknown; those before are known.
        step: corrected, shape (N,).
    """
    rows, size = np.empty(second.shape[0], np.int64), 0
    for row in range(second.shape[0]):
        if second[row] > 0.0:
            rows[size] = row
            size += 1
    columns, force = np.zeros((size, step.shape[0])), np.zeros(size)
    matrix = np.zeros((size, size))  # a band as wide as it is long
    for i in range(size):
        for r in range(6):
            at, weight = _place(pairs[rows[i]], r)
            if at >= first_free:
                columns[i, at] += weight
                force[i] += weight * step[at]
        back_substitute(chol, columns[i])
    for i in range(size):
        matrix[i, 0] = 1.0 / second[rows[i]]
        for r in range(6):
            at, weight = _place(pairs[rows[i]], r)
            if at >= first_free:
                for j in range(i + 1):
                    matrix[i, i - j] += weight * columns[j, at]
    if size > 0 and factor(matrix):
        back_substitute(matrix, force)
        for i in range(size):
            for at in range(step.shape[0]):
                step[at] -= force[i] * columns[i, at]
