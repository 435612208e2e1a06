"""Mechanics of an inextensible rod, of higher order in the segment: metric, bending, chords, tension; and forces.

All in units of the segment length D, so that x is dimensionless, a velocity is in 1/s, and a curvature is
the angle by which the thread turns at a node.

Why of higher order: a chain of 25 segments is coarse. With plain second differences, the arc's length on
the chord and each cell's own tangent, the reference set's worst thread is wrong by 0.25 % of its length at
66 Hz (a trial, with first-order steps); with what is here, by 0.03 %.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from magnetosuture_thread.geometry.compiled import compiled, compiled_inline, compiled_inner, compiled_within
from magnetosuture_thread.geometry.polyline import Points, Table, Vector
from magnetosuture_thread.thread.margins import FrictionState
from magnetosuture_thread.thread.program import CONTACT, END, END_VELOCITIES, INTERNAL, SPAN, RodBuffers

END_CORRECTION = 1.0 / 12.0  # of a quadrature at its end
CURVATURE_CORRECTION = 1.0 / 6.0  # of the energy, by the slope of the curvature
CLAMP_CORRECTION = 1.5  # the same in the first segment of a clamped thread


class RodProperties(NamedTuple):
    """What stays the same from step to step, for compiled code; D is the segment length.

    Attributes:
        clamped: whether the thread leaves along the needle's axis.
        unit: D [m].
        radius: rho, of the thread [m].
        bending_stiffness: EI [N m^2].
        drag_across: zeta_perp [Pa s].
        drag_along: zeta_par [Pa s].
        mass_per_length: mu [kg/m].
        bending_damping: tau [s].
        gravity: shape (d,) [m/s^2].
        rest_angles: theta_i, shape (n - 1,) [rad].
        weights: of the nodes, see `end_corrected_weights`, shape (n + 1,).
        bands: of the bending Hessian, see `bending_bands`, shape (4, n + 1).
        flow: w of the medium, shape (d,) [m/s].
    """

    clamped: bool
    unit: float
    radius: float
    bending_stiffness: float
    drag_across: float
    drag_along: float
    mass_per_length: float
    bending_damping: float
    gravity: Vector
    rest_angles: Vector
    weights: Vector
    bands: Table
    flow: Vector


@compiled_inner
def metric(positions: Points, weights: Vector, inertia: float, across: float, along: float, blocks: Table) -> None:
    """Write the metric Z_i of each node.

        Z_i = w_i (inertia + across (I - t_i t_i') + along t_i t_i')

    with the tangent t_i from the node before to the node after.

    Args:
        positions: all nodes, shape (n + 1, d).
        weights: w_i, how many segments each node stands for, shape (n + 1,).
        inertia: mu / dt over the unit of the metric.
        across: zeta_perp over the same unit.
        along: zeta_par over the same unit.
        blocks: written, shape (n + 1, d, d).

    Source: resistive force theory. Deviation: the paper weighs all nodes alike, Z_i = I.
    """
    nodes, dimension = positions.shape
    for i in range(nodes):
        before, after = max(i - 1, 0), min(i + 1, nodes - 1)
        square = 0.0
        for a in range(dimension):
            square += (positions[after, a] - positions[before, a]) ** 2
        # Without a direction, where a thread is folded upon itself, the drag is that across.
        scale = weights[i] * (across - along) / square if square > 0.0 else 0.0
        for a in range(dimension):
            for b in range(dimension):
                blocks[i, a, b] = -scale * (
                    (positions[after, a] - positions[before, a]) * (positions[after, b] - positions[before, b])
                )
            blocks[i, a, a] += weights[i] * (inertia + across)


def end_corrected_weights(segments: int) -> Vector:
    """Return how many segments each node stands for, shape (n + 1,).

        w = 1/2, 1, ..., 1, 13/12, 5/12

    Half of each adjacent segment, with Gregory's end correction at the free end: the integral of what acts
    along the thread is then of third order in D there. Half a segment's drag at the free end instead of a
    whole one matters most: it is the end that moves freely.

    Source: J. Gregory's quadrature. Deviation: the paper weighs all nodes alike.
    """
    weights = np.ones(segments + 1)
    weights[0] = 0.5
    weights[-1] = 0.5 - END_CORRECTION
    weights[-2] += END_CORRECTION
    return weights


def bending_bands(segments: int, clamped: bool) -> Vector:
    """Return the bands of the bending Hessian K, shape (4, n + 1): K[i, i + k] is at [k, i].

        E_bend / (EI / D) = 1/2 sum_i w_i |c_i|^2  +  1/2 sum_i (1/6) |c_{i+1} - c_i|^2
        c_i = x_{i+1} - 2 x_i + x_{i-1} - rest_i,    c_0 = 2 (x_1 - x_0 + heading) if clamped, else 0

    with w_i = 1, but 1/2 at the clamp, which stands for half a segment; the last difference runs to the
    free end, where c_n = 0, and the first is weighed by 3/2 if clamped. The second sum undoes what second
    differences blur: without it the energy is too low by (D^2 / 12) EI times the integral of the squared
    slope of the curvature. A clamped beam under an even load is then right to fourth order in D, and to
    second without.

    Source: discrete elastic rod, Euler-Maclaurin. Deviation: the paper has the stiffness CLF V_i instead,
    which is of fourth order in the bending angle.
    """
    curvatures = sp.diags([1.0, -2.0, 1.0], [-1, 0, 1], shape=(segments, segments + 1)).tolil()
    curvatures[0, 0], curvatures[0, 1] = (-2.0, 2.0) if clamped else (0.0, 0.0)
    weights = np.ones(segments)
    weights[0] = 0.5 if clamped else 0.0
    slopes = sp.diags([-1.0, 1.0], [0, 1], shape=(segments, segments))
    slope_weights = np.full(segments, CURVATURE_CORRECTION)
    if clamped:
        slope_weights[0] *= CLAMP_CORRECTION
    middle = sp.diags(weights) + slopes.T @ sp.diags(slope_weights) @ slopes
    hessian = sp.csr_matrix(curvatures.T @ middle @ curvatures)
    bands = np.zeros((4, segments + 1))
    for apart in range(4):
        bands[apart, : segments + 1 - apart] = hessian.diagonal(apart)
    return bands


@compiled_inner
def bending_gradient(
    positions: Points, heading: Points, clamped: bool, rest_angles: Vector, work: Points, gradient: Points
) -> None:
    """Write the derivative of E_bend / (EI / D) by every node's position.

    Args:
        positions: all nodes, shape (n + 1, d).
        heading: unit vector along the needle, used if clamped, shape (d,).
        clamped: whether the thread is clamped to the needle.
        rest_angles: angle by which the thread at rest turns at each inner node, shape (n - 1,).
        work: any memory, at least shape (2, n + 1, d).
        gradient: written, shape (n + 1, d).
    """
    nodes, dimension = positions.shape
    segments = nodes - 1
    deviation, moment = work[0], work[1]
    for i in range(segments):
        for a in range(dimension):
            deviation[i, a] = _turn(positions, heading, i, a) if clamped or i > 0 else 0.0
        if i > 0 and rest_angles[i - 1] != 0.0:
            _take_rest(positions, i, rest_angles[i - 1], deviation)
    for i in range(segments):
        weight = 1.0 if i > 0 else (0.5 if clamped else 0.0)
        after = CURVATURE_CORRECTION * (CLAMP_CORRECTION if clamped and i == 0 else 1.0)
        before = CURVATURE_CORRECTION * (CLAMP_CORRECTION if clamped and i == 1 else 1.0)
        for a in range(dimension):
            following = deviation[i + 1, a] if i + 1 < segments else 0.0
            value = weight * deviation[i, a] - after * (following - deviation[i, a])
            if i > 0:
                value += before * (deviation[i, a] - deviation[i - 1, a])
            moment[i, a] = value
    for a in range(dimension):
        for i in range(nodes):
            gradient[i, a] = 0.0
        if clamped:
            gradient[0, a] -= 2.0 * moment[0, a]
            gradient[1, a] += 2.0 * moment[0, a]
        for i in range(1, segments):
            gradient[i - 1, a] += moment[i, a]
            gradient[i, a] -= 2.0 * moment[i, a]
            gradient[i + 1, a] += moment[i, a]


@compiled_within
def _take_rest(positions: Points, i: int, turn: float, deviation: Points) -> None:
    """Take the rest curvature at a node from its deviation: in the plane to the left, in space as it bends."""
    dimension = positions.shape[1]
    if dimension == 2:
        along, up = positions[i + 1, 0] - positions[i - 1, 0], positions[i + 1, 1] - positions[i - 1, 1]
        size = math.hypot(along, up)
        if size > 0.0:
            deviation[i, 0] += turn * up / size
            deviation[i, 1] -= turn * along / size
        return
    size = 0.0
    for a in range(dimension):
        size += deviation[i, a] ** 2
    size = math.sqrt(size)
    if size > 0.0:
        for a in range(dimension):
            deviation[i, a] -= abs(turn) * deviation[i, a] / size


@compiled_inner
def chord_lengths(positions: Points, heading: Points, clamped: bool, chords: Vector) -> None:
    """Write the length of the chord between the ends of each segment, whose arc is 1 long, shape (n,).

        chord / arc = 1 - kappa^2 / 24

    with the mean of the squared turns at both ends, where the segments resolve them. A chain whose chords had the arc's
    length would be too long wherever it bends.

    Source: series of the sine. Deviation: the paper makes no difference between chord and arc.
    """
    nodes, dimension = positions.shape
    chords[:] = 1.0
    for i in range(nodes - 1):
        square = 0.0
        for a in range(dimension):
            if clamped or i > 0:
                square += _turn(positions, heading, i, a) ** 2
        share = _resolved(square)[0] / 48.0
        chords[i] -= share
        if i > 0:
            chords[i - 1] -= share


@compiled_inner
def tension_stiffness(
    positions: Points,
    heading: Points,
    clamped: bool,
    tension: Vector,
    min_tension: float,
    interval: float,
    program: tuple[Vector, Vector, Vector],
) -> None:
    """Add what the tension does through the chords, implicit in u.

        E_tension = 1/2 sum_i  (T_i + T_{i+1}) / 24  |c_i(x + dt u)|^2,    c_i = x_{i+1} - 2 x_i + x_{i-1}

    The chord's length falls with the curvature, see `chord_lengths`, so a tension T straightens: the
    derivative of the length by the curvature belongs to the segment's gradient. It is put here instead,
    with the tension of the last solve, as it would otherwise make the row reach over four nodes.

    Args:
        positions: all nodes, shape (n + 1, d).
        heading: unit vector along the needle, used if clamped, shape (d,).
        clamped: whether the thread is clamped to the needle.
        tension: multipliers of the segments, shape (n,) or longer.
        min_tension: bound for a thread that is pushed, negative: never more than bending makes up for.
        interval: dt [s].
        program: blocks, couplings and q, which are added to.

    Source: Lagrange's multipliers. Deviation: the paper makes no difference between chord and arc.
    """
    blocks, couplings, linear = program
    nodes, dimension = positions.shape
    for i in range(0 if clamped else 1, nodes - 1):
        pull = max((tension[i] + (tension[i - 1] if i > 0 else 0.0)) / 24.0, min_tension)
        square = 0.0
        for a in range(dimension):
            square += _turn(positions, heading, i, a) ** 2
        pull *= _resolved(square)[1]
        near, outer, far = (1.0, -2.0, 1.0) if i > 0 else (0.0, -2.0, 2.0)
        weight = interval * pull
        for a in range(dimension):
            force = pull * _turn(positions, heading, i, a)
            if i > 0:
                linear[i - 1, a] += near * force
                blocks[i - 1, a, a] += near * near * weight
            linear[i, a] += outer * force
            blocks[i, a, a] += outer * outer * weight
            linear[i + 1, a] += far * force
            blocks[i + 1, a, a] += far * far * weight
        couplings[0, i] += outer * far * weight
        if i > 0:
            couplings[0, i - 1] += near * outer * weight
            couplings[1, i - 1] += near * far * weight


@compiled_inline
def _resolved(square: float) -> tuple[float, float]:
    """Return the part of a squared turn that a chord is corrected for, and its slope.

        f(c^2) = c^2 (1 - c^4)

    A turn of more than 1 rad is a kink that these segments do not resolve; it does not shorten the chords beside it.
    """
    if square >= 1.0:
        return 0.0, 0.0
    return square * (1.0 - square * square), max(0.0, 1.0 - 3.0 * square * square)


@compiled_inline
def _turn(positions: Points, heading: Points, i: int, a: int) -> float:
    """Return a coordinate of c_i; c_0 is that of a clamped thread."""
    if i == 0:
        return float(2.0 * (positions[1, a] - positions[0, a] + heading[a]))
    return float(positions[i + 1, a] - 2.0 * positions[i, a] + positions[i - 1, a])


@dataclass(frozen=True, eq=False)
class ThreadForces:
    """The forces in a thread and on it, at the end of a step.

    A row's multiplier is the force that keeps its barrier. With the program in units of the segment's length D, and of
    the metric's scale Z = zeta_perp + mu / dt, and f_j what the thread's own segments push node j with, by tension and
    bending (`keep_internal_forces`),

        T_i = Z D^2 t_i' sum_{j<i} f_j,    N_i = Z D^2 sum_c lambda_c n_c

    over the contacts c of node i, those of friction included. The thread pulls the needle with what its first segment
    does, and with the loads on half of that,

        F = Z D^2 f_0 + N_0 + (D / 2) (mu (g - dv / dt) - zeta_perp v + (zeta_perp - zeta_par) t_1 t_1' v)

    with the tail's velocity v, in the drag against the medium, and turns it, if clamped, by
    M = -dE_bend / d(heading angle).

    Attributes:
        tension: T_i of each segment, positive where it is pulled, shape (n,) [N]: what the one half of the thread pulls
            at the other with, along the segment.
        contact: N_i, the force of shapes and wall upon each node, shape (n + 1, d) [N].
        needle_force: F, of the thread upon the needle, at its tail, shape (d,) [N].
        needle_moment: M about the tail, counter-clockwise, 0 of a pinned thread; in the plane only, else NaN [N m].
        friction: the part of N_i along the shapes, shape (n + 1,) [N].
        friction_use: the same over its limit mu N of the shape where it is nearest to it: 1 where the node slides, 0
            where it has no friction, shape (n + 1,).

    Source: Lagrange's multipliers; the paper works no force out. Deviation: none but that friction on the first segment
    is not in F.
    """

    tension: Vector
    contact: Points
    needle_force: Vector
    needle_moment: float
    friction: Vector
    friction_use: Vector

    @property
    def friction_states(self) -> tuple[FrictionState, ...]:
        """Of each node: free of friction, stuck, or sliding."""
        # A node slides where its friction is within 1e-6 of its limit.
        slides, sticks = self.friction_use >= 1.0 - 1e-6, self.friction_use > 0.0
        return tuple(
            FrictionState.SLIDING if slide else FrictionState.STUCK if stick else FrictionState.FREE
            for slide, stick in zip(slides.tolist(), sticks.tolist(), strict=True)
        )

    @property
    def peak_tension(self) -> float:
        """The greatest tension of all segments [N]."""
        return float(np.max(self.tension))


@compiled_within
def keep_internal_forces(buffers: RodBuffers, rows: int, interval: float) -> None:
    """Keep what the segments push each node with, and what medium and contacts do at the needle's tail.

    A solution balances at each free node what the segments, the medium and contacts do. What the segments do is P u + q
    without the medium's part, and the multipliers of the segments' rows:

        f_i = lambda_i g_i(y) - (P - R) u - (q - r),    R u + r = the medium's part

    So the forces of all nodes add up to nothing, and are in balance with the loads. Multipliers and bending taken at
    the step's end, in place of y, are not: short segments are so stiff in bending that tenths of a micrometre count.

    Args:
        buffers: of the program that was solved, with its solution; written.
        rows: of the program.
        interval: dt [s].
    """
    program, motion, velocities = buffers.program, buffers.motion, buffers.motion.velocities
    nodes, dimension = velocities.shape
    internal, contact, load = buffers.end[INTERNAL], buffers.end[CONTACT], buffers.tail_load
    multipliers = program.multipliers
    blocks, couplings, contacts = program.blocks, program.couplings, program.contacts
    drag, drag_linear, gradient = buffers.drag, buffers.drag_linear, program.gradient
    for i in range(nodes):
        for a in range(dimension):
            value = program.linear[i, a] - drag_linear[i, a]
            for b in range(dimension):
                value += (blocks[i, a, b] - drag[i, a, b]) * velocities[i, b]
            for apart in range(1, min(SPAN, nodes - 1 - i) + 1):
                value += couplings[apart - 1, i] * velocities[i + apart, a]
            for apart in range(1, min(SPAN, i) + 1):
                value += couplings[apart - 1, i - apart] * velocities[i - apart, a]
            internal[i, a] = -value
    for row in range(nodes - 1):
        for k in range(SPAN):
            for a in range(dimension):
                internal[program.first[row] + k, a] += multipliers[row] * gradient[row, k, a]
    for a in range(dimension):
        load[a] = contact[0, a] - drag_linear[0, a]
        for b in range(dimension):
            load[a] -= drag[0, a, b] * (motion.start[0, b] - motion.before[0, b]) / interval
    # A row of a contact has no gradient at a node that is known, whose share is with the needle.
    for row in range(nodes - 1, rows):
        c = row - nodes + 1
        if program.known[0] and contacts.node[c] == 0 and program.limit[row] == np.inf:
            for a in range(dimension):
                load[a] += (1.0 - contacts.place[c]) * contacts.normal[c, a] * multipliers[row]


@compiled
def write_forces(
    rod: RodProperties, end: Table, tail_load: Vector, interval: float, heading: Points, tension: Vector, force: Vector
) -> tuple[float, float]:
    """Write the tension of each segment [N] and the force upon the needle [N]; return the moment about its tail [N m].

    Args:
        rod: its properties.
        end: of the step, see `RodBuffers`.
        tail_load: what medium and contacts push node 0 with, shape (d,).
        interval: duration of the step [s].
        heading: unit vector along the needle, shape (d,).
        tension: written, shape (n,).
        force: written, shape (d,).

    Returns:
        The moment, counter-clockwise; 0 of a pinned thread, NaN in space, where it is no single number; and the force
        of a unit of the loads [N].
    """
    positions, internal = end[END], end[INTERNAL]
    nodes, dimension = positions.shape
    scale = (rod.drag_across + rod.mass_per_length / interval) * rod.unit**2
    tangent, passed = np.zeros(dimension), np.zeros(dimension)
    for a in range(dimension):
        force[a] = scale * (internal[0, a] + tail_load[a])
    for i in range(nodes - 1):
        chord = 0.0
        for a in range(dimension):
            tangent[a] = positions[i + 1, a] - positions[i, a]
            chord += tangent[a] ** 2
        chord = math.sqrt(chord)
        tension[i] = 0.0
        for a in range(dimension):
            tangent[a] /= chord
            passed[a] += internal[i, a]  # what the thread behind pulls at that before
            tension[i] += scale * passed[a] * tangent[a]
    # The end correction takes some of the load on the last segment from the node behind its middle.
    along = 0.0
    for a in range(dimension):
        slip = end[END_VELOCITIES, nodes - 1, a] - rod.flow[a]
        along += tangent[a] * (rod.mass_per_length * rod.gravity[a] - rod.drag_along * slip)
    tension[nodes - 2] += END_CORRECTION * rod.unit * along
    if not rod.clamped:
        return 0.0, scale
    if dimension != 2:
        return np.nan, scale
    work, points = np.zeros((3, nodes, dimension)), np.empty((nodes, dimension))
    for i in range(nodes):
        for a in range(dimension):
            points[i, a] = positions[i, a] / rod.unit
    bending_gradient(points, heading, rod.clamped, rod.rest_angles, work, work[2])
    bending = rod.bending_stiffness / rod.unit
    return -2.0 * bending * (work[1, 0, 1] * heading[0] - work[1, 0, 0] * heading[1]), scale


def friction_of(grip: Table) -> tuple[Vector, Vector]:
    """Return friction on each node, that of chords shared by their nodes, and the greatest ratio to its limit.

    Args:
        grip: as in `GripBuffers`.
    """
    rubbed, limit, place = np.abs(grip[..., 2]), grip[..., 3], grip[..., 4]
    ratio = np.divide(rubbed, limit, out=np.zeros_like(limit), where=limit > 0.0).max(axis=2)
    first, second = ((1.0 - place) * rubbed).sum(axis=2), (place * rubbed).sum(axis=2)
    friction, use = first[0] + first[1], np.maximum(ratio[0], ratio[1])
    friction[1:] += second[1, :-1]
    use[1:] = np.maximum(use[1:], ratio[1, :-1])
    return friction, use
