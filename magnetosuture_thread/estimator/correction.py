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

import math
from typing import NamedTuple

import numpy as np

from magnetosuture_thread.estimator.association import MeasuredPoints
from magnetosuture_thread.geometry.compiled import TypedKernel, compiled_inline, compiled_uncounted, compiled_within
from magnetosuture_thread.geometry.obstacles import WorkspaceData
from magnetosuture_thread.geometry.polyline import Points, Table, Vector
from magnetosuture_thread.thread import banded, mechanics
from magnetosuture_thread.thread.contact_rows import DEPTH_TOLERANCE, contact_rows
from magnetosuture_thread.thread.mechanics import RodProperties
from magnetosuture_thread.thread.predictor import ThreadPredictor
from magnetosuture_thread.thread.program import CONTACTS_PER_NODE, StepBuffers, program_view, residuals_with
from magnetosuture_thread.thread.rod import STRAIN_TOLERANCE, RodFormulation, segment_rows
from magnetosuture_thread.thread.solvers import BandedSolver

RESIDUAL_TOLERANCE = 1e-4  # of a correction's program; the constraints themselves are checked at its end point
FREEDOM = 4.0  # degrees of freedom of Student's distribution of a point's error
NEIGHBOURS = 2  # on each side of a point, that it is compared with
CHANGED = 0.1  # of a robust weight, from which on the program is solved again


class Prior(NamedTuple):
    """The predicted thread and the information on it; see the module.

    Attributes:
        positions: of the nodes, shape (n + 1, 2) [D].
        heading: of the needle, shape (2,).
        density: v of each node, shape (n + 1,) [D^2].
        noise: q of each node, shape (n + 1,) [D^2/s].
        length: l, over which the model's errors are alike [D].
        stiffness: k [1/s].
    """

    positions: Points
    heading: Points
    density: Vector
    noise: Vector
    length: float
    stiffness: float


class CorrectionBuffers(NamedTuple):
    """Memory of a correction, kept from one to the next.

    Attributes:
        program: of the program, with room for two rows a segment besides those of the rod.
        solver: of the structured solver, with the factors of the last matrix.
        about: where the nodes are, shape (n + 1, 2) [D].
        moved: d, shape (n + 1, 2) [D].
        covariance: of each node after it, shape (n + 1, 2, 2) [D^2].
        normal_equations: of the points of each segment, shape (n, 5).
        inverse: of the last matrix, see `selected_inverse`.
    """

    program: StepBuffers
    solver: banded.SolverBuffers
    about: Points
    moved: Points
    covariance: Table
    normal_equations: Table
    inverse: Table

    @classmethod
    def of(cls, nodes: int) -> CorrectionBuffers:
        """Return buffers for a thread of so many nodes."""
        program, (about, moved) = StepBuffers.of(nodes, 2, 3 * (nodes - 1) + 1), np.zeros((2, nodes, 2))
        solver = BandedSolver().buffers(nodes, 2, len(program.first))
        tables = np.zeros((nodes, 2, 2)), np.zeros((nodes - 1, 5)), np.zeros((2 * nodes + 6, 7))
        return cls(program, solver, about, moved, *tables)


def normals_of(positions: Points) -> Points:
    """Return each node's unit normal, to the left of the way from the node before to the node after."""
    along = np.gradient(positions, axis=0)
    left = np.column_stack([-along[:, 1], along[:, 0]])
    return np.asarray(left / np.maximum(np.hypot(*along.T), 1e-12)[:, None])


@compiled_uncounted
def robust_weights(residual: Vector, variance: Vector, weights: Vector) -> float:
    """Write the weight of each point's error under Student's distribution; return the largest change.

        w = (f + 1) / (f + r^2 / s)

    with r less the median of the errors of its neighbours, where that is smaller: what many say is no outlier but
    where the thread is.

    Args:
        residual: r of each point.
        variance: s, the variance of r.
        weights: written, at most 1.
    """
    change, count = 0.0, len(residual)
    for p in range(count):
        first, last = max(0, p - NEIGHBOURS), min(count, p + NEIGHBOURS + 1)
        off = residual[p]
        for k in range(first, last):
            below = 0
            for j in range(first, last):
                below += residual[j] < residual[k] or (residual[j] == residual[k] and j < k)
            if below == (last - first) // 2 and abs(residual[p] - residual[k]) < abs(residual[p]):
                off = residual[p] - residual[k]
        weight = min(1.0, (FREEDOM + 1.0) / (FREEDOM + off * off / variance[p]))
        change = max(change, abs(weight - weights[p]))
        weights[p] = weight
    return change


def prior_information(prior: Prior, scale: float, clamped: bool, buffers: StepBuffers) -> None:
    """Write Lambda over a scale into the program.

    Args:
        prior: the predicted thread, with v, q, l and k.
        scale: by which all is divided.
        clamped: whether the thread's direction at the needle is known.
        buffers: written: blocks, couplings, linear.
    """
    density, normals, couplings = scale * prior.density, normals_of(prior.positions), buffers.couplings
    buffers.linear[:], couplings[:] = 0.0, 0.0
    alike = prior.length**2 / (0.5 * (density[:-1] + density[1:]))
    # More, on the thread's longest bending wave, than the points have changes nothing.
    stiffest = 10.0 * (len(density) / np.pi) ** 4
    bending = np.minimum(2.0 * prior.stiffness / (scale * prior.noise), stiffest)[:-1]
    # Half a segment of curvature 2 (d_1 - d_0) at a clamp.
    clamp, bending = 2.0 * bending[0] if clamped else 0.0, bending[1:]
    own = 1e-6 / density  # the chords hold it along the thread
    own[:-1] += alike
    own[1:] += alike
    own[:2] += clamp
    own[:-2] += bending
    own[1:-1] += 4.0 * bending
    own[2:] += bending
    couplings[0, :-1] -= alike
    couplings[0, 0] -= clamp
    couplings[0, :-2] -= 2.0 * bending
    couplings[0, 1:-1] -= 2.0 * bending
    couplings[1, :-2] += bending
    across = normals[:, :, None] * normals[:, None, :] / density[:, None, None]
    buffers.blocks[:] = across + own[:, None, None] * np.eye(2)


@compiled_within
def measured_rows(points: MeasuredPoints, scale: float, about: Points, work: CorrectionBuffers) -> int:
    """Write the points of each segment as at most two rows, with the compliance as their variance; return the end.

    Points p of one segment have a_p in the span of two vectors, so that sum_p w_p (a_p' d - nu_p)^2 is, up to a
    constant, that of two rows: the Cholesky factor of their normal equations. Where the free end is seen, a last row
    holds it along the thread.

    Args:
        points: the points, with their robust weights.
        scale: by which information is divided.
        about: where segments' normals are taken, shape (n + 1, 2).
        work: its program is written, from the row after those of the segments on.
    """
    buffers, gram, segments = work.program, work.normal_equations, len(about) - 1
    place, innovation, weights = points.place, points.innovation, points.weight
    gram[:] = 0.0
    for p in range(len(place)):
        i = min(int(place[p]), segments - 1)
        t = place[p] - i
        w = weights[p] * points.share[p] / (points.variance[p] * scale)
        gram[i, 0] += w * (1.0 - t) * (1.0 - t)
        gram[i, 1] += w * (1.0 - t) * t
        gram[i, 2] += w * t * t
        gram[i, 3] += w * (1.0 - t) * innovation[p]
        gram[i, 4] += w * t * innovation[p]
    row, seen = segments, math.isfinite(points.end[1])
    for k in range(2 * segments + 1):
        i, part = min(k // 2, segments - 1), k % 2 if k < 2 * segments else 2
        ex, ey = about[i + 1, 0] - about[i, 0], about[i + 1, 1] - about[i, 1]
        size = math.hypot(ex, ey)
        root = math.sqrt(gram[i, 0])
        low, value = (gram[i, 1] / root, gram[i, 3] / root) if root > 0.0 else (0.0, 0.0)
        rest = gram[i, 2] - low * low
        if part == 0 and root > 0.0:
            _write_row(buffers, row, i, (root, low), value, (-ey / size, ex / size))
        elif part == 1 and rest > 1e-9 * (gram[i, 0] + gram[i, 2]):
            root = math.sqrt(rest)
            _write_row(buffers, row, i, (0.0, root), (gram[i, 4] - low * value) / root, (-ey / size, ex / size))
        elif part == 2 and seen:
            weight = 1.0 / math.sqrt(scale * points.end[1])
            _write_row(buffers, row, i, (0.0, weight), weight * points.end[0], (ex / size, ey / size))
        else:
            continue
        row += 1
    return row


@compiled_inline
def _write_row(
    buffers: StepBuffers,
    row: int,
    segment: int,
    weights: tuple[float, float],
    value: float,
    direction: tuple[float, float],
) -> None:
    """Write a row over the two nodes of a segment: of unit length, its weight in the compliance."""
    length, begin = math.hypot(weights[0], weights[1]), min(segment, len(buffers.linear) - 3)
    buffers.first[row] = begin
    for a in range(2):
        for k in range(3):
            buffers.gradient[row, k, a] = 0.0
        buffers.gradient[row, segment - begin, a] = weights[0] / length * direction[a]
        buffers.gradient[row, segment - begin + 1, a] = weights[1] / length * direction[a]
    buffers.lower[row] = buffers.upper[row] = value / length
    buffers.compliance[row] = 1.0 / (length * length)
    buffers.multipliers[row] = 0.0


@compiled_within
def selected_inverse(width: int, unknowns: int, band: Table, inverse: Table) -> None:
    """Write the entries within the band of the inverse of L D L', in time linear in its size.

        Z = D^-1 L^-1 + (I - L') Z,    column by column from the last

    Args:
        width: half-width of the band.
        unknowns: size of the matrix.
        band: L D L' as `banded.factorise` leaves it.
        inverse: written: [j, k] is the entry of row j + k and column j, shape (unknowns + width, width + 1).

    Source: K. Takahashi, J. Fagan, M.-S. Chen 1973.
    """
    inverse[:] = 0.0
    for j in range(unknowns - 1, -1, -1):
        for a in range(width, -1, -1):
            value = band[j, 0] if a == 0 else 0.0
            for k in range(1, width + 1):
                low, high = (a, k) if a <= k else (k, a)
                # Z[j + a, j + k], which for a = 0 is in the column being written.
                value -= band[j, k] * (inverse[j, k] if a == 0 else inverse[j + low, high - low])
            inverse[j, a] = value


@compiled_uncounted
def correct(
    rod: RodProperties,
    workspace: WorkspaceData,
    work: CorrectionBuffers,
    prior: Prior,
    scale: float,
    points: MeasuredPoints,
) -> tuple[int, float, float]:
    """Correct a thread by measured points: linearise, check, solve and weigh the points anew, until the barriers hold.

    Args:
        rod: the thread.
        workspace: obstacles and wall [m].
        work: the program holds Lambda and the known nodes; `about` gets the corrected thread, `moved` the correction,
            `covariance` what is left.
        prior: the predicted thread.
        scale: of the program.
        points: the points, with robust weights to begin with; in the end those used.

    Returns:
        Number of contacts, -1 where there is no room for them; the largest error of the hard constraints over what is
        allowed, at most 1 where they hold; the largest residual of the last solve.
    """
    buffers, start, segments = work.program, prior.positions, len(prior.positions) - 1
    about, moved = work.about, work.moved
    for i in range(segments + 1):
        for a in range(2):
            about[i, a], moved[i, a] = start[i, a], 0.0
    buffers.multipliers[:] = 0.0
    buffers.push[:] = 0.0
    solves, change, largest, row = 0, 1.0, 0.0, 0
    while True:
        if change > CHANGED:
            row = measured_rows(points, scale, start, work)
        mechanics.chord_lengths(about, prior.heading, rod.clamped, buffers.chords)
        strain = segment_rows(buffers, about, start, 1.0)
        contacts, depth = contact_rows(buffers, row, workspace, about, start, 1.0, rod.unit, rod.radius, True)
        off = max(strain / STRAIN_TOLERANCE, depth / DEPTH_TOLERANCE)
        done = off <= 1.0 and change <= CHANGED and largest <= RESIDUAL_TOLERANCE
        if contacts < 0 or (solves > 0 and (done or solves >= 8)):
            break
        for r in range(segments, row):
            buffers.multipliers[r] = 0.0
        program, multipliers = program_view(buffers, row + contacts), buffers.multipliers[: row + contacts]
        banded.solve(program, moved, multipliers, work.solver)
        solves, largest = solves + 1, max(residuals_with(program, moved, multipliers, buffers.work))
        if not largest < np.inf:
            break
        for i in range(segments + 1):
            for a in range(2):
                about[i, a] = start[i, a] + moved[i, a]
        # Three solutions get new robust weights.
        change = _weigh(points, start, moved) if solves < 3 else 0.0
    if contacts >= 0 and largest <= RESIDUAL_TOLERANCE:
        inverse = work.inverse
        selected_inverse(6, 2 * segments + 2, work.solver.band, inverse)
        for i in range(segments + 1):
            for a in range(2):
                for b in range(2):
                    value = inverse[2 * i + min(a, b), abs(a - b)] / scale
                    work.covariance[i, a, b] = 0.0 if buffers.known[i] else value
    return contacts, off, largest


@compiled_within
def _weigh(points: MeasuredPoints, start: Points, moved: Points) -> float:
    """Write the robust weights of points against a corrected thread; return the largest change."""
    for p in range(len(points.place)):
        i = min(int(points.place[p]), len(start) - 2)
        t = points.place[p] - i
        ex, ey = start[i + 1, 0] - start[i, 0], start[i + 1, 1] - start[i, 1]
        dx = (1.0 - t) * moved[i, 0] + t * moved[i + 1, 0]
        dy = (1.0 - t) * moved[i, 1] + t * moved[i + 1, 1]
        points.residual[p] = points.innovation[p] - (ex * dy - ey * dx) / math.hypot(ex, ey)
    return robust_weights(points.residual, points.variance, points.weight)


class Correction(NamedTuple):
    """A corrected thread.

    Attributes:
        problem: why the thread is not corrected; empty where the program was solved and the constraints hold.
        residual: the largest of the last solve.
        positions: of the nodes, shape (n + 1, 2) [D].
        moved: by how much each node was, shape (n + 1, 2) [D].
        covariance: of each node after it, shape (n + 1, 2, 2) [D^2].
        hidden: part of the thread that no point shows.
    """

    problem: str
    residual: float
    positions: Points
    moved: Points
    covariance: Table
    hidden: float


class Corrector:
    """Corrects a thread by measured points; see `correct`.

    Args:
        predictor: of the thread.
        formulation: its own.
    """

    def __init__(self, predictor: ThreadPredictor, formulation: RodFormulation) -> None:
        self._formulation, self._work = formulation, CorrectionBuffers.of(predictor.thread.segments + 1)
        self._correct = TypedKernel(correct)
        self._work.program.known[[0, *predictor.fixed_nodes]] = True

    def solve(self, prior: Prior, points: MeasuredPoints) -> Correction:
        """Solve the program about a predicted thread; the weights of the points are written."""
        rod, workspace, work = self._formulation.rod, self._formulation.workspace.data, self._work
        scale = float(max((1.0 / prior.density[1:]).max(), (points.share / points.variance).max()))
        prior_information(prior, scale, rod.clamped, work.program)
        contacts, off, residual = self._correct(rod, workspace, work, prior, scale, points)
        problem, segments = "", len(prior.positions) - 1
        if contacts < 0:
            problem = f"the correction has more than {CONTACTS_PER_NODE} contacts a node"
        elif not residual <= RESIDUAL_TOLERANCE or off > 1.0:
            problem = f"the correction was not solved: residual {residual:.1e}, off by {off:.1g}"
        shown = np.unique(np.minimum(points.place.astype(np.int64), segments - 1))
        arrays = work.about.copy(), work.moved.copy(), work.covariance.copy()
        return Correction(problem, residual, *arrays, 1.0 - len(shown) / segments)
