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

from magnetosuture_thread.compiled import compiled, compiled_inline
from magnetosuture_thread.estimator.association import MeasuredPoints
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

AXES = (0, 1)
MAX_SOLVES = 8  # of a correction
MAX_REWEIGHTED = 3  # of them with new robust weights
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
        normals: of the nodes, shape (n + 1, 2).
        gram: normal equations of each segment's points, shape (n, 5).
        about: where the nodes are, shape (n + 1, 2) [D].
        moved: d, shape (n + 1, 2) [D].
        known: nodes that are no unknowns, shape (n + 1,).
        inverse: see `selected_inverse`.
        covariance: of each node, shape (n + 1, 2, 2) [D^2].
    """

    program: StepBuffers
    solver: banded.SolverBuffers
    normals: Points
    gram: NDArray[np.float64]
    about: Points
    moved: Points
    known: NDArray[np.bool_]
    inverse: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @classmethod
    def of(cls, nodes: int) -> CorrectionBuffers:
        """Return buffers for a thread of so many nodes."""
        program = StepBuffers.of(nodes, 2, 3 * (nodes - 1) + 1)
        return cls(
            program,
            BandedSolver().buffers(nodes, 2, len(program.first)),
            np.zeros((nodes, 2)),
            np.zeros((nodes - 1, 5)),
            np.zeros((nodes, 2)),
            np.zeros((nodes, 2)),
            np.zeros(nodes, dtype=np.bool_),
            np.zeros((2 * nodes + 6, 7)),
            np.zeros((nodes, 2, 2)),
        )


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


@compiled
def prior_information(prior: Prior, scale: float, clamped: bool, normals: Points, buffers: StepBuffers) -> None:
    """Write Lambda over a scale into the program.

    Args:
        prior: v, q, l and k.
        scale: by which all is divided.
        clamped: whether the thread's direction at the needle is known.
        normals: n_i, shape (n + 1, 2).
        buffers: written: blocks, couplings, linear.
    """
    density, noise, length, stiffness = prior.density, prior.noise, prior.length, prior.stiffness
    nodes = len(density)
    # More, on the thread's longest bending wave, than the points have changes nothing.
    stiffest = 10.0 * (nodes / np.pi) ** 4
    blocks, couplings = buffers.blocks, buffers.couplings
    buffers.linear[:], couplings[:] = 0.0, 0.0
    for i in range(nodes):
        across = 1.0 / (scale * density[i])
        for a in range(2):
            for b in range(2):
                blocks[i, a, b] = across * normals[i, a] * normals[i, b]
            # The chords hold it along the thread.
            blocks[i, a, a] += 1e-6 * across
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
    points: MeasuredPoints, scale: float, about: Points, row: int, gram: NDArray[np.float64], buffers: StepBuffers
) -> int:
    """Write the points of each segment as at most two rows, with the compliance as their variance; return the end.

    Points p of one segment have a_p in the span of two vectors, so that sum_p w_p (a_p' d - nu_p)^2 is, up to a
    constant, that of two rows: the Cholesky factor of their normal equations. Where the free end is seen, a last row
    holds it along the thread.

    Args:
        points: the points, with their robust weights.
        scale: by which information is divided.
        about: where segments' normals are taken, shape (n + 1, 2).
        row: the first row.
        gram: written, shape (n, 5).
        buffers: written from that row on.
    """
    gram[:] = 0.0
    segments = len(gram)
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
        normal = (-ey / size, ex / size)
        k = 0 if gram[i, 0] >= gram[i, 2] else 1  # the larger one of both pivots first
        root = np.sqrt(gram[i, 2 * k])
        low, value = gram[i, 1] / root, gram[i, 3 + k] / root
        rest = gram[i, 2 - 2 * k] - low * low
        _write_row(buffers, row, i, (root, low) if k == 0 else (low, root), value, normal)
        row += 1
        if rest > 1e-9 * total:
            root = np.sqrt(rest)
            value = (gram[i, 4 - k] - low * value) / root
            _write_row(buffers, row, i, (0.0, root) if k == 0 else (root, 0.0), value, normal)
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


CORRECTED, NO_ROOM, FAILED = range(3)


@compiled
def correct(
    rod: RodProperties, workspace: WorkspaceData, work: CorrectionBuffers, prior: Prior, points: MeasuredPoints
) -> tuple[int, int, float, float, float]:
    """Correct a thread by measured points.

    Args:
        rod: the thread.
        workspace: obstacles and wall [m].
        work: `known` is read; `about` gets the corrected thread, `moved` the correction, `covariance` what is left.
        prior: the predicted thread.
        points: the points, with robust weights to begin with; in the end those used.

    Returns:
        `CORRECTED`, `NO_ROOM` for contacts, or `FAILED`; number of solves; the largest error of the hard constraints
        over what is allowed, at most 1 where they hold; the largest residual of the last solve; the program's scale.
    """
    buffers, start, segments = work.program, prior.positions, len(prior.positions) - 1
    known, about, moved = work.known, work.about, work.moved
    normals_of(start, work.normals)
    scale = max((1.0 / prior.density[1:]).max(), (points.share / points.variance).max())
    about[:], moved[:], buffers.multipliers[:], buffers.push[:] = start, 0.0, 0.0, 0.0
    residual = np.empty(len(points.place))
    solves, change, off, largest, row = 0, 1.0, np.inf, 0.0, segments
    while True:
        if change > CHANGED:
            row = measured_rows(points, scale, start, segments, work.gram, buffers)
        mechanics.chord_lengths(about, prior.heading, rod.clamped, buffers.chords)
        strain = segment_rows(buffers, about, start, known, 1.0)
        contacts, depth = contact_rows(buffers, row, workspace, about, start, known, 1.0, rod.unit, rod.radius, True)
        if contacts < 0:
            return NO_ROOM, solves, off, largest, scale
        off = max(strain / STRAIN_TOLERANCE, depth / DEPTH_TOLERANCE)
        done = off <= 1.0 and change <= CHANGED and largest <= RESIDUAL_TOLERANCE
        if solves > 0 and (done or solves >= MAX_SOLVES):
            break
        prior_information(prior, scale, rod.clamped, work.normals, buffers)
        rows = row + contacts
        u, multipliers = moved.copy(), buffers.multipliers[:rows].copy()
        program = program_of(buffers, known, rows)
        banded.solve(program, u, multipliers, work.solver)
        solves, largest = solves + 1, max(compiled_residuals(program, u, multipliers))
        if not largest < np.inf:
            return FAILED, solves, off, largest, scale
        moved[:], about[:] = u, start + u
        buffers.multipliers[:segments] = multipliers[:segments]
        change = 0.0
        if solves < MAX_REWEIGHTED:
            for p in range(len(residual)):
                i = min(int(points.place[p]), segments - 1)
                t = points.place[p] - i
                ex, ey = start[i + 1, 0] - start[i, 0], start[i + 1, 1] - start[i, 1]
                dx, dy = (1.0 - t) * u[i, 0] + t * u[i + 1, 0], (1.0 - t) * u[i, 1] + t * u[i + 1, 1]
                residual[p] = points.innovation[p] - (ex * dy - ey * dx) / np.hypot(ex, ey)
            change = robust_weights(residual, points.variance, points.weight)
    if not largest <= RESIDUAL_TOLERANCE:
        return FAILED, solves, off, largest, scale
    selected_inverse(6, 2 * segments + 2, work.solver.band, work.inverse)
    for i in range(segments + 1):
        for a in range(2):
            for b in range(2):
                value = work.inverse[2 * i + min(a, b), abs(a - b)] / scale
                work.covariance[i, a, b] = 0.0 if known[i] else value
    return CORRECTED, solves, off, largest, scale


class Sensitivity(NamedTuple):
    """What a correction makes of the derivative of the nodes by a parameter, and what its residuals say of that.

    Attributes:
        corrected: V, shape (n + 1, 2) [D].
        information: J.
        score: s.
        square: squared innovations over their covariance, nu' S^-1 nu.
        independent: number of independent points.
    """

    corrected: Points
    information: float
    score: float
    square: float
    independent: float


class Corrector:
    """Corrects a thread by measured points; see `correct`.

    Args:
        predictor: of the thread.
        formulation: its own.

    Attributes:
        work: the last correction; where it moved the thread is in it.
        solves: number of its programs.
        residual: the largest of its last solve.
    """

    def __init__(self, predictor: ThreadPredictor, formulation: RodFormulation) -> None:
        nodes = predictor.thread.segments + 1
        self._formulation, self.work = formulation, CorrectionBuffers.of(nodes)
        self.work.known[[0, *predictor.fixed_nodes]] = True
        self.solves, self.residual = 0, 0.0
        self._last: tuple[Prior, MeasuredPoints, float]

    def solve(self, prior: Prior, points: MeasuredPoints) -> str:
        """Solve the program about a predicted thread; the weights of the points are written.

        Returns:
            Why the thread is not corrected; empty where the program was solved and the constraints hold.
        """
        rod, workspace = self._formulation.rod, self._formulation.workspace.data
        code, self.solves, off, self.residual, scale = correct(rod, workspace, self.work, prior, points)
        self._last = (prior, points, scale)
        if code == NO_ROOM:
            return f"the correction has more than {CONTACTS_PER_NODE} contacts a node"
        if code != CORRECTED or off > 1.0:
            return f"the correction was not solved: residual {self.residual:.1e}, off by {off:.1g}"
        return ""

    def sensitivity(self, derivative: Points) -> Sensitivity:
        """Return what the last correction makes of a derivative of the predicted nodes by a parameter.

        With U that derivative, M = Lambda + A' W A the matrix of the program with its constraints, d the correction and
        nu - A d what it leaves of the innovations,

            V = U - M^-1 A' W A U           derivative of the corrected nodes
            J = (A' W A U)' V               information of the frame on the parameter, U' A' S^-1 A U
            s = (A U)' W (nu - A d)         its score, U' A' S^-1 nu

        with S = A Lambda^-1 A' + W^-1 the covariance of the innovations, which is never written: the factor of the
        banded matrix, which the correction leaves, serves.

        Source: B. Friedland, Treatment of bias in recursive filtering, 1969; matrix inversion lemma. Deviation: the
        nodes are constrained, and M holds the constraints that were active.

        Args:
            derivative: U, shape (n + 1, 2) [D].
        """
        prior, points, scale = self._last
        along = np.diff(prior.positions, axis=0)
        along /= np.hypot(*along.T)[:, None]
        segment = np.minimum(points.place.astype(np.int64), len(along) - 1)
        part, innovation = points.place - segment, points.innovation
        direction = np.column_stack([-along[segment, 1], along[segment, 0]])
        precision = points.weight * points.share / points.variance
        independent = float((points.weight * points.share).sum())
        if np.isfinite(points.end[1]):
            segment, part = np.append(segment, len(along) - 1), np.append(part, 1.0)
            direction, innovation = np.vstack([direction, along[-1]]), np.append(innovation, points.end[0])
            precision, independent = np.append(precision, 1.0 / points.end[1]), independent + 1.0

        def measured(nodes: Points) -> Vector:
            between = (1.0 - part)[:, None] * nodes[segment] + part[:, None] * nodes[segment + 1]
            return np.asarray(np.einsum("pa,pa->p", direction, between))

        left, by = innovation - measured(self.work.moved), measured(derivative)
        pull = (precision * by)[:, None] * direction
        force = np.zeros_like(derivative)
        np.add.at(force, segment, (1.0 - part)[:, None] * pull)
        np.add.at(force, segment + 1, part[:, None] * pull)
        force[self.work.known] = 0.0
        solved = np.zeros(len(self.work.solver.band))
        solved[: force.size] = force.ravel() / scale
        banded.substitute(AXES, self.work.solver.band, solved)
        corrected = derivative - solved[: force.size].reshape(-1, 2)
        return Sensitivity(
            corrected,
            float((force * corrected).sum()),
            float(precision @ (left * by)),
            float(precision @ (left * innovation)),
            independent,
        )
