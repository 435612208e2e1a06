"""The medium as data: a viscous liquid, or air with inertia and gravity."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Medium:
    """What a thread moves in, and what it does to the thread per length.

    The force on a length ds that moves with velocity v and acceleration a is

        -(zeta_perp (I - t t') + zeta_par t t') v ds + mu (g - a) ds

    and bending is damped by a moment of EI tau times the rate of the curvature.

    Attributes:
        drag_across: zeta_perp, drag per length and speed across the thread [Pa s].
        drag_along: zeta_par, the same along the thread [Pa s].
        mass_per_length: mu [kg/m]; 0 where inertia does not matter.
        gravity: g, one value for each dimension, or none [m/s^2]; it acts on the mass alone.
        bending_damping: tau [s].
    """

    drag_across: float
    drag_along: float
    mass_per_length: float = 0.0
    gravity: tuple[float, ...] = ()
    bending_damping: float = 0.0

    @classmethod
    def liquid(
        cls,
        viscosity: float,
        length: float,
        diameter: float,
        wetted_fraction: float = 0.5,
        drag_anisotropy: float = 0.5,
    ) -> Medium:
        """Return the drag of a slender thread that floats in a viscous liquid, without inertia.

            zeta_perp = f 4 pi mu / ln(2 L / d),    zeta_par = a zeta_perp

        Args:
            viscosity: mu [Pa s].
            length: L of the thread [m].
            diameter: d of the thread [m].
            wetted_fraction: f, the part of the thread's surface that the liquid touches.
            drag_anisotropy: a; half to leading order.

        Source: slender-body theory, leading order in 1 / ln(2 L / d). Deviation: none; the paper has no
        physical drag, only the damping kappa.
        """
        drag = wetted_fraction * 4.0 * math.pi * viscosity / math.log(2.0 * length / diameter)
        return cls(drag_across=drag, drag_along=drag_anisotropy * drag)

    @classmethod
    def air(
        cls, mass_per_length: float, gravity: tuple[float, ...], drag: float = 0.0, bending_damping: float = 0.0
    ) -> Medium:
        """Return a medium in which inertia and weight matter and the drag is small and the same all ways.

        Args:
            mass_per_length: mu [kg/m].
            gravity: g, one value for each dimension [m/s^2].
            drag: per length and speed [Pa s].
            bending_damping: tau [s].
        """
        return cls(drag, drag, mass_per_length, gravity, bending_damping)
