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
from magnetosuture_thread.errors import ConfigurationError

MU_0 = 4e-7 * math.pi  # T m/A
MIN_MEAN = 1e-8  # of c_n: the next one is its square
MAX_MEANS = 40


@dataclass(frozen=True)
class Coil:
    """A circular coil of uniform winding.

    Attributes:
        centre: (x, y, z) [m].
        axis: the direction of its field at the centre for a positive current; made a unit vector.
        radius: mean radius of the winding [m].
        length: along the axis, 0 for a flat coil [m].
        turns: their number.
        thickness: of the winding along the radius, 0 for a single layer [m].

    Raises:
        ConfigurationError: a value is not finite, or out of bounds.
    """

    centre: tuple[float, float, float]
    axis: tuple[float, float, float]
    radius: float
    length: float
    turns: float
    thickness: float = 0.0

    def __post_init__(self) -> None:
        """Check what was given."""
        for name in ("centre", "axis"):
            given = getattr(self, name)
            if len(given) != 3 or not all(math.isfinite(value) for value in given):
                raise ConfigurationError(f"coil.{name}", given, "three finite numbers")
        size = math.hypot(*self.axis)
        if size == 0.0:
            raise ConfigurationError("coil.axis", self.axis, "a direction")
        x, y, z = self.axis
        object.__setattr__(self, "axis", (x / size, y / size, z / size))
        for name in ("radius", "turns"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise ConfigurationError(f"coil.{name}", getattr(self, name), "a positive number")
        if not (math.isfinite(self.length) and self.length >= 0.0):
            raise ConfigurationError("coil.length", self.length, "0 or more [m]")
        if not 0.0 <= self.thickness < 2.0 * self.radius:
            raise ConfigurationError("coil.thickness", self.thickness, "from 0 to less than the diameter [m]")


class CoilField:
    """The field of several coils.

    A coil is a sheet or block of current, integrated by Gauss and Legendre: loops at the nodes, and turns
    by the weights. With the numbers below the field is right to 1e-6 from half a radius off a coil as long
    as its radius.

    Args:
        coils: at least one.
        along: loops along the length of a coil.
        across: loops across its thickness.
    """

    def __init__(self, coils: Sequence[Coil], *, along: int = 6, across: int = 3) -> None:
        if not coils:
            raise ConfigurationError("coils", "none", "at least one coil")
        self.coils = tuple(coils)
        rows = [
            (index, *(np.array(coil.centre) + place * np.array(coil.axis)), *coil.axis, radius, turns)
            for index, coil in enumerate(coils)
            for radius, place, turns in _loops(coil, along, across)
        ]
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


def _loops(coil: Coil, along: int, across: int) -> NDArray[np.float64]:
    """Return radius, place along the axis and turns of the loops that stand for a coil, shape (l, 3)."""
    places, shares = _gauss(along if coil.length > 0.0 else 1)
    radii, parts = _gauss(across if coil.thickness > 0.0 else 1)
    return np.array(
        [
            (coil.radius + 0.5 * coil.thickness * r, 0.5 * coil.length * z, coil.turns * wr * wz)
            for z, wz in zip(places, shares, strict=True)
            for r, wr in zip(radii, parts, strict=True)
        ]
    )


def _gauss(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return nodes on [-1, 1], and weights that add up to one."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return nodes, 0.5 * weights


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
