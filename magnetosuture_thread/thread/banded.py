"""The structured solver: a primal-dual method over one banded Cholesky factor.

A row's multiplier is a function of the velocities and of a proximal centre lambda_r^k,

    lambda_r(u) = w_r [lower_r - a_r' u + mu_r lambda_r^k]_+  +  w_r [upper_r - a_r' u + mu_r lambda_r^k]_-
    w_r = 1 / (c_r + mu_r),    mu_r = max(0, 1 / w_max - c_r)

and no more than the row's limit, |lambda_r(u)| <= F_r, where it has one;
so that what remains is the balance of forces, a piecewise linear equation in u alone,

    F(u) = P u + q - sum_r a_r lambda_r(u) = 0,    F'(u) = P + sum over the active rows of w_r a_r a_r'

A row is active if its multiplier is neither 0 nor at its limit.

F' is one band of half-width 3 d. Newton's method with an exact line search solves F = 0 in finitely many
steps; a change of the active rows costs one factorisation, linear in the number of nodes. A row of
compliance c_r >= 1 / w_max is exact at once; a harder one is by lambda^k <- lambda(u), which needs no new
factor and converges at a rate of about 1e-3 or better.

Far rows are in no band, but few of them are active at once. With B the band, G the gradients of the active far rows
and W their weights, each costs one substitution in the factor of B, and all together a small dense factor:

    F' = B + G W G',    F'^-1 = B^-1 - Z (W^-1 + G' Z)^-1 Z',    Z = B^-1 G

Source: the proximal method of multipliers, Rockafellar 1976, with a semismooth Newton method, as in
QPALM; M. A. Woodbury 1950. Deviation: the slacks are folded into the rows as compliances, and the chain's band is used.

The half-width 3 d of the band is a constant in the compiled code, so that the innermost loops are unrolled:
`axes` has as many entries as there are dimensions, and the length of a tuple is part of its type.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from magnetosuture_thread.geometry.compiled import compiled_inline, compiled_inner, compiled_uncounted, compiled_within
from magnetosuture_thread.geometry.polyline import Mask, Points, Table, Vector
from magnetosuture_thread.thread.program import SPAN, ChainProgram, Solution, residuals_of

Axes = tuple[int, ...]


@compiled_within
def assemble_matrix(axes: Axes, program: ChainProgram, weights: Vector, active: Mask, band: Table) -> None:
    """Write the lower band of P + sum w a a': band[j, k] is the entry of row j + k and column j."""
    d, width = len(axes), SPAN * len(axes)
    nodes = len(program.linear)
    for i in range(nodes):
        for a in range(d):
            j = i * d + a
            for k in range(width + 1):
                band[j, k] = 0.0
            for b in range(a, d):
                band[j, b - a] = program.blocks[i, b, a]
            for apart in range(1, SPAN + 1):
                band[j, apart * d] = program.couplings[apart - 1, i] if i + apart < nodes else 0.0
    for r in range(len(program.first)):
        if active[r]:
            j = program.first[r] * d
            for a in range(width):
                scaled = weights[r] * program.gradient[r, a // d, a % d]
                for b in range(a, width):
                    band[j + a, b - a] += scaled * program.gradient[r, b // d, b % d]
    for i in range(nodes):
        if program.known[i]:
            for j in range(i * d, i * d + d):
                for k in range(1, width + 1):
                    band[j, k] = 0.0
                    if j >= k:
                        band[j - k, k] = 0.0
                band[j, 0] = 1.0


@compiled_within
def factorise(axes: Axes, band: Table) -> bool:
    """Replace the band by its factors L D L', the inverse of D in the first column."""
    width = SPAN * len(axes)
    for j in range(len(band) - width):
        pivot = band[j, 0]
        if not pivot > 0.0:
            return False
        inverse = 1.0 / pivot
        for a in range(1, width + 1):
            factor = band[j, a] * inverse
            for b in range(a, width + 1):
                band[j + a, b - a] -= factor * band[j, b]
        band[j, 0] = inverse
        for a in range(1, width + 1):
            band[j, a] *= inverse
    return True


@compiled_inner
def substitute(axes: Axes, band: Table, x: Vector) -> None:
    """Solve L D L' x = x in place; x has room for half a width of zeros at its end."""
    width = SPAN * len(axes)
    count = len(band) - width
    for j in range(count):
        value = x[j]
        for a in range(1, width + 1):
            x[j + a] -= band[j, a] * value
    for j in range(count, count + width):
        x[j] = 0.0
    for j in range(count - 1, -1, -1):
        value = x[j] * band[j, 0]
        for a in range(width, 0, -1):
            value -= band[j, a] * x[j + a]
        x[j] = value


STATUS = ("solved", "iteration limit", "not positive definite", "not finite", "stalled", "solved, after a cold start")
SOLVED, LIMIT, INDEFINITE, NOT_FINITE, STALLED, RESTARTED = range(6)


class SolverBuffers(NamedTuple):
    """What the compiled solver works with; kept from step to step, so that no step pays for memory.

    Attributes:
        axes: 0 to d - 1.
        tolerance: scaled residual at which it stops.
        iterations: the most Newton steps it may take.
        band: of the matrix, shape (m d + 3 d, 3 d + 1).
        vectors: seven of them, of the unknowns and of the rows.
        active: the rows whose multipliers change with the velocities.
        far_columns: of `solve_far_rows`, shape (w, m d + 3 d).
        far_matrix: the same, shape (w, w).
        far_pull: the same, shape (w,).
    """

    axes: Axes
    tolerance: float
    iterations: int
    band: Table
    vectors: Table
    active: Mask
    far_columns: Table
    far_matrix: Table
    far_pull: Vector


class BandedSolver:
    """Solves programs of chains, in time linear in the number of nodes.

    Args:
        tolerance: scaled residual at which it stops.
        iterations: the most Newton steps it may take.
    """

    name = "banded"

    def __init__(self, tolerance: float = 1e-8, iterations: int = 60) -> None:
        empty, nothing = np.empty((0, 0)), np.empty(0)
        memory = empty, np.empty((7, 0)), np.empty(0, np.bool_), empty, empty, nothing
        self._buffers = SolverBuffers((), tolerance, iterations, *memory)

    def solve(self, program: ChainProgram, velocities: Points, multipliers: Vector) -> Solution:
        """Solve one program, started from a guess; see `Solver`."""
        nodes, dimension = program.linear.shape
        buffers = self.buffers(nodes, dimension, len(program.lower), len(program.far_nodes))
        u, found = velocities.copy(), multipliers.copy()
        status, iterations = solve(program, u, found, buffers)
        return Solution(u, found, self.name, STATUS[status], iterations, residuals_of(program, u, found))

    def buffers(self, nodes: int, dimension: int, rows: int, far: int = 0) -> SolverBuffers:
        """Return what the compiled solver needs for programs of at most so many rows, and so many far ones of them."""
        width, kept = SPAN * dimension, self._buffers
        unknowns = nodes * dimension + width
        if kept.band.shape != (unknowns, width + 1):
            kept = kept._replace(axes=(0, 1, 2)[:dimension], band=np.empty((unknowns, width + 1)))
        if kept.vectors.shape[1] < (wanted := max(unknowns, rows)):
            kept = kept._replace(vectors=np.empty((7, wanted)), active=np.empty(wanted, np.bool_))
        if len(kept.far_pull) < far or kept.far_columns.shape[1] != unknowns:
            far_memory = np.empty((far, unknowns)), np.empty((far, far)), np.empty(far)
            kept = kept._replace(far_columns=far_memory[0], far_matrix=far_memory[1], far_pull=far_memory[2])
        self._buffers = kept
        return kept


@compiled_inline
def multiplier_of(
    lower: float, upper: float, compliance: float, limit: float, image: float, weight: float, centre: float
) -> float:
    """Return lambda_r(u) for a row's image a_r' u.

    Its arguments are numbers: to hand over the program, of dozens of numbers, would take longer than all the rest.
    """
    pull = (1.0 / weight - compliance) * centre - image
    multiplier = weight * (max(lower + pull, 0.0) + min(upper + pull, 0.0))
    return float(max(min(multiplier, limit), -limit))


@compiled_inline
def is_active(limit: float, multiplier: float) -> bool:
    """Return whether a row's multiplier changes with its image."""
    return multiplier != 0.0 and abs(multiplier) < limit


@compiled_inner
def evaluate(axes: Axes, program: ChainProgram, u: Points, smooth: Vector, image: Vector) -> float:
    """Write P u + q and a_r' u of every row; return the largest term of the first."""
    d, width, nodes, chain, largest = len(axes), SPAN * len(axes), len(u), len(program.first), 1.0
    for i in range(nodes):
        for a in range(d):
            value = 0.0
            for b in range(d):
                value += program.blocks[i, a, b] * u[i, b]
            for apart in range(1, SPAN + 1):
                if i >= apart:
                    value += program.couplings[apart - 1, i - apart] * u[i - apart, a]
                if i + apart < nodes:
                    value += program.couplings[apart - 1, i] * u[i + apart, a]
            largest = max(largest, abs(value), abs(program.linear[i, a]))
            smooth[i * d + a] = 0.0 if program.known[i] else value + program.linear[i, a]
    for r in range(chain):
        first, value = program.first[r], 0.0
        for a in range(width):
            value += program.gradient[r, a // d, a % d] * u[first + a // d, a % d]
        image[r] = value
    for r in range(len(program.far_nodes)):
        value = 0.0
        for k in range(program.far_nodes.shape[1]):
            for a in range(d):
                value += program.far_gradient[r, k, a] * u[program.far_nodes[r, k], a]
        image[chain + r] = value
    return largest


@compiled_inner
def forces(
    axes: Axes, program: ChainProgram, smooth: Vector, multipliers: Vector, force: Vector
) -> tuple[float, float]:
    """Write F; return the largest residual force on a free node, and the largest constraint force."""
    d, width = len(axes), SPAN * len(axes)
    for j in range(len(smooth)):
        force[j] = smooth[j]
    for r in range(len(program.first)):
        if multipliers[r] != 0.0:
            j = program.first[r] * d
            for a in range(width):
                force[j + a] -= program.gradient[r, a // d, a % d] * multipliers[r]
    for r in range(len(program.far_nodes)):
        for k in range(program.far_nodes.shape[1]):
            for a in range(d):
                pull = program.far_gradient[r, k, a] * multipliers[len(program.first) + r]
                force[program.far_nodes[r, k] * d + a] -= pull
    worst, largest, total = 0.0, 0.0, 0.0
    for i in range(len(program.linear)):
        for j in range(i * d, i * d + d):
            if program.known[i]:
                force[j] = 0.0
            else:
                largest = max(largest, abs(smooth[j] - force[j]))
            worst = max(worst, abs(force[j]))
            total += force[j]
    return worst if math.isfinite(total) else np.inf, largest  # a largest value may pass over a NaN


@compiled_inner
def update(
    program: ChainProgram, image: Vector, centre: Vector, weights: Vector, multipliers: Vector, active: Mask
) -> tuple[int, float]:
    """Write every multiplier; return how many rows passed a kink of theirs, and how far they are from bounds.

    A row does where it begins or ceases to be active, or comes from one of its limits to the other.
    """
    lower, upper, compliance, limit = program.lower, program.upper, program.compliance, program.limit
    changes, gap = 0, 0.0
    for r in range(len(lower)):
        multiplier = multiplier_of(lower[r], upper[r], compliance[r], limit[r], image[r], weights[r], centre[r])
        now = is_active(limit[r], multiplier)
        # From one limit to the other is a kink too, though the row is active at neither.
        if now != active[r] or (not now and multiplier * multipliers[r] < 0.0):
            changes += 1
            active[r] = now
        multipliers[r] = multiplier
        hard = 1.0 / weights[r] - compliance[r]
        if hard > 0.0:
            gap = max(gap, abs(multiplier - centre[r]) * hard / max(1.0, abs(image[r])))
    return changes, gap


@compiled_within
def search(
    program: ChainProgram, before: Vector, after: Vector, centre: Vector, weights: Vector, start: float, end: float
) -> float:
    """Return where along Newton's step the balance along it is zero, at most 1.

    It is piecewise linear and increasing in the part t taken; `start` and `end` are its smooth part
    at 0 and 1. A Newton's method of its own, kept within a bracket, finds the zero exactly.
    """
    lower, upper, compliance, limit = program.lower, program.upper, program.compliance, program.limit
    low, high, part = 0.0, 1.0, 1.0
    for _ in range(50):
        value, slope = start + part * (end - start), end - start
        for r in range(len(lower)):
            change = after[r] - before[r]
            push = multiplier_of(
                lower[r], upper[r], compliance[r], limit[r], before[r] + part * change, weights[r], centre[r]
            )
            value -= push * change
            if is_active(limit[r], push):
                slope += weights[r] * change * change
        if part == 1.0 and value <= 0.0:
            return 1.0
        if value > 0.0:
            high = part
        else:
            low = part
        following = part - value / slope
        if not low < following < high:
            following = 0.5 * (low + high)
        if abs(following - part) <= 1e-12:
            return following
        part = following
    return part


@compiled_within
def solve_positive_definite(matrix: Table, x: Vector) -> bool:
    """Solve a small dense system in place by Cholesky's factor, written over the matrix; return whether there is one.

    Args:
        matrix: symmetric, shape (n, n).
        x: the right side, then the solution, shape (n,).
    """
    count = len(x)
    for p in range(count):
        for q in range(p + 1):
            total = matrix[p, q]
            for k in range(q):
                total -= matrix[p, k] * matrix[q, k]
            if q < p:
                matrix[p, q] = total / matrix[q, q]
            elif total > 0.0:
                matrix[p, p] = math.sqrt(total)
            else:
                return False
        for k in range(p):
            x[p] -= matrix[p, k] * x[k]
        x[p] /= matrix[p, p]
    for p in range(count - 1, -1, -1):
        for k in range(p + 1, count):
            x[p] -= matrix[k, p] * x[k]
        x[p] /= matrix[p, p]
    return True


@compiled_within
def solve_far_rows(program: ChainProgram, weights: Vector, buffers: SolverBuffers, step: Vector) -> bool:
    """Turn B^-1 F in `step` into F'^-1 F, with the factor of B in the band.

    Returns:
        Whether F' is positive definite.
    """
    axes, columns, matrix, pull = buffers.axes, buffers.far_columns, buffers.far_matrix, buffers.far_pull
    d, chain, count = len(axes), len(program.first), 0
    for r in range(len(program.far_nodes)):
        if not buffers.active[chain + r]:
            continue
        for j in range(columns.shape[1]):
            columns[count, j] = 0.0
        pull[count] = 0.0
        for k in range(program.far_nodes.shape[1]):
            node = program.far_nodes[r, k]
            for a in range(d):
                value = program.far_gradient[r, k, a]
                pull[count] += value * step[node * d + a]
                columns[count, node * d + a] += 0.0 if program.known[node] else value
        substitute(axes, buffers.band, columns[count])
        for q in range(count + 1):
            matrix[count, q] = 1.0 / weights[chain + r] if q == count else 0.0
            for k in range(program.far_nodes.shape[1]):
                for a in range(d):
                    value, j = program.far_gradient[r, k, a], program.far_nodes[r, k] * d + a
                    matrix[count, q] += value * columns[q, j]
        count += 1
    if not solve_positive_definite(matrix[:count, :count], pull[:count]):
        return False
    for p in range(count):
        for j in range(program.linear.size):
            step[j] -= pull[p] * columns[p, j]
    return True


@compiled_inline
def _copy(given: Vector, factor: float, count: int, written: Vector) -> None:
    """Write the first numbers times a factor; a slice of them is copied by way of an array."""
    for k in range(count):
        written[k] = factor * given[k]


@compiled_within
def begin(axes: Axes, program: ChainProgram, u: Points, multipliers: Vector, buffers: SolverBuffers) -> None:
    """Write weights, proximal centres and the rows that are active at the guess."""
    vectors, active, unknowns = buffers.vectors, buffers.active, program.linear.size
    smooth, weights, centre, image = vectors[2, :unknowns], vectors[3], vectors[4], vectors[5]
    lower, upper, compliance, limit = program.lower, program.upper, program.compliance, program.limit
    stiffness = 0.0
    for i in range(len(u)):
        for a in range(len(axes)):
            stiffness = max(stiffness, program.blocks[i, a, a])
            if program.known[i]:
                u[i, a] = 0.0
    stiffest = 1e7 * max(1.0, 1e-4 * stiffness)  # w_max by the scale of P; a lesser compliance is not exact at once
    evaluate(axes, program, u, smooth, image)
    for r in range(len(lower)):
        weights[r] = 1.0 / max(compliance[r], 1.0 / stiffest)
        centre[r] = multipliers[r]
        multipliers[r] = multiplier_of(lower[r], upper[r], compliance[r], limit[r], image[r], weights[r], centre[r])
        # The first guess: what pushed before pushes again, though it may seem to pull.
        if multipliers[r] == 0.0 and centre[r] != 0.0 and limit[r] == np.inf:
            bound = lower[r] if centre[r] > 0.0 else upper[r]
            if math.isfinite(bound):
                hard = 1.0 / weights[r] - compliance[r]
                multipliers[r] = weights[r] * (bound - image[r] + hard * centre[r])
        active[r] = is_active(limit[r], multipliers[r])


@compiled_uncounted
def solve(program: ChainProgram, u: Points, multipliers: Vector, buffers: SolverBuffers) -> tuple[int, int]:
    """Improve u and the multipliers in place; return status and iterations."""
    axes, tolerance, band = buffers.axes, buffers.tolerance, buffers.band
    vectors, active = buffers.vectors, buffers.active
    d, width, rows, unknowns = len(axes), SPAN * len(axes), len(program.lower), program.linear.size
    step, force, smooth = vectors[0, : len(band)], vectors[1, :unknowns], vectors[2, :unknowns]
    weights, centre, image, before = vectors[3], vectors[4], vectors[5], vectors[6]
    begin(axes, program, u, multipliers, buffers)
    forces(axes, program, smooth, multipliers, force)
    changes, stalled, least = 1, 0, np.inf
    for iteration in range(1, buffers.iterations + 1):
        if changes:
            assemble_matrix(axes, program, weights, active, band)
            if not factorise(axes, band):
                return INDEFINITE, iteration
        start = end = 0.0
        _copy(force, -1.0, unknowns, step)
        step[unknowns : unknowns + width] = 0.0
        substitute(axes, band, step)
        if len(program.far_nodes) > 0 and not solve_far_rows(program, weights, buffers, step):
            return INDEFINITE, iteration
        for j in range(unknowns):
            start += smooth[j] * step[j]
            u[j // d, j % d] += step[j]
        _copy(image, 1.0, rows, before)
        scale = evaluate(axes, program, u, smooth, image)
        changes, gap = update(program, image, centre, weights, multipliers, active)
        if changes and iteration > 1:
            # Newton's step overshot a kink: go back to where the balance along it is zero.
            for j in range(unknowns):
                end += smooth[j] * step[j]
            part = search(program, before, image, centre, weights, start, end)
            for j in range(unknowns):
                u[j // d, j % d] += (part - 1.0) * step[j]
            scale = evaluate(axes, program, u, smooth, image)
            _, gap = update(program, image, centre, weights, multipliers, active)
        worst, largest = forces(axes, program, smooth, multipliers, force)
        if not math.isfinite(worst):
            return NOT_FINITE, iteration
        size = max(scale, largest)
        stalled += changes == 0 and worst > max(0.5 * least, tolerance * size)
        least = min(least, worst)
        if worst <= tolerance * size and gap <= tolerance:
            return SOLVED, iteration
        # After three Newton steps without a gain rounding allows for no more; an imbalance of 1e-6 is a solution then.
        if stalled > 3:
            return SOLVED if max(worst / size, gap) <= 1e-6 else STALLED, iteration
        if worst <= tolerance * size:
            _copy(multipliers, 1.0, rows, centre)
            turned, gap = update(program, image, centre, weights, multipliers, active)
            changes += turned
            forces(axes, program, smooth, multipliers, force)
    return LIMIT, buffers.iterations
