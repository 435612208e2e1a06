"""Thread, material and medium as data: a viscous liquid, or air with inertia and gravity."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Annotated

import numpy as np

from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.polyline import Vector
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.settings.configuration import bounded, checked_arguments
from magnetosuture_thread.settings.errors import ConfigurationError

LENGTH = bounded("m", 1e-4, 2.0)
SEGMENTS = bounded("", 3, 2000)
DIAMETER = bounded("m", 1e-6, 0.01)
VISCOSITY = bounded("Pa s", 1e-6, 1e4)
DRAG = bounded("Pa s", 0.0, 1e6)
MIN_ELASTIC_MODULUS = 1e5  # Pa; a tenth of the softest materials': filaments of a braid slide when it is bent
MAX_ELASTIC_MODULUS = 1e12  # Pa; of diamond, stiffer than any wire
MAX_REST_ANGLE = 0.5  # rad; of a thread at rest at a node, beyond which its segments do not resolve it


@checked_arguments("medium")
@dataclass(frozen=True)
class Medium:
    """What a thread moves in, and what it does to the thread per length.

    The force on a length ds that moves with velocity v and acceleration a is

        -(zeta_perp (I - t t') + zeta_par t t') (v - w) ds + mu (g - a) ds

    and bending is damped by a moment of EI tau times the rate of the curvature.

    Attributes:
        drag_across: zeta_perp, drag per length and speed across the thread [Pa s].
        drag_along: zeta_par, the same along the thread [Pa s].
        mass_per_length: mu [kg/m]; 0 where inertia does not matter.
        gravity: g, one value for each dimension, or none [m/s^2]; it acts on the mass alone.
        bending_damping: tau [s].
        flow: w, velocity of the medium, the same everywhere; one value for each dimension, or none [m/s].
    """

    drag_across: Annotated[float, DRAG]
    drag_along: Annotated[float, DRAG]
    mass_per_length: Annotated[float, bounded("kg/m", 0.0, 10.0)] = 0.0
    gravity: Annotated[tuple[float, ...], bounded("m/s^2", -100.0, 100.0)] = ()
    bending_damping: Annotated[float, bounded("s", 0.0, 10.0)] = 0.0
    flow: Annotated[tuple[float, ...], bounded("m/s", -1.0, 1.0)] = ()

    @classmethod
    @checked_arguments("medium")
    def liquid(
        cls,
        viscosity: Annotated[float, VISCOSITY],
        length: Annotated[float, LENGTH],
        diameter: Annotated[float, DIAMETER],
        wetted_fraction: Annotated[float, bounded("", 1e-3, 1.0)] = 0.5,
        drag_anisotropy: Annotated[float, bounded("", 1e-3, 1.0)] = 0.5,
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


@checked_arguments("material")
@dataclass(frozen=True)
class Material:
    """A suture material.

    Attributes:
        name: short name, used in setup files.
        diameter: [m]
        elastic_modulus: effective modulus in bending [Pa].
        source: where the numbers come from.
        stiffness_weight: W_stiff of the formulation `paper`, which has no stiffness in N m^2; tuned on the
            reference set, see docs/explanation/thread_model.md.
    """

    name: str
    diameter: Annotated[float, DIAMETER]
    elastic_modulus: Annotated[float, bounded("Pa", MIN_ELASTIC_MODULUS, MAX_ELASTIC_MODULUS)]
    source: str
    stiffness_weight: Annotated[float, bounded("", 0.0, 1e12)] = 1.0


_REFERENCE_SET = "as in the reference trajectories; USP size and a handbook modulus, not measured on a sample"

MATERIALS = {
    material.name: material
    for material in (
        Material("polyamide_7_0", 60e-6, 2.0e9, _REFERENCE_SET, stiffness_weight=0.01),
        Material("silk_6_0", 85e-6, 0.1e9, _REFERENCE_SET, stiffness_weight=100.0),
    )
}


class Attachment(Enum):
    """How the thread is fixed to the needle's tail."""

    PINNED = "pinned"  # turns freely, as silk through the needle's eye
    CLAMPED = "clamped"  # leaves along the needle's axis, as the paper's polyamide


@checked_arguments("thread")
@dataclass(frozen=True)
class Thread:
    """One thread of n equal segments in a medium.

    Attributes:
        material: name of its material.
        length: rest length L [m].
        segments: n; the thread has n + 1 vertices, vertex 0 at the needle's tail.
        diameter: [m]
        bending_stiffness: EI [N m^2].
        medium: what it moves in.
        attachment: how it is fixed to the needle.
        rest_curvature: the curvature that it keeps in memory and goes back to, one for all of it or one
            for each of the n - 1 inner nodes [1/m]; in the plane positive to the left, seen from the needle
            along the thread; in space, where nothing keeps the thread from turning about its own axis, its
            size.
    """

    material: str
    length: Annotated[float, LENGTH]
    segments: Annotated[int, SEGMENTS]
    diameter: Annotated[float, DIAMETER]
    bending_stiffness: Annotated[float, bounded("N m^2", 0.0, 1e3)]
    medium: Medium
    attachment: Attachment
    rest_curvature: float | tuple[float, ...] = 0.0

    def __post_init__(self) -> None:
        """Check the curvatures' number, and that something resists every motion."""
        medium = self.medium
        if not max(medium.mass_per_length, min(medium.drag_along, medium.drag_across)) > 0.0:
            expected = "drag above 0 Pa s along and across, or a mass: nothing else resists a motion"
            raise ConfigurationError("thread.medium", f"drag {medium.drag_along}, {medium.drag_across} Pa s", expected)
        if isinstance(self.rest_curvature, tuple) and len(self.rest_curvature) != self.segments - 1:
            expected = f"one number, or {self.segments - 1} of the inner nodes [1/m]"
            raise ConfigurationError("thread.rest_curvature", self.rest_curvature, expected)

    @cached_property
    def segment_length(self) -> float:
        """Rest length of a segment, D = L / n [m]."""
        return self.length / self.segments

    @property
    def rest_angles(self) -> Vector:
        """Angle by which the thread at rest turns at each inner node, D kappa_i, shape (n - 1,) [rad]."""
        return self.segment_length * np.broadcast_to(np.asarray(self.rest_curvature, dtype=float), self.segments - 1)

    @classmethod
    @checked_arguments("thread")
    def of(
        cls,
        material: Material,
        *,
        length: Annotated[float, LENGTH],
        segments: Annotated[int, SEGMENTS],
        attachment: Attachment,
        viscosity: Annotated[float, VISCOSITY] = 1.0,
        wetted_fraction: float = 0.5,
        drag_anisotropy: float = 0.5,
        rest_curvature: float | tuple[float, ...] = 0.0,
    ) -> Thread:
        """Make a thread of a material that floats in a viscous liquid.

        Bending stiffness of a round section:

            EI = E pi d^4 / 64

        Args:
            material: the material.
            length: L [m].
            segments: n.
            attachment: how it is fixed to the needle.
            viscosity: mu of the liquid [Pa s]; glycerin at room temperature is about 1.
            wetted_fraction: f, the part of the thread's surface that the liquid touches; half for a
                thread that floats.
            drag_anisotropy: zeta_par / zeta_perp.
            rest_curvature: see the attributes.

        Source: Euler-Bernoulli beam; drag as `Medium.liquid`. Deviation: the paper has no physical
        stiffness, only the weight W_stiff.
        """
        return cls(
            material=material.name,
            length=length,
            segments=segments,
            diameter=material.diameter,
            bending_stiffness=material.elastic_modulus * math.pi * material.diameter**4 / 64.0,
            medium=Medium.liquid(viscosity, length, material.diameter, wetted_fraction, drag_anisotropy),
            attachment=attachment,
            rest_curvature=rest_curvature,
        )


def check_scene(thread: Thread, scene: Scene) -> None:
    """Refuse a scene that the segments of a thread do not resolve.

    A segment could lie across a shape that is smaller, with both of its nodes outside; in a dish that is narrower
    than two segments, no chain can turn.

    Raises:
        ConfigurationError: the shape that is too small, or the dish.
    """
    radius = 0.5 * thread.segment_length
    if not scene.dish.radius > 2.0 * radius:
        expected = f"more than {4.0 * radius:g} m, two segments of thread_model"
        raise ConfigurationError("scene.dish.diameter", scene.dish.diameter, expected)
    for shape in scene.shapes:
        name, expected = f"scene.{shape.name}", f"of at least {radius:g} m, half of a segment of thread_model"
        if isinstance(shape.geometry, Disc):
            if shape.geometry.radius < radius:
                raise ConfigurationError(name, shape.geometry.radius, f"a radius {expected}")
        elif not shape.geometry.can_contain(radius):
            raise ConfigurationError(
                name, "a shape that a segment could pass through", f"one with room for a disc of a radius {expected}"
            )
