"""The magnetic flux density of finite circular coils, exact off their axes.

Everything is linear in the currents, so only the field per ampere is computed here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ellipe, ellipk

from magnetosuture_thread.errors import ConfigurationError

MU_0 = 4e-7 * math.pi  # T m/A
SERIES_BELOW = 0.02  # of the parameter m: there the closed form would lose digits
SERIES_TERMS = 9


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
        loops = [_loops(coil, along, across) for coil in coils]
        self._starts = np.concatenate([[0], np.cumsum([len(part) for part in loops])[:-1]])
        parts = np.concatenate(loops)
        self._radius = parts[:, 0, None]
        self._radius_squared = self._radius**2
        owner = np.repeat(np.arange(len(coils)), [len(part) for part in loops])
        axes = np.array([coil.axis for coil in coils])
        self._axes = axes[owner][:, None, :]
        self._centres = np.array([coil.centre for coil in coils])[owner] + parts[:, 1, None] * axes[owner]
        self._centres = self._centres[:, None, :]
        self._strength = MU_0 * parts[:, 2, None] / (2.0 * math.pi)

    def per_current(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the flux density that one ampere in each coil makes.

            B_z   = mu_0 I / (2 pi b) (K(m) + (r^2 - rho^2 - z^2) / a^2 E(m))
            B_rho = mu_0 I z / (2 pi b rho) (-K(m) + (r^2 + rho^2 + z^2) / a^2 E(m))
            a^2 = (r - rho)^2 + z^2,    b^2 = (r + rho)^2 + z^2,    m = 1 - a^2 / b^2

        for each loop of radius r; near the axis B_rho / rho by its power series in m. On a loop itself it
        is not finite.

        Args:
            points: shape (m, 3) [m].

        Returns:
            Shape (k, m, 3) for k coils [T/A].

        Source: J. D. Jackson, Classical Electrodynamics, 3rd ed., section 5.5. Deviation: B_rho is
        factored, so that it has no division by rho.
        """
        offset = points[None, :, :] - self._centres
        z = np.einsum("lmi,lmi->lm", offset, self._axes)
        across = offset - z[:, :, None] * self._axes
        rho_squared = np.einsum("lmi,lmi->lm", across, across)
        double = 2.0 * self._radius * np.sqrt(rho_squared)
        square = z * z + rho_squared
        whole = self._radius_squared + square
        far = whole + double
        near = whole - double
        m = 2.0 * double / far
        k, e = ellipk(m), ellipe(m)
        common = self._strength / np.sqrt(far)
        axial = common * (k + (self._radius_squared - square) / near * e)
        radial = common * z * (16.0 * self._radius_squared / (far * near)) * _radial_factor(m, k, e)
        field = axial[:, :, None] * self._axes + radial[:, :, None] * across
        return np.add.reduceat(field, self._starts, axis=0)


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


def _series() -> NDArray[np.float64]:
    """Return the coefficients of ((1 - m / 2) E - (1 - m) K) / m^2 in powers of m, the highest first."""
    count = SERIES_TERMS + 2
    c = np.array([(math.comb(2 * i, i) / 4.0**i) ** 2 for i in range(count)])
    k = 0.5 * math.pi * c
    e = -k / (2.0 * np.arange(count) - 1.0)
    total = e - k
    total[1:] += k[:-1] - 0.5 * e[:-1]
    return np.asarray(total[2:][::-1])


SERIES = _series()


def _radial_factor(m: NDArray[np.float64], k: NDArray[np.float64], e: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ((1 - m / 2) E - (1 - m) K) / m^2, which is 3 pi / 32 on the axis."""
    small = m < SERIES_BELOW
    if not small.any():
        return np.asarray(((1.0 - 0.5 * m) * e - (1.0 - m) * k) / (m * m))
    safe = np.where(small, 1.0, m)
    closed = ((1.0 - 0.5 * m) * e - (1.0 - m) * k) / (safe * safe)
    return np.where(small, np.polyval(SERIES, m), closed)
