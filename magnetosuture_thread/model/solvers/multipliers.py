"""Multipliers of a program's rows as functions of the velocities, for the structured solver; compiled.

The equations are those of `banded`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled_inline, compiled_uncounted
from magnetosuture_thread.model.program import ChainProgram, Vector

MAX_LINE_SEARCHES = 50


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


@compiled_uncounted
def update(
    program: ChainProgram,
    image: Vector,
    centre: Vector,
    weights: Vector,
    multipliers: Vector,
    active: NDArray[np.bool_],
) -> tuple[int, float]:
    """Write every multiplier; return how many rows passed a kink of theirs, and how far they are from bounds.

    A row does where it begins or ceases to be active, or comes from one of its limits to the other.
    """
    lower, upper, compliance, limit = program.lower, program.upper, program.compliance, program.limit
    changes, gap = 0, 0.0
    for r in range(len(program.first)):
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


@compiled_uncounted
def search(
    program: ChainProgram, before: Vector, after: Vector, centre: Vector, weights: Vector, start: float, end: float
) -> float:
    """Return where along Newton's step the balance along it is zero, at most 1.

    It is piecewise linear and increasing in the part t taken; `start` and `end` are its smooth part
    at 0 and 1. A Newton's method of its own, kept within a bracket, finds the zero exactly.
    """
    lower, upper, compliance, limit = program.lower, program.upper, program.compliance, program.limit
    low, high, part = 0.0, 1.0, 1.0
    for _ in range(MAX_LINE_SEARCHES):
        value, slope = start + part * (end - start), end - start
        for r in range(len(program.first)):
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
