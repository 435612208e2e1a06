"""One implicit step of needle and thread together: a minimum of energy and work against the liquid."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.rig.mechanics.contact import Shapes
from magnetosuture_thread.rig.mechanics.friction import SLIP_SPEED, add_friction, find_friction
from magnetosuture_thread.rig.mechanics.needle import Needle, add_clamp, add_needle, turn_resistance
from magnetosuture_thread.rig.mechanics.rod import (
    WIDTH,
    Rod,
    add_bending,
    add_contact,
    add_drag,
    add_stretching,
    back_substitute,
    drag_matrices,
    factor,
)
from magnetosuture_thread.rig.mechanics.self_contact import add_pairs, couple, crosses_anew, find_pairs

MAX_ITERATIONS = 60
PAIRS_PER_NODE = 16  # rows of contact with itself
MIN_LINE_SEARCH = 1e-6
MIN_PART, MAX_PART = 2e-3, 0.5  # of a trial of the line search, for the next one
DESCENT = 1e-4  # of the decrease that the slope promises
ROUNDING = 1e-10  # of the energy, which is a sum of larger terms
MIN_ENERGY = 1e-18  # J; of a thread that moves by the tolerance
STALLED = 10.0  # times the tolerance; where the energy tells no better place apart, the last move is rounding


class NewtonBuffers(NamedTuple):
    """What a step works in, N = 2n + 3 unknowns.

    Trial state, step, right side, bands, drag, contact rows.

    Of friction: what rubs, the state that slip is measured from, and the slip that smooths it. Of the thread's contact
    with itself: the rows of `find_pairs`, their second derivatives, and how many there are.
    """

    trial: NDArray[np.float64]
    step: NDArray[np.float64]
    gradient: NDArray[np.float64]
    band: NDArray[np.float64]
    chol: NDArray[np.float64]
    rest: NDArray[np.float64]
    drag: NDArray[np.float64]
    turned: NDArray[np.float64]
    rows: NDArray[np.float64]
    friction: NDArray[np.float64]
    begin: NDArray[np.float64]
    slip: NDArray[np.float64]
    pairs: NDArray[np.float64]
    second: NDArray[np.float64]
    paired: NDArray[np.int64]


def make_buffers(segments: int, contacts: int) -> NewtonBuffers:
    """Return memory for a thread of n segments and for so many contacts of one point or segment."""
    size = 2 * segments + 3
    return NewtonBuffers(
        trial=np.zeros(size),
        step=np.zeros(size),
        gradient=np.zeros(size),
        band=np.zeros((size, WIDTH)),
        chol=np.zeros((size, WIDTH)),
        rest=np.zeros(size),
        drag=np.zeros((segments + 1, 3)),
        turned=np.zeros((3, 3)),
        rows=np.zeros((contacts, 5)),
        friction=np.zeros((4 * segments + 1, 5)),
        begin=np.zeros(size),
        slip=np.zeros(1),
        pairs=np.zeros((PAIRS_PER_NODE * (segments + 1), 6)),
        second=np.zeros(PAIRS_PER_NODE * (segments + 1)),
        paired=np.zeros(1, dtype=np.int64),
    )


@compiled
def assemble_energy(
    q: NDArray[np.float64],
    field: NDArray[np.float64],
    needle: Needle,
    rod: Rod,
    shapes: Shapes,
    buffers: NewtonBuffers,
    driven: bool,
    convex: bool,
) -> float:
    """Write gradient and band of what a step makes least, and return its value [J].

    Where the needle is driven, its three unknowns are known: they get no force and no coupling.
    """
    buffers.gradient[:] = 0.0
    buffers.band[:, :] = 0.0
    g, band = buffers.gradient, buffers.band
    energy = add_drag(q, buffers.rest, buffers.drag, g, band)
    energy += add_stretching(q, rod, g, band, convex) + add_bending(q, rod, g, band, convex)
    energy += add_contact(q, rod, shapes, buffers.rows, g, band, convex)
    energy += add_friction(q, buffers.begin, buffers.slip[0], buffers.friction, g, band)
    energy += add_clamp(q, needle, rod.segment, g, band, convex)
    if buffers.paired[0] > 0:
        pairs, second = buffers.pairs[: buffers.paired[0]], buffers.second[: buffers.paired[0]]
        energy += add_pairs(q, buffers.begin, buffers.slip[0], 2.0 * rod.radius, shapes.stiffness, pairs, second, g)
    if not driven:
        rest, turned, rows = buffers.rest, buffers.turned, buffers.rows
        energy += add_needle(q, field, needle, shapes, rest, turned, rows, g, band, convex)
        return energy
    for i in range(3):
        g[i] = 0.0
        band[i, :] = 0.0
        band[i, 0] = 1.0
        for j in range(3, 9):
            if j - i < band.shape[1] and j < band.shape[0]:
                band[j, j - i] = 0.0
    return energy


@compiled
def _largest(gradient: NDArray[np.float64], arm: float) -> float:
    """Return the largest force, the needle's torque as one at its tip [N]."""
    largest = abs(gradient[0]) / arm
    for i in range(1, gradient.shape[0]):
        largest = max(largest, abs(gradient[i]))
    return float(largest)


@compiled
def _shorter(part: float, slope: float, new_slope: float, rise: float) -> float:
    """Return the next part of a step to try: where the cubic through values and slopes at 0 and `part` is least.

    With slope and new_slope by the part, and rise from 0 to `part`. A new contact begins after a small part of a step,
    which the cubic finds at once.

    Source: Nocedal and Wright, Numerical Optimization, equation 3.59. Deviation: bounds.
    """
    middle = slope + new_slope - 3.0 * rise / part
    square = middle * middle - slope * new_slope
    if not square >= 0.0:
        return MAX_PART * part
    root = math.sqrt(square)
    share = 1.0 - (new_slope + root - middle) / (new_slope - slope + 2.0 * root)
    return part * min(max(share, MIN_PART), MAX_PART)


@compiled
def _minimise(
    field: NDArray[np.float64],
    needle: Needle,
    rod: Rod,
    shapes: Shapes,
    buffers: NewtonBuffers,
    driven: bool,
    tolerance: float,
) -> tuple[int, float, float]:
    """Find in `buffers.trial`, from what is there, where a step's value is least; see `advance`.

    Newton with a line search, and with the convex part of the second derivatives where they are not positive definite.
    """
    trial, step, gradient, size = buffers.trial, buffers.step, buffers.gradient, buffers.trial.shape[0]
    arm = math.sqrt(needle.tip[0] ** 2 + needle.tip[1] ** 2)
    current = trial.copy()
    energy = assemble_energy(trial, field, needle, rod, shapes, buffers, driven, False)
    move, force = np.inf, _largest(gradient, arm)
    for iteration in range(1, MAX_ITERATIONS + 1):
        buffers.chol[:, :] = buffers.band
        if not factor(buffers.chol):
            assemble_energy(current, field, needle, rod, shapes, buffers, driven, True)
            buffers.chol[:, :] = buffers.band
            if not factor(buffers.chol):
                return -1, np.inf, force
        for i in range(size):
            step[i] = -gradient[i]
        back_substitute(buffers.chol, step)
        if buffers.paired[0] > 0:
            pairs, second = buffers.pairs[: buffers.paired[0]], buffers.second[: buffers.paired[0]]
            couple(buffers.chol, pairs, second, 3 if driven else 0, step)
        slope = 0.0
        move = abs(step[0]) * arm
        for i in range(size):
            slope += gradient[i] * step[i]
            if i > 0:
                move = max(move, abs(step[i]))
        if not move < np.inf:
            return -1, move, force
        part = 1.0
        while True:
            new_slope = 0.0
            for i in range(size):
                trial[i] = current[i] + part * step[i]
            new = assemble_energy(trial, field, needle, rod, shapes, buffers, driven, False)
            force = _largest(gradient, arm)
            if move <= tolerance:
                return iteration, move, force
            if new <= energy + DESCENT * part * slope + ROUNDING * abs(energy) + MIN_ENERGY:
                break
            for i in range(size):
                new_slope += gradient[i] * step[i]
            part = _shorter(part, slope, new_slope, new - energy)
            if part < MIN_LINE_SEARCH:
                return (iteration if move <= STALLED * tolerance else -1), move, force
        current[:] = trial
        energy = new
    return (MAX_ITERATIONS if move <= STALLED * tolerance else -1), move, force


@compiled
def advance(
    q: NDArray[np.float64],
    before: NDArray[np.float64],
    dt: float,
    ratio: float,
    field: NDArray[np.float64],
    needle: Needle,
    rod: Rod,
    shapes: Shapes,
    buffers: NewtonBuffers,
    driven: bool,
    tolerance: float,
) -> tuple[int, float, float]:
    """Find the state after a step of the second backward difference formula with variable steps.

        Z(q*) (q - rest) / (beta dt) + dE/dq = 0,    w = dt / dt_before
        rest = ((1 + w)^2 q_0 - w^2 q_-1) / (1 + 2 w),    beta = (1 + w) / (1 + 2 w),    q* = q_0 + w (q_0 - q_-1)

    which is where E + (q - rest)' Z (q - rest) / (2 beta dt) is least.

    Args:
        q: state at the start, shape (N,); replaced by the state at the end. Of a driven needle its first three
            values are in `buffers.trial` [rad, m].
        before: the state one step earlier.
        dt: step [s].
        ratio: w, 0 for a first step, which is backward Euler.
        field: flux density at tail and tip at q*, shape (2, 2) [T].
        needle: the needle.
        rod: the thread.
        shapes: what can be touched.
        buffers: to work in.
        driven: whether the needle's motion is given.
        tolerance: the largest last move of a node [m]; `STALLED` times as much where the energy's rounding ends the
            search.

    Returns:
        Iterations, or -1 if it did not converge; the last move [m]; the largest force that is left [N].

    Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, section III.5. Deviation: none.
    """
    trial, size = buffers.trial, q.shape[0]
    beta = (1.0 + ratio) / (1.0 + 2.0 * ratio)
    for i in range(size):
        buffers.rest[i] = ((1.0 + ratio) ** 2 * q[i] - ratio**2 * before[i]) / (1.0 + 2.0 * ratio)
        if not driven or i > 2:
            trial[i] = q[i] + ratio * (q[i] - before[i])
    drag_matrices(trial, rod, 1.0 / (beta * dt), buffers.drag)
    turn_resistance(needle, trial[0], 1.0 / (beta * dt), buffers.turned)
    find_friction(q, rod, shapes, buffers.rows, buffers.friction)
    buffers.begin[:], buffers.slip[0] = q, SLIP_SPEED * dt
    buffers.paired[0] = find_pairs(q, rod, shapes, buffers.pairs) if shapes.self_contact else 0
    if buffers.paired[0] < 0:
        return -1, np.inf, np.inf
    done, move, force = _minimise(field, needle, rod, shapes, buffers, driven, tolerance)
    if done > 0 and shapes.self_contact and crosses_anew(q, trial):
        done = -1
    if done > 0:
        q[:] = trial
    return done, move, force
