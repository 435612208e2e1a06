"""The magnetic flux density of finite circular coils, exact off their axes.

Everything is linear in the currents, so only the field per ampere is computed here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled

MU_0 = 4e-7 * math.pi  # T m/A
MIN_MEAN = 1e-8  # of c_n: the next one is its square
MAX_MEANS = 40
LOOPS = 6  # of current that stand for a coil


@dataclass(frozen=True)
class Coil:
    """A circular coil of one uniform layer.

    Attributes:
        centre: (x, y, z) [m].
        axis: unit vector along its field at the centre for a positive current.
        radius: mean radius of the winding [m].
        length: along the axis, 0 for a flat coil [m].
        turns: their number.
    """

    centre: tuple[float, float, float]
    axis: tuple[float, float, float]
    radius: float
    length: float
    turns: float


class CoilField:
    """The field of several coils.

    A coil is a sheet of current, integrated by Gauss and Legendre: loops at the nodes, and turns by the weights. With
    `LOOPS` of them the field is right to 1e-6 from half a radius off a coil as long as its radius.

    Args:
        coils: at least one.
        loops: along the length of a coil.
    """

    def __init__(self, coils: Sequence[Coil], *, loops: int = LOOPS) -> None:
        self.coils = tuple(coils)
        rows = []
        for index, coil in enumerate(coils):
            nodes, weights = np.polynomial.legendre.leggauss(loops if coil.length > 0.0 else 1)
            for node, weight in zip(nodes, weights, strict=True):
                centre = np.array(coil.centre) + 0.5 * coil.length * node * np.array(coil.axis)
                rows.append((index, *centre, *coil.axis, coil.radius, 0.5 * weight * coil.turns))
        self._loops = np.array(rows, dtype=np.float64)

    def per_current(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the flux density that one ampere in each coil makes.

            B_z   = mu_0 I / (2 pi b) (K(m) + (r^2 - rho^2 - z^2) / a^2 E(m))
            B_rho = mu_0 I z / (2 pi b rho) (-K(m) + (r^2 + rho^2 + z^2) / a^2 E(m))
            a^2 = (r - rho)^2 + z^2,    b^2 = (r + rho)^2 + z^2,    m = 1 - a^2 / b^2

        for each loop of radius r. On a loop itself it is not finite.

        Args:
            points: shape (m, 3) [m].

        Returns:
            Shape (k, m, 3) for k coils [T/A].

        Source: J. D. Jackson, Classical Electrodynamics, 3rd ed., section 5.5. Deviation: B_rho is factored, so
        that it has no division by rho; see `_integrals`.
        """
        field = np.zeros((len(self.coils), len(points), 3))
        _add_loops(np.ascontiguousarray(points, dtype=np.float64), self._loops, field)
        return field


@compiled
def _integrals(m: float, rest: float) -> tuple[float, float, float]:
    """Return K(m), E(m) and ((1 - m / 2) E - (1 - m) K) / m^2, which is 3 pi / 32 at m = 0.

        a_n = (a + b) / 2,    b_n = sqrt(a b),    c_n = c^2 / (4 a_n),    a_0 = 1,  b_0^2 = 1 - m,  c_0^2 = m
        K = pi / 2 a,    E = K (1 - m / 2 - m^2 T),    T = sum from 1 on of 2^(n - 1) (c_n / m)^2

    Args:
        m: the parameter, from 0 to 1.
        rest: 1 - m, with digits of its own.

    Source: Abramowitz and Stegun, Handbook of Mathematical Functions, section 17.6. Deviation: c_n / m in the place
    of c_n, so that the third value, K (1 / 4 - (1 - m / 2) T), loses no digits where m is small.
    """
    a, b, weight, total, square = 1.0, math.sqrt(rest), 1.0, 0.0, 1.0
    for _ in range(MAX_MEANS):
        a, b = 0.5 * (a + b), math.sqrt(a * b)
        part = square / (4.0 * a)
        total += weight * part * part
        weight, square = 2.0 * weight, m * part * part
        if m * part < MIN_MEAN:
            break
    k = 0.5 * math.pi / a
    return k, k * (1.0 - m * (0.5 + m * total)), k * (0.25 - (1.0 - 0.5 * m) * total)


@compiled
def _add_loops(points: NDArray[np.float64], loops: NDArray[np.float64], field: NDArray[np.float64]) -> None:
    """Add the field of loops with rows of: coil's number, centre, axis, radius, turns; see `per_current`."""
    for row in range(loops.shape[0]):
        coil, cx, cy, cz, ax, ay, az, radius, turns = loops[row]
        for i in range(points.shape[0]):
            x, y, z = points[i, 0] - cx, points[i, 1] - cy, points[i, 2] - cz
            along = x * ax + y * ay + z * az
            x, y, z = x - along * ax, y - along * ay, z - along * az
            square = x * x + y * y + z * z
            rho = math.sqrt(square)
            far, near = (radius + rho) ** 2 + along * along, (radius - rho) ** 2 + along * along
            k, e, factor = _integrals(4.0 * radius * rho / far, near / far)
            common = MU_0 * turns / (2.0 * math.pi * math.sqrt(far))
            axial = common * (k + (radius * radius - square - along * along) / near * e)
            radial = common * along * 16.0 * radius * radius / (far * near) * factor
            at = field[int(coil), i]
            at[0] += axial * ax + radial * x
            at[1] += axial * ay + radial * y
            at[2] += axial * az + radial * z
