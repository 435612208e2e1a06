"""The bridge's model of the coils: the field of each in the dish plane, per ampere."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import ellipe, ellipkm1

Vector = NDArray[np.float64]

ON_AXIS = 1e-4  # of the radius; nearer to the axis the closed form divides two zeros


class LoopCoils:
    """Coils around the dish, each as one loop of current whose axis goes through the dish's centre.

        B_z = S / (r1 pi) [ K(k) + (a^2 - rho^2 - z^2) / r2^2 E(k) ]
        B_rho = S z / (rho r1 pi) [ -K(k) + (a^2 + rho^2 + z^2) / r2^2 E(k) ]
        r1^2 = (a + rho)^2 + z^2,    r2^2 = (a - rho)^2 + z^2,    k^2 = 1 - r2^2 / r1^2

    with the loop's radius a, z along its axis, rho from it, and the complete elliptic integrals K and E.
    The strength S is such that the field at the dish's centre is the one given, which a laboratory
    measures with a probe. A positive current gives a field there that points to the coil.

    Source: the field of a circular loop in closed form. Deviation: a winding has length and thickness;
    as one loop it is off by some per cent near the coil, less in the dish.

    Args:
        angles: direction of each coil from the dish's centre against the x axis [rad].
        distance: from the dish's centre to the middle of each coil [m].
        radius: mean radius of the windings [m].
        field: at the dish's centre [T/A].
    """

    def __init__(self, angles: Sequence[float], distance: float, radius: float, field: float) -> None:
        self.names = tuple(f"coil_{index}" for index in range(len(angles)))
        self._axes = np.column_stack([np.cos(angles), np.sin(angles)])
        self._across = np.column_stack([-self._axes[:, 1], self._axes[:, 0]])
        self._places = distance * self._axes
        self._radius = radius
        # On the axis B_z = S a^2 / (a^2 + z^2)^(3/2).
        self._strength = field * (radius**2 + distance**2) ** 1.5 / radius**2

    def per_current(self, point: Vector) -> NDArray[np.float64]:
        """Return the field at a point of shape (2,) [m] for one ampere in each coil, shape (2, m) [T/A]."""
        apart, a = point - self._places, self._radius
        z = np.einsum("kd,kd->k", apart, self._axes)
        aside = np.einsum("kd,kd->k", apart, self._across)
        rho = np.maximum(np.abs(aside), ON_AXIS * a)
        far, near = (a + rho) ** 2 + z**2, (a - rho) ** 2 + z**2
        first, second = ellipkm1(near / far), ellipe(1.0 - near / far)
        scale = self._strength / (np.pi * np.sqrt(far))
        along = scale * (first + (a**2 - rho**2 - z**2) / near * second)
        outwards = scale * z / rho * (-first + (a**2 + rho**2 + z**2) / near * second)
        # Between the axis and the nearest distance computed, the radial field grows with the distance.
        outwards *= aside / rho
        return np.asarray((along[:, None] * self._axes + outwards[:, None] * self._across).T)
