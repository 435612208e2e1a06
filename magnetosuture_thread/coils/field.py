"""Field models of the coils: the field of each in the dish plane, per ampere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.compiled import compiled
from magnetosuture_thread.settings.configuration import Configuration, quantity
from magnetosuture_thread.settings.errors import ConfigurationError

Vector = NDArray[np.float64]

MIN_FIELD_PER_CURRENT = 1e-6  # T/A; a weaker coil has no effect


@dataclass(frozen=True)
class CoilProperties(Configuration):
    """Geometry and field of one coil, whose axis passes through the dish's centre.

    The field is that at the dish's centre for one ampere; it points to the coil, or away from it where
    the number is negative, as of a coil with reversed wiring.
    """

    GROUP: ClassVar[str] = "coil"

    name: str = quantity("", "of the coil, in messages")
    angle: float = quantity(
        0.0,
        "direction of the coil from the dish's centre, against the x axis",
        unit="rad",
        minimum=-2.0 * math.pi,
        maximum=2.0 * math.pi,
    )
    distance: float = quantity(
        0.05, "from the dish's centre to the middle of the coil", unit="m", minimum=0.01, maximum=1.0
    )
    radius: float = quantity(0.025, "mean radius of the windings", unit="m", minimum=0.002, maximum=0.5)
    field_per_current: float = quantity(
        1.2e-3, "at the dish's centre, for each ampere", unit="T/A", minimum=-1.0, maximum=1.0
    )
    resistance: float = quantity(
        0.0, "with its cable, cold; 0 where it is not known", unit="ohm", minimum=0.0, maximum=1000.0
    )
    residual: float = quantity(
        0.0, "root mean square of the residual of the measured field", unit="T", minimum=0.0, maximum=1.0
    )

    def check(self) -> None:
        """Reject a coil without a name or without a field."""
        if not self.name.strip():
            raise ConfigurationError(f"{self.GROUP}.name", self.name, "a name")
        if abs(self.field_per_current) < MIN_FIELD_PER_CURRENT:
            name = f"{self.GROUP}.field_per_current"
            raise ConfigurationError(name, self.field_per_current, f"a size of at least {MIN_FIELD_PER_CURRENT:g} T/A")


def coils_around(angles: Sequence[float], distance: float, radius: float, field: float) -> tuple[CoilProperties, ...]:
    """Return coils that differ only in their angles; see `CoilProperties` for the arguments."""
    return tuple(CoilProperties(f"coil_{k}", a, distance, radius, field) for k, a in enumerate(angles))


@compiled
def _elliptic_integrals(p: float) -> tuple[float, float]:
    """Return the complete elliptic integrals K and E of the parameter 1 - p, for 0 < p <= 1.

        a_n = (a + b) / 2,    b_n = sqrt(a b),    c_n = (a - b) / 2,    a_0 = 1,  b_0^2 = p,  c_0^2 = 1 - p
        K = pi / (2 a),    E = K (1 - sum of 2^(n - 1) c_n^2)

    Source: Abramowitz and Stegun, Handbook of Mathematical Functions, section 17.6. Deviation: none.
    """
    a, b, weight, total = 1.0, math.sqrt(p), 1.0, 0.5 * (1.0 - p)
    for _ in range(40):
        a, b, c = 0.5 * (a + b), math.sqrt(a * b), 0.5 * (a - b)
        total += weight * c * c
        weight *= 2.0
        if c <= 1e-8 * a:  # the next one is its square
            break
    first = 0.5 * math.pi / a
    return first, first * (1.0 - total)


@compiled
def loop_field(along: float, aside: float, distance: float, radius: float, field: float) -> tuple[float, float]:
    """Return the field of a loop of current, along its axis and across it.

        B_z = S / (r1 pi) [ K(k) + (a^2 - rho^2 - z^2) / r2^2 E(k) ]
        B_rho = S z / (rho r1 pi) [ -K(k) + (a^2 + rho^2 + z^2) / r2^2 E(k) ]
        r1^2 = (a + rho)^2 + z^2,    r2^2 = (a - rho)^2 + z^2,    k^2 = 1 - r2^2 / r1^2

    with the loop's radius a, z along its axis, rho from it, and the complete elliptic integrals K and E.
    The strength S is such that the field at the dish's centre is the one given, which a laboratory
    measures with a probe.

    Source: the field of a circular loop in closed form. Deviation: a winding has length and thickness;
    as one loop it is off by some per cent near the coil, less in the dish.

    Args:
        along: of the point, along the axis from the dish's centre to the coil [m].
        aside: of the point, from the axis, positive to its left [m].
        distance: of the coil from the dish's centre [m].
        radius: a [m].
        field: at the dish's centre [T/A].

    Returns:
        Components in the directions of `along` and `aside` [T/A].
    """
    a, z = radius, along - distance
    rho = max(abs(aside), 1e-5 * a)  # closer to the axis the closed form is 0 / 0
    far, near = (a + rho) ** 2 + z**2, (a - rho) ** 2 + z**2
    first, second = _elliptic_integrals(near / far)
    # On the axis B_z = S a^2 / (a^2 + z^2)^(3/2).
    strength = field * (a**2 + distance**2) ** 1.5 / a**2
    scale = strength / (math.pi * math.sqrt(far))
    axial = scale * (first + (a**2 - rho**2 - z**2) / near * second)
    outwards = scale * z / rho * (-first + (a**2 + rho**2 + z**2) / near * second)
    # Between the axis and the nearest distance computed, the radial field grows with the distance.
    return axial, outwards * (aside / rho)


@compiled
def loop_fields(along: Vector, aside: Vector, distance: Vector, radius: Vector, field: Vector) -> NDArray[np.float64]:
    """Return `loop_field` for each element of arrays of shape (k,), shape (2, k)."""
    found = np.empty((2, len(along)))
    for k in range(len(along)):
        found[0, k], found[1, k] = loop_field(along[k], aside[k], distance[k], radius[k], field[k])
    return found


@compiled
def fields_per_current(
    x: float, y: float, axes: NDArray[np.float64], numbers: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the field at a point for one ampere in each coil, shape (2, m).

    Args:
        x: of the point [m].
        y: of the point [m].
        axes: unit vectors to the coils, shape (2, m).
        numbers: distance, radius and field at the dish's centre of each coil, shape (3, m).
    """
    found = np.empty(axes.shape)
    for k in range(axes.shape[1]):
        ux, uy = axes[0, k], axes[1, k]
        b, c = loop_field(ux * x + uy * y, ux * y - uy * x, numbers[0, k], numbers[1, k], numbers[2, k])
        found[0, k], found[1, k] = b * ux - c * uy, b * uy + c * ux
    return found


class LoopCoils:
    """Coils around the dish as loops of current; see `loop_field`.

    Args:
        coils: their properties.

    Attributes:
        names: of the coils, in the order of their currents.
        axes: unit vectors to them, shape (2, m).
        numbers: their distance, radius and field, see `fields_per_current`, shape (3, m).
    """

    def __init__(self, coils: Sequence[CoilProperties]) -> None:
        self.names = tuple(coil.name for coil in coils)
        angles = np.array([coil.angle for coil in coils])
        self.axes = np.array([np.cos(angles), np.sin(angles)])
        self.numbers = np.array([[coil.distance, coil.radius, coil.field_per_current] for coil in coils]).T.copy()

    def per_current(self, point: Vector) -> NDArray[np.float64]:
        """Return the field at a point of shape (2,) [m] for one ampere in each coil, shape (2, m) [T/A]."""
        return np.asarray(fields_per_current(float(point[0]), float(point[1]), self.axes, self.numbers))
