"""The correction: the rod's program once more, about the predicted thread, with the measured points in it.

    minimise over d   1/2 d' Lambda d  +  1/2 sum_p w_p (a_p' d - nu_p)^2
    subject to        the segments' chords, obstacles and wall, linearised as in a step and about its own result again

in units of the segment length D. d is how far each node is moved; nu_p is a point's innovation across the thread
and a_p' d = m_p . ((1 - t) d_i + t d_{i+1}) what the two nodes beside it make of it. Lambda is the information on
the predicted thread, banded:

    d' Lambda d = sum_i (n_i . d_i)^2 / v_i  +  sum_i (l^2 / v_i) |d_{i+1} - d_i|^2  +  sum_i (2 k / q_i) |c_i(d)|^2

The first two terms are errors of a variance of v / 2 l that are alike over a length l. Under forces that are alike over
it a filter would have sqrt(1 + (l k)^4) in the place of 1 + (l k)^2 at the wave number k, which is never less than 0.7
of it. The third is what bending leaves of errors under a noise of intensity q; k = EI / (zeta D^4). With no constraint
active this is the measurement update of a Kalman filter, and the inverse of the program's matrix its covariance.

Source: maximum a posteriori estimation; the information of the steady state of Riccati's equation for a rod in a
viscous liquid. Deviation: [Forghani2025] has no estimate, its program runs open loop.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.obstacles import WorkspaceData
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model import mechanics
from magnetosuture_thread.model.estimator.covariance import selected_inverse
from magnetosuture_thread.model.formulations.contact_rows import DEPTH_TOLERANCE, contact_rows
from magnetosuture_thread.model.formulations.rod_step import STRAIN_TOLERANCE, RodProperties, segment_rows
from magnetosuture_thread.model.formulations.step_buffers import StepBuffers, program_of
from magnetosuture_thread.model.solvers import banded

Vector = NDArray[np.float64]

MAX_SOLVES = 8  # of a correction
MAX_REWEIGHTED = 3  # of them with new robust weights
FREEDOM = 4.0  # degrees of freedom of Student's distribution of a point's error
ALONG = 1e-6  # information along the thread over that across it; the chords hold it there
RIGID = 10.0  # information on the thread's longest bending wave over that of the points; more changes nothing
NEIGHBOURS = 2  # on each side of a point, that it is compared with
CHANGED = 0.1  # of a robust weight, from which on the program is solved again


class MeasuredPoints(NamedTuple):
    """Points that are associated with the thread.

    Attributes:
        place: arc length, shape (m,) [D].
        innovation: across the thread, shape (m,) [D].
        variance: of each point across the thread, shape (m,) [D^2].
        share: part of its information that is its own, shape (m,).
    """

    place: Vector
    innovation: Vector
    variance: Vector
    share: Vector


@compiled
def normals_of(positions: Points, normals: Points) -> None:
    """Write each node's normal, to the left of the way from the node before to the node after."""
    last = len(positions) - 1
    for i in range(last + 1):
        before, after = max(i - 1, 0), min(i + 1, last)
        x, y = positions[after, 0] - positions[before, 0], positions[after, 1] - positions[before, 1]
        size = np.hypot(x, y)
        if size > 0.0:
            normals[i, 0], normals[i, 1] = -y / size, x / size
        else:
            normals[i, 0], normals[i, 1] = 0.0, 1.0


@compiled
def robust_weights(points: MeasuredPoints, residual: Vector, variance: Vector, weights: Vector) -> float:
    """Write the weight of each point's error under Student's distribution; return the largest change.

        w = (f + 1) / (f + r^2 / s)

    with r less the median of the errors of its neighbours, where that is smaller: what many say is no outlier but
    where the thread is.

    Args:
        points: the points.
        residual: r of each.
        variance: s, the variance of r.
        weights: written, at most 1.
    """
    change, count = 0.0, len(residual)
    near = np.empty(2 * NEIGHBOURS + 1)
    for p in range(count):
        first, last = max(0, p - NEIGHBOURS), min(count, p + NEIGHBOURS + 1)
        for k in range(first, last):  # sorted by insertion
            at = k - first
            while at > 0 and near[at - 1] > residual[k]:
                near[at] = near[at - 1]
                at -= 1
            near[at] = residual[k]
        off = residual[p] - near[(last - first) // 2]
        off = off if abs(off) < abs(residual[p]) else residual[p]
        weight = min(1.0, (FREEDOM + 1.0) / (FREEDOM + off * off / variance[p]))
        change = max(change, abs(weight - weights[p]))
        weights[p] = weight
    return change


@compiled
def prior_information(
    density: Vector,
    noise: Vector,
    length: float,
    stiffness: float,
    scale: float,
    clamped: bool,
    normals: Points,
    buffers: StepBuffers,
) -> None:
    """Write Lambda over a scale into the program.

    Args:
        density: v of each node, shape (n + 1,) [D^2].
        noise: q of each node, shape (n + 1,) [D^2/s].
        length: l [D].
        stiffness: k [1/s].
        scale: by which all is divided.
        clamped: whether the thread's direction at the needle is known.
        normals: n_i, shape (n + 1, 2).
        buffers: written: blocks, couplings, linear.
    """
    nodes = len(density)
    stiffest = RIGID * (nodes / np.pi) ** 4
    blocks, couplings = buffers.blocks, buffers.couplings
    buffers.linear[:], couplings[:] = 0.0, 0.0
    for i in range(nodes):
        across = 1.0 / (scale * density[i])
        for a in range(2):
            for b in range(2):
                blocks[i, a, b] = across * normals[i, a] * normals[i, b]
            blocks[i, a, a] += ALONG * across
    for i in range(nodes - 1):
        weight = length * length / (scale * 0.5 * (density[i] + density[i + 1]))
        for a in range(2):
            blocks[i, a, a] += weight
            blocks[i + 1, a, a] += weight
        couplings[0, i] -= weight
    for i in range(0 if clamped else 1, nodes - 1):
        weight = min(2.0 * stiffness / (scale * noise[i]), stiffest)
        before, here, after = (1.0, -2.0, 1.0) if i > 0 else (0.0, -2.0, 2.0)
        weight *= 1.0 if i > 0 else 0.5
        for a in range(2):
            if i > 0:
                blocks[i - 1, a, a] += before * before * weight
            blocks[i, a, a] += here * here * weight
            blocks[i + 1, a, a] += after * after * weight
        couplings[0, i] += here * after * weight
        if i > 0:
            couplings[0, i - 1] += before * here * weight
            couplings[1, i - 1] += before * after * weight


@compiled
def measured_rows(
    points: MeasuredPoints,
    weights: Vector,
    scale: float,
    about: Points,
    row: int,
    gram: NDArray[np.float64],
    buffers: StepBuffers,
) -> int:
    """Write the points of each segment as at most two rows, with the compliance as their variance; return the end.

    Points p of one segment have a_p in the span of two vectors, so that sum_p w_p (a_p' d - nu_p)^2 is, up to a
    constant, that of two rows: the Cholesky factor of their normal equations.

    Args:
        points: the points.
        weights: robust ones.
        scale: by which information is divided.
        about: where segments' normals are taken, shape (n + 1, 2).
        row: the first row.
        gram: written, shape (n, 5).
        buffers: written from that row on.
    """
    gram[:] = 0.0
    for p in range(len(weights)):
        segment = min(int(points.place[p]), len(gram) - 1)
        t = points.place[p] - segment
        w = weights[p] * points.share[p] / (points.variance[p] * scale)
        gram[segment, 0] += w * (1.0 - t) * (1.0 - t)
        gram[segment, 1] += w * (1.0 - t) * t
        gram[segment, 2] += w * t * t
        gram[segment, 3] += w * (1.0 - t) * points.innovation[p]
        gram[segment, 4] += w * t * points.innovation[p]
    nodes = len(about)
    for i in range(len(gram)):
        total = gram[i, 0] + gram[i, 2]
        if total <= 0.0:
            continue
        ex, ey = about[i + 1, 0] - about[i, 0], about[i + 1, 1] - about[i, 1]
        size = np.hypot(ex, ey)
        mx, my = -ey / size, ex / size
        # The larger one of both pivots first.
        k = 0 if gram[i, 0] >= gram[i, 2] else 1
        first, cross, second = gram[i, 2 * k], gram[i, 1], gram[i, 2 - 2 * k]
        root = np.sqrt(first)
        low = cross / root
        value = gram[i, 3 + k] / root
        rest = second - low * low
        begin = min(i, nodes - 3)
        for step in range(2):
            if step == 1:
                if rest <= 1e-9 * total:
                    break
                value = (gram[i, 4 - k] - low * value) / np.sqrt(rest)
                near, far = 0.0, np.sqrt(rest)
            else:
                near, far = root, low
            if k == 1:
                near, far = far, near
            # A row of unit length, its weight in the compliance.
            length = np.hypot(near, far)
            buffers.first[row] = begin
            buffers.gradient[row] = 0.0
            shift = i - begin
            buffers.gradient[row, shift, 0], buffers.gradient[row, shift, 1] = near / length * mx, near / length * my
            buffers.gradient[row, shift + 1, 0] = far / length * mx
            buffers.gradient[row, shift + 1, 1] = far / length * my
            buffers.lower[row] = buffers.upper[row] = value / length
            buffers.compliance[row] = 1.0 / (length * length)
            buffers.multipliers[row] = 0.0
            row += 1
    return row


@compiled
def _measurements(
    points: MeasuredPoints,
    weights: Vector,
    end: tuple[float, float],
    scale: float,
    start: Points,
    gram: NDArray[np.float64],
    buffers: StepBuffers,
) -> int:
    """Write the rows of all that is measured behind those of the segments; return their end. See `correct`."""
    nodes, segments = len(start), len(start) - 1
    row = measured_rows(points, weights, scale, start, segments, gram, buffers)
    if np.isfinite(end[1]):
        ex, ey = start[segments, 0] - start[segments - 1, 0], start[segments, 1] - start[segments - 1, 1]
        size = np.hypot(ex, ey)
        buffers.first[row], buffers.gradient[row] = nodes - 3, 0.0
        buffers.gradient[row, 2, 0], buffers.gradient[row, 2, 1] = ex / size, ey / size
        buffers.lower[row] = buffers.upper[row] = end[0]
        buffers.compliance[row], buffers.multipliers[row] = scale * end[1], 0.0
        row += 1
    return row


class CorrectionBuffers(NamedTuple):
    """Memory of a correction, kept from one to the next.

    Attributes:
        normals: of the nodes, shape (n + 1, 2).
        gram: shape (n, 5).
        about: where the nodes are, shape (n + 1, 2) [D].
        moved: d, shape (n + 1, 2) [D].
        known: nodes that are no unknowns, shape (n + 1,).
        inverse: see `selected_inverse`.
        covariance: of each node, shape (n + 1, 2, 2) [D^2].
    """

    normals: Points
    gram: NDArray[np.float64]
    about: Points
    moved: Points
    known: NDArray[np.bool_]
    inverse: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @classmethod
    def of(cls, nodes: int) -> CorrectionBuffers:
        """Return work for a thread of so many nodes."""
        return cls(
            np.zeros((nodes, 2)),
            np.zeros((nodes - 1, 5)),
            np.zeros((nodes, 2)),
            np.zeros((nodes, 2)),
            np.zeros(nodes, dtype=np.bool_),
            np.zeros((2 * nodes + 6, 7)),
            np.zeros((nodes, 2, 2)),
        )


CORRECTED, NO_ROOM, FAILED = range(3)


@compiled
def correct(
    axes: tuple[int, ...],
    rod: RodProperties,
    buffers: StepBuffers,
    workspace: WorkspaceData,
    solver_buffers: banded.SolverBuffers,
    work: CorrectionBuffers,
    start: Points,
    heading: Points,
    density: Vector,
    noise: Vector,
    length: float,
    stiffness: float,
    points: MeasuredPoints,
    weights: Vector,
    end: tuple[float, float],
    tolerance: float,
) -> tuple[int, int, float, tuple[float, float, float], float]:
    """Correct a thread by measured points.

    Args:
        axes: (0, 1).
        rod: the thread.
        buffers: of the program, with room for two rows a segment besides those of the rod.
        workspace: obstacles and wall [m].
        solver_buffers: of the structured solver.
        work: `known` is read; `about` gets the corrected thread, `moved` the correction, `covariance` what is left.
        start: the predicted thread, shape (n + 1, 2) [D].
        heading: of the needle.
        density: v of each node [D^2].
        noise: q of each node [D^2/s].
        length: l [D].
        stiffness: k [1/s].
        points: the points.
        weights: robust ones to begin with; in the end those used.
        end: innovation along the thread of its free end and the variance of it, inf if it is not seen [D], [D^2].
        tolerance: largest residual of a solution.

    Returns:
        `CORRECTED`, `NO_ROOM` for contacts, or `FAILED`; number of solves; how far off the hard constraints are over
        what is allowed, at most 1 where they hold; the residuals of the last solve; the scale of the program.
    """
    nodes, segments = len(start), len(start) - 1
    known, about, moved = work.known, work.about, work.moved
    normals_of(start, work.normals)
    scale = 0.0
    for i in range(1, nodes):
        scale = max(scale, 1.0 / density[i])
    for p in range(len(weights)):
        scale = max(scale, points.share[p] / points.variance[p])
    about[:], moved[:], buffers.multipliers[:], buffers.push[:] = start, 0.0, 0.0, 0.0
    residual = np.empty(len(weights))
    solves, change, off = 0, 1.0, np.inf
    found = (0.0, 0.0, 0.0)
    row = segments
    while True:
        if change > CHANGED:
            row = _measurements(points, weights, end, scale, start, work.gram, buffers)
        mechanics.chord_lengths(about, heading, rod.clamped, buffers.chords)
        strain = segment_rows(buffers, about, start, known, 1.0)
        contacts, depth = contact_rows(buffers, row, workspace, about, start, known, 1.0, rod.unit, rod.radius, True)
        if contacts < 0:
            return NO_ROOM, solves, off, found, scale
        off = max(strain / STRAIN_TOLERANCE, depth / DEPTH_TOLERANCE)
        done = off <= 1.0 and change <= CHANGED and max(found) <= tolerance
        if solves > 0 and (done or solves >= MAX_SOLVES):
            break
        prior_information(density, noise, length, stiffness, scale, rod.clamped, work.normals, buffers)
        rows = row + contacts
        program = program_of(buffers, known, rows)
        u, multipliers = moved.copy(), buffers.multipliers[:rows].copy()
        _, _, found = banded.solve_and_check(axes, program, u, multipliers, solver_buffers)
        solves += 1
        if not max(found) < np.inf:
            return FAILED, solves, off, found, scale
        moved[:] = u
        about[:] = start + moved
        buffers.multipliers[:segments] = multipliers[:segments]
        change = 0.0
        for p in range(len(weights)):
            i = min(int(points.place[p]), segments - 1)
            t = points.place[p] - i
            ex, ey = start[i + 1, 0] - start[i, 0], start[i + 1, 1] - start[i, 1]
            size = np.hypot(ex, ey)
            dx, dy = (1.0 - t) * u[i, 0] + t * u[i + 1, 0], (1.0 - t) * u[i, 1] + t * u[i + 1, 1]
            residual[p] = points.innovation[p] - (-ey * dx + ex * dy) / size
        change = robust_weights(points, residual, points.variance, weights) if solves < MAX_REWEIGHTED else 0.0
    if not max(found) <= tolerance:
        return FAILED, solves, off, found, scale
    selected_inverse(6, 2 * nodes, solver_buffers.band, work.inverse)
    for i in range(nodes):
        for a in range(2):
            for b in range(2):
                value = work.inverse[2 * i + min(a, b), abs(a - b)] / scale
                work.covariance[i, a, b] = 0.0 if known[i] else value
    return CORRECTED, solves, off, found, scale
