"""The structured solver for programs with rows over nodes far apart, as where the thread touches itself.

Such a row is in no band, but few of them are active at once. With G their gradients and W their weights, Newton's
matrix of the banded solver is

    F' = B + G W G',    F'^-1 = B^-1 - Z (W^-1 + G' Z)^-1 Z',    Z = B^-1 G

so each costs one substitution in the factor of the band B, and all together a small dense factor. Otherwise the method
is that of `banded`, with the same line search, and its solution is as exact.

Source: M. A. Woodbury 1950, inverting modified matrices. Deviation: none.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled, compiled_uncounted
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.program import ChainProgram, Solution, Vector, WideRows, residuals_of
from magnetosuture_thread.model.solvers.banded import (
    INDEFINITE,
    LIMIT,
    MAX_STALLS,
    MAX_WEIGHT,
    NOT_FINITE,
    ROUNDING_RESIDUAL,
    SOLVED,
    STALLED,
    STATUS,
    Axes,
    BandedSolver,
    SolverBuffers,
    assemble_matrix,
    balance,
    factorise,
    images,
    substitute,
)
from magnetosuture_thread.model.solvers.multipliers import is_active, multiplier_of, search, update


@compiled_uncounted
def _wide_images(nodes: NDArray[np.int64], gradient: NDArray[np.float64], u: Points, image: Vector) -> None:
    """Write a_r' u of the wide rows, the last ones of the image."""
    base = len(image) - len(nodes)
    for r in range(len(nodes)):
        value = 0.0
        for k in range(nodes.shape[1]):
            for a in range(u.shape[1]):
                value += gradient[r, k, a] * u[nodes[r, k], a]
        image[base + r] = value


@compiled
def _all_forces(
    axes: Axes,
    program: ChainProgram,
    nodes: NDArray[np.int64],
    gradient: NDArray[np.float64],
    smooth: Vector,
    multipliers: Vector,
    force: Vector,
) -> tuple[float, float]:
    """Write F, as `banded.forces` does, with the wide rows; return the largest of it and of the constraint forces."""
    d = len(axes)
    force[:] = smooth
    for r in range(len(program.first) - len(nodes)):
        for k in range(program.gradient.shape[1]):
            for a in range(d):
                force[(program.first[r] + k) * d + a] -= program.gradient[r, k, a] * multipliers[r]
    for r in range(len(nodes)):
        for k in range(nodes.shape[1]):
            for a in range(d):
                force[nodes[r, k] * d + a] -= gradient[r, k, a] * multipliers[len(program.first) - len(nodes) + r]
    worst, largest = 0.0, 0.0
    for i in range(len(program.known)):
        for j in range(i * d, i * d + d):
            if program.known[i]:
                force[j] = 0.0
            largest, worst = max(largest, abs(smooth[j] - force[j])), max(worst, abs(force[j]))
            if not math.isfinite(force[j]):
                return np.inf, largest
    return worst, largest


@compiled
def _newton_step(
    axes: Axes,
    program: ChainProgram,
    nodes: NDArray[np.int64],
    gradient: NDArray[np.float64],
    weights: Vector,
    active: NDArray[np.bool_],
    band: NDArray[np.float64],
    columns: NDArray[np.float64],
    step: Vector,
) -> bool:
    """Solve F' step = step in place, with the factor of B in the band; return whether F' is positive definite."""
    d, base, count = len(axes), len(program.first) - len(nodes), 0
    substitute(axes, band, step)
    chosen = np.empty(len(nodes), dtype=np.int64)
    for r in range(len(nodes)):
        if active[base + r]:
            chosen[count] = r
            columns[count] = 0.0
            for k in range(nodes.shape[1]):
                for a in range(d):
                    columns[count, nodes[r, k] * d + a] += gradient[r, k, a]
            substitute(axes, band, columns[count])
            count += 1
    matrix, right = np.zeros((count, count)), np.zeros(count)
    for p in range(count):
        r = chosen[p]
        matrix[p, p] = 1.0 / weights[base + r]
        for k in range(nodes.shape[1]):
            for a in range(d):
                value, j = gradient[r, k, a], nodes[r, k] * d + a
                right[p] += value * step[j]
                for q in range(count):
                    matrix[p, q] += value * columns[q, j]
    for p in range(count):  # Cholesky's factor, and the first substitution with it
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
            right[p] -= matrix[p, k] * right[k]
        right[p] /= matrix[p, p]
    for p in range(count - 1, -1, -1):
        for k in range(p + 1, count):
            right[p] -= matrix[k, p] * right[k]
        right[p] /= matrix[p, p]
        for j in range(len(step)):
            step[j] -= right[p] * columns[p, j]
    return True


@compiled
def solve_wide(
    axes: Axes,
    program: ChainProgram,
    nodes: NDArray[np.int64],
    gradient: NDArray[np.float64],
    u: Points,
    multipliers: Vector,
    buffers: SolverBuffers,
    columns: NDArray[np.float64],
) -> tuple[int, int]:
    """Improve u and the multipliers in place; return status and iterations, as `banded.solve` does.

    Args:
        axes: 0 to d - 1.
        program: its last rows are the wide ones, without gradients of their own.
        nodes: of the wide rows, shape (w, k).
        gradient: of the wide rows at these, shape (w, k, d).
        u: shape (m, d).
        multipliers: of all rows, shape (r + w,).
        buffers: of the banded solver, for all rows.
        columns: to work in, of the size of the banded solver's vectors of unknowns, shape (w, m d + 3 d).
    """
    tolerance, iterations, band, vectors, active = buffers
    d, rows, unknowns = len(axes), len(program.first), program.linear.size
    step, force, smooth = vectors[0, : len(band)], vectors[1, :unknowns], vectors[2, :unknowns]
    weights, centre, image, before = vectors[3, :rows], vectors[4, :rows], vectors[5, :rows], vectors[6, :rows]
    lower, upper, compliance, limit = program.lower, program.upper, program.compliance, program.limit
    stiffness = 0.0
    for i in range(len(u)):
        for a in range(d):
            stiffness = max(stiffness, program.blocks[i, a, a])
            if program.known[i]:
                u[i, a] = 0.0
    stiffest = MAX_WEIGHT * max(1.0, 1e-4 * stiffness)
    balance(axes, program, u, smooth)
    images(axes, program, u, image)
    _wide_images(nodes, gradient, u, image)
    for r in range(rows):
        weights[r] = 1.0 / max(compliance[r], 1.0 / stiffest)
        centre[r] = multipliers[r]
        multipliers[r] = multiplier_of(lower[r], upper[r], compliance[r], limit[r], image[r], weights[r], centre[r])
        active[r] = is_active(limit[r], multipliers[r])
    _all_forces(axes, program, nodes, gradient, smooth, multipliers, force)
    stalled, minimum = 0, np.inf
    for iteration in range(1, iterations + 1):
        assemble_matrix(axes, program, weights, active, band)
        if not factorise(axes, band):
            return INDEFINITE, iteration
        start = end = 0.0
        step[:unknowns], step[unknowns:] = -force, 0.0
        if not _newton_step(axes, program, nodes, gradient, weights, active, band, columns, step):
            return INDEFINITE, iteration
        for j in range(unknowns):
            start += smooth[j] * step[j]
            u[j // d, j % d] += step[j]
        before[:] = image
        scale = balance(axes, program, u, smooth)
        images(axes, program, u, image)
        _wide_images(nodes, gradient, u, image)
        changes, gap = update(program, image, centre, weights, multipliers, active)
        if changes:
            # Newton's step overshot a kink: go back to where the balance along it is zero.
            for j in range(unknowns):
                end += smooth[j] * step[j]
            part = search(program, before, image, centre, weights, start, end)
            for j in range(unknowns):
                u[j // d, j % d] += (part - 1.0) * step[j]
            scale = balance(axes, program, u, smooth)
            images(axes, program, u, image)
            _wide_images(nodes, gradient, u, image)
            _, gap = update(program, image, centre, weights, multipliers, active)
        worst, largest = _all_forces(axes, program, nodes, gradient, smooth, multipliers, force)
        if not np.isfinite(worst):
            return NOT_FINITE, iteration
        size = max(scale, largest)
        stalled += changes == 0 and worst > max(0.5 * minimum, tolerance * size)
        minimum = min(minimum, worst)
        if worst <= tolerance * size and gap <= tolerance:
            return SOLVED, iteration
        if stalled > MAX_STALLS:
            return SOLVED if max(worst / size, gap) <= ROUNDING_RESIDUAL else STALLED, iteration
        if worst <= tolerance * size:
            centre[:] = multipliers
            _, gap = update(program, image, centre, weights, multipliers, active)
            _all_forces(axes, program, nodes, gradient, smooth, multipliers, force)
    return LIMIT, iterations


class LowRankSolver:
    """Solves programs of chains with wide rows; see `BandedSolver` for the arguments."""

    name = "low_rank"

    def __init__(self, tolerance: float = 1e-8, iterations: int = 60) -> None:
        self._banded = BandedSolver(tolerance, iterations)

    def solve(
        self, program: ChainProgram, velocities: Points, multipliers: Vector, wide: WideRows | None = None
    ) -> Solution:
        """Solve one program, started from a guess; see `Solver`."""
        if wide is None:
            return self._banded.solve(program, velocities, multipliers)
        count, (nodes, dimension) = len(wide.lower), program.linear.shape
        joined = program._replace(
            first=np.concatenate([program.first, np.zeros(count, dtype=np.int64)]),
            gradient=np.concatenate([program.gradient, np.zeros((count, *program.gradient.shape[1:]))]),
            lower=np.concatenate([program.lower, wide.lower]),
            upper=np.concatenate([program.upper, np.full(count, np.inf)]),
            compliance=np.concatenate([program.compliance, wide.compliance]),
            limit=np.concatenate([program.limit, np.full(count, np.inf)]),
        )
        buffers = self._banded.buffers(nodes, dimension, len(joined.first))
        u, found, axes = velocities.copy(), multipliers.copy(), (0, 1, 2)[:dimension]
        columns = np.empty((count, len(buffers.band)))
        rows = wide.nodes, np.ascontiguousarray(wide.gradient)
        status, iterations = solve_wide(axes, joined, *rows, u, found, buffers, columns)
        return Solution(u, found, self.name, STATUS[status], iterations, residuals_of(program, u, found, wide))
