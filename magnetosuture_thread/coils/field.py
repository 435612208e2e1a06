"""Field models of the coils: the field of each in the dish plane, per ampere."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import ellipe, ellipkm1

from magnetosuture_thread.configuration import Configuration, quantity
from magnetosuture_thread.errors import ConfigurationError

Vector = NDArray[np.float64]

AXIS_TOLERANCE = 1e-4  # of the radius; closer to the axis the closed form is 0 / 0
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


class CoilModel(Protocol):
    """Field model of several coils.

    Attributes:
        names: of the coils, in the order of their currents.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coils, in the order of their currents."""

    def per_current(self, point: Vector) -> NDArray[np.float64]:
        """Return the field at a point of shape (2,) [m] for one ampere in each coil, shape (2, m) [T/A]."""


def loop_field(along: Vector, aside: Vector, distance: Vector, radius: Vector, field: Vector) -> tuple[Vector, Vector]:
    """Return the field of loops of current, along their axes and across them, element by element.

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
    rho = np.maximum(np.abs(aside), AXIS_TOLERANCE * a)
    far, near = (a + rho) ** 2 + z**2, (a - rho) ** 2 + z**2
    first, second = ellipkm1(near / far), ellipe(1.0 - near / far)
    # On the axis B_z = S a^2 / (a^2 + z^2)^(3/2).
    strength = field * (a**2 + distance**2) ** 1.5 / a**2
    scale = strength / (np.pi * np.sqrt(far))
    axial = scale * (first + (a**2 - rho**2 - z**2) / near * second)
    outwards = scale * z / rho * (-first + (a**2 + rho**2 + z**2) / near * second)
    # Between the axis and the nearest distance computed, the radial field grows with the distance.
    return axial, outwards * (aside / rho)


def dipole_field(
    along: Vector, aside: Vector, distance: Vector, radius: Vector, field: Vector
) -> tuple[Vector, Vector]:
    """Return the field of dipoles in the coils' middles, along their axes; see `loop_field` for the arguments.

        B = M (3 (u . r) r - |r|^2 u) / |r|^5,    M = field distance^3 / 2

    with r from the coil's middle and the axis u. The radius has no effect. Near a coil, at less than
    twice its radius, its field is weaker than a dipole's.

    Source: the field of a magnetic dipole.
    """
    z = along - distance
    square = z**2 + aside**2
    scale = 0.5 * field * distance**3 / square**2.5
    return scale * (3.0 * z**2 - square), scale * (3.0 * z * aside)


FIELD_MODELS: dict[str, Callable[[Vector, Vector, Vector, Vector, Vector], tuple[Vector, Vector]]] = {
    "loops": loop_field,
    "dipoles": dipole_field,
}


class _Coils:
    """Coils around the dish with one field model."""

    MODEL: ClassVar[str] = "loops"

    def __init__(self, coils: Sequence[CoilProperties]) -> None:
        self.names = tuple(coil.name for coil in coils)
        angles = np.array([coil.angle for coil in coils])
        self._axes = np.array([np.cos(angles), np.sin(angles)])
        self._across = np.array([-self._axes[1], self._axes[0]])
        self._frame = np.concatenate([self._axes.T, self._across.T])
        self._distance = np.array([coil.distance for coil in coils])
        self._radius = np.array([coil.radius for coil in coils])
        self._field = np.array([coil.field_per_current for coil in coils])
        self._field_model = FIELD_MODELS[self.MODEL]

    def per_current(self, point: Vector) -> NDArray[np.float64]:
        """Return the field at a point of shape (2,) [m] for one ampere in each coil, shape (2, m) [T/A]."""
        apart = self._frame @ point
        count = len(self.names)
        axial, aside = self._field_model(apart[:count], apart[count:], self._distance, self._radius, self._field)
        return np.asarray(axial * self._axes + aside * self._across)


class LoopCoils(_Coils):
    """Coils as loops of current; see `loop_field`.

    Args:
        coils: their properties.
    """


class DipoleCoils(_Coils):
    """Coils as dipoles; see `dipole_field`.

    Args:
        coils: their properties.
    """

    MODEL: ClassVar[str] = "dipoles"


def make_coils(model: str, coils: Sequence[CoilProperties]) -> CoilModel:
    """Return coils by the name of their model, loops or dipoles."""
    return DipoleCoils(coils) if model == "dipoles" else LoopCoils(coils)
