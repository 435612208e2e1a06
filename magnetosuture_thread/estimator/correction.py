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

from magnetosuture_thread.estimator.association import MeasuredPoints
from magnetosuture_thread.geometry.compiled import compiled, compiled_inline
from magnetosuture_thread.geometry.obstacles import WorkspaceData
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread import banded, mechanics
from magnetosuture_thread.thread.contact_rows import DEPTH_TOLERANCE, contact_rows
from magnetosuture_thread.thread.mechanics import RodProperties
from magnetosuture_thread.thread.predictor import ThreadPredictor
from magnetosuture_thread.thread.program import CONTACTS_PER_NODE, StepBuffers, compiled_residuals, program_of
from magnetosuture_thread.thread.rod import STRAIN_TOLERANCE, RodFormulation, segment_rows
from magnetosuture_thread.thread.solvers import BandedSolver

Vector = NDArray[np.float64]

MAX_SOLVES = 8  # of a correction
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
    """

    program: StepBuffers
    solver: banded.SolverBuffers
    about: Points
    moved: Points
    covariance: NDArray[np.float64]

    @classmethod
    def of(cls, nodes: int) -> CorrectionBuffers:
        """Return buffers for a thread of so many nodes."""
        program, (about, moved) = StepBuffers.of(nodes, 2, 3 * (nodes - 1) + 1), np.zeros((2, nodes, 2))
        solver = BandedSolver().buffers(nodes, 2, len(program.first))
        return cls(program, solver, about, moved, np.zeros((nodes, 2, 2)))


def normals_of(positions: Points) -> Points:
    """Return each node's unit normal, to the left of the way from the node before to the node after."""
    along = np.gradient(positions, axis=0)
    left = np.column_stack([-along[:, 1], along[:, 0]])
    return np.asarray(left / np.maximum(np.hypot(*along.T), 1e-12)[:, None])


@compiled
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


@compiled
def measured_rows(points: MeasuredPoints, scale: float, about: Points, row: int, buffers: StepBuffers) -> int:
    """Write the points of each segment as at most two rows, with the compliance as their variance; return the end.

    Points p of one segment have a_p in the span of two vectors, so that sum_p w_p (a_p' d - nu_p)^2 is, up to a
    constant, that of two rows: the Cholesky factor of their normal equations. Where the free end is seen, a last row
    holds it along the thread.

    Args:
        points: the points, with their robust weights.
        scale: by which information is divided.
        about: where segments' normals are taken, shape (n + 1, 2).
        row: the first row.
        buffers: written from that row on.
    """
    segments = len(about) - 1
    gram = np.zeros((segments, 5))
    for p in range(len(points.place)):
        i = min(int(points.place[p]), segments - 1)
        t = points.place[p] - i
        w = points.weight[p] * points.share[p] / (points.variance[p] * scale)
        gram[i, 0] += w * (1.0 - t) * (1.0 - t)
        gram[i, 1] += w * (1.0 - t) * t
        gram[i, 2] += w * t * t
        gram[i, 3] += w * (1.0 - t) * points.innovation[p]
        gram[i, 4] += w * t * points.innovation[p]
    for i in range(segments):
        total = gram[i, 0] + gram[i, 2]
        if total <= 0.0:
            continue
        ex, ey = about[i + 1, 0] - about[i, 0], about[i + 1, 1] - about[i, 1]
        size = np.hypot(ex, ey)
        low, value = 0.0, 0.0
        if gram[i, 0] > 0.0:
            root = np.sqrt(gram[i, 0])
            low, value = gram[i, 1] / root, gram[i, 3] / root
            _write_row(buffers, row, i, (root, low), value, (-ey / size, ex / size))
            row += 1
        rest = gram[i, 2] - low * low
        if rest > 1e-9 * total:
            root = np.sqrt(rest)
            _write_row(buffers, row, i, (0.0, root), (gram[i, 4] - low * value) / root, (-ey / size, ex / size))
            row += 1
    if np.isfinite(points.end[1]):
        ex, ey = about[segments, 0] - about[segments - 1, 0], about[segments, 1] - about[segments - 1, 1]
        size, weight = np.hypot(ex, ey), 1.0 / np.sqrt(scale * points.end[1])
        _write_row(buffers, row, segments - 1, (0.0, weight), weight * points.end[0], (ex / size, ey / size))
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
    length, begin = np.hypot(weights[0], weights[1]), min(segment, len(buffers.linear) - 3)
    buffers.first[row], buffers.gradient[row] = begin, 0.0
    for k in range(2):
        for a in range(2):
            buffers.gradient[row, segment - begin + k, a] = weights[k] / length * direction[a]
    buffers.lower[row] = buffers.upper[row] = value / length
    buffers.compliance[row] = 1.0 / (length * length)
    buffers.multipliers[row] = 0.0


@compiled
def selected_inverse(width: int, unknowns: int, band: NDArray[np.float64], inverse: NDArray[np.float64]) -> None:
    """Write the entries within the band of the inverse of L D L', in time linear in its size.

        Z = D^-1 L^-1 + (I - L') Z,    column by column from the last

    Args:
        width: half-width of the band.
        unknowns: size of the matrix.
        band: L D L' as `banded.factorise` leaves it.
        inverse: written: [j, k] is the entry of row j + k and column j, shape (unknowns + width, width + 1).

    Source: K. Takahashi, J. Fagan, M.-S. Chen 1973.
    """
    inverse[unknowns:] = 0.0
    for j in range(unknowns - 1, -1, -1):
        for a in range(width, -1, -1):
            value = band[j, 0] if a == 0 else 0.0
            for k in range(1, width + 1):
                low, high = (a, k) if a <= k else (k, a)
                # Z[j + a, j + k], which for a = 0 is in the column being written.
                value -= band[j, k] * (inverse[j, k] if a == 0 else inverse[j + low, high - low])
            inverse[j, a] = value


@compiled
def correct(
    rod: RodProperties,
    workspace: WorkspaceData,
    work: CorrectionBuffers,
    start: Points,
    heading: Points,
    scale: float,
    points: MeasuredPoints,
) -> tuple[int, float, float]:
    """Correct a thread by measured points.

    Args:
        rod: the thread.
        workspace: obstacles and wall [m].
        work: the program holds Lambda and the known nodes; `about` gets the corrected thread, `moved` the correction,
            `covariance` what is left.
        start: the predicted nodes, shape (n + 1, 2) [D].
        heading: of the needle, shape (2,).
        scale: of the program.
        points: the points, with robust weights to begin with; in the end those used.

    Returns:
        Number of contacts, -1 where there is no room for them; the largest error of the hard constraints over what is
        allowed, at most 1 where they hold; the largest residual of the last solve.
    """
    buffers, segments, contacts = work.program, len(start) - 1, 0
    known, about, moved = buffers.known, work.about, work.moved
    about[:], moved[:], buffers.multipliers[:], buffers.push[:] = start, 0.0, 0.0, 0.0
    residual = np.empty(len(points.place))
    solves, change, off, largest, row = 0, 1.0, np.inf, 0.0, segments
    while True:
        if change > CHANGED:
            row = measured_rows(points, scale, start, segments, buffers)
        mechanics.chord_lengths(about, heading, rod.clamped, buffers.chords)
        strain = segment_rows(buffers, about, start, 1.0)
        contacts, depth = contact_rows(buffers, row, workspace, about, start, 1.0, rod.unit, rod.radius, True)
        off = max(strain / STRAIN_TOLERANCE, depth / DEPTH_TOLERANCE)
        done = off <= 1.0 and change <= CHANGED and largest <= RESIDUAL_TOLERANCE
        if contacts < 0 or (solves > 0 and (done or solves >= MAX_SOLVES)):
            break
        rows = row + contacts
        u, multipliers = moved.copy(), buffers.multipliers[:rows].copy()
        program = program_of(buffers, rows)
        banded.solve(program, u, multipliers, work.solver)
        solves, largest = solves + 1, max(compiled_residuals(program, u, multipliers))
        if not largest < np.inf:
            break
        moved[:], about[:] = u, start + u
        buffers.multipliers[:segments] = multipliers[:segments]
        change = 0.0
        # Three solutions get new robust weights.
        if solves < 3:
            for p in range(len(residual)):
                i = min(int(points.place[p]), segments - 1)
                t = points.place[p] - i
                ex, ey = start[i + 1, 0] - start[i, 0], start[i + 1, 1] - start[i, 1]
                dx, dy = (1.0 - t) * u[i, 0] + t * u[i + 1, 0], (1.0 - t) * u[i, 1] + t * u[i + 1, 1]
                residual[p] = points.innovation[p] - (ex * dy - ey * dx) / np.hypot(ex, ey)
            change = robust_weights(residual, points.variance, points.weight)
    if contacts >= 0 and largest <= RESIDUAL_TOLERANCE:
        inverse = np.zeros((2 * segments + 8, 7))
        selected_inverse(6, 2 * segments + 2, work.solver.band, inverse)
        for i in range(segments + 1):
            for a in range(2):
                for b in range(2):
                    value = inverse[2 * i + min(a, b), abs(a - b)] / scale
                    work.covariance[i, a, b] = 0.0 if known[i] else value
    return contacts, off, largest


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
    covariance: NDArray[np.float64]
    hidden: float


class Corrector:
    """Corrects a thread by measured points; see `correct`.

    Args:
        predictor: of the thread.
        formulation: its own.
    """

    def __init__(self, predictor: ThreadPredictor, formulation: RodFormulation) -> None:
        self._formulation, self._work = formulation, CorrectionBuffers.of(predictor.thread.segments + 1)
        self._work.program.known[[0, *predictor.fixed_nodes]] = True

    def solve(self, prior: Prior, points: MeasuredPoints) -> Correction:
        """Solve the program about a predicted thread; the weights of the points are written."""
        rod, workspace, work = self._formulation.rod, self._formulation.workspace.data, self._work
        scale = float(max((1.0 / prior.density[1:]).max(), (points.share / points.variance).max()))
        prior_information(prior, scale, rod.clamped, work.program)
        contacts, off, residual = correct(rod, workspace, work, prior.positions, prior.heading, scale, points)
        problem, segments = "", len(prior.positions) - 1
        if contacts < 0:
            problem = f"the correction has more than {CONTACTS_PER_NODE} contacts a node"
        elif not residual <= RESIDUAL_TOLERANCE or off > 1.0:
            problem = f"the correction was not solved: residual {residual:.1e}, off by {off:.1g}"
        shown = np.unique(np.minimum(points.place.astype(np.int64), segments - 1))
        arrays = work.about.copy(), work.moved.copy(), work.covariance.copy()
        return Correction(problem, residual, *arrays, 1.0 - len(shown) / segments)
