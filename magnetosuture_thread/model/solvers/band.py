"""Band matrices: assembly of a program's, its factors, and their solution.

The half-width 3 d of the band is a constant in the compiled code, so that the innermost loops are
unrolled: `axes` has as many entries as there are dimensions, and the length of a tuple is part of its type.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.model.program import SPAN, ChainProgram, Vector

Axes = tuple[int, ...]


@compiled
def assemble(
    axes: Axes, program: ChainProgram, weights: Vector, pushing: NDArray[np.bool_], band: NDArray[np.float64]
) -> None:
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
        if pushing[r]:
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


@compiled
def factorise(axes: Axes, band: NDArray[np.float64]) -> bool:
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


@compiled
def substitute(axes: Axes, band: NDArray[np.float64], x: Vector) -> None:
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
