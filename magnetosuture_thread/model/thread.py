"""The thread as data: materials, and one thread of a material in a medium."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum


@dataclass(frozen=True)
class Material:
    """A suture material.

    Attributes:
        name: short name, used in set-up files.
        diameter: [m]
        elastic_modulus: effective modulus in bending [Pa].
        source: where the numbers come from.
    """

    name: str
    diameter: float
    elastic_modulus: float
    source: str


_REFERENCE_SET = "as in the reference trajectories; USP size and a handbook modulus, not measured on a sample"

MATERIALS = {
    material.name: material
    for material in (
        Material("polyamide_7_0", diameter=60e-6, elastic_modulus=2.0e9, source=_REFERENCE_SET),
        Material("silk_6_0", diameter=85e-6, elastic_modulus=0.1e9, source=_REFERENCE_SET),
    )
}


class Attachment(Enum):
    """How the thread is fixed to the needle's tail."""

    PINNED = "pinned"  # turns freely, as silk through the needle's eye
    GLUED = "glued"  # leaves along the needle's axis, as the paper's polyamide


@dataclass(frozen=True)
class Thread:
    """One thread of n equal segments in a viscous medium.

    Attributes:
        material: name of its material.
        length: rest length L [m].
        segments: n; the thread has n + 1 vertices, vertex 0 at the needle's tail.
        diameter: [m]
        bending_stiffness: EI [N m^2].
        drag_across: zeta_perp, drag per length and speed across the thread [Pa s].
        drag_along: zeta_par, the same along the thread [Pa s].
        attachment: how it is fixed to the needle.
    """

    material: str
    length: float
    segments: int
    diameter: float
    bending_stiffness: float
    drag_across: float
    drag_along: float
    attachment: Attachment

    @property
    def segment_length(self) -> float:
        """Rest length of a segment, D = L / n [m]."""
        return self.length / self.segments

    @classmethod
    def of(
        cls,
        material: Material,
        *,
        length: float,
        segments: int,
        attachment: Attachment,
        viscosity: float = 1.0,
        wetted_fraction: float = 0.5,
    ) -> Thread:
        """Make a thread of a material that floats in a viscous liquid.

        Bending stiffness of a round section and slender-body drag:

            EI        = E pi d^4 / 64
            zeta_perp = f 4 pi mu / ln(2 L / d),    zeta_par = zeta_perp / 2

        Args:
            material: the material.
            length: L [m].
            segments: n.
            attachment: how it is fixed to the needle.
            viscosity: mu of the liquid [Pa s]; glycerin at room temperature is about 1.
            wetted_fraction: f, the part of the thread's surface that the liquid touches; half for a
                thread that floats.

        Source: slender-body theory, leading order in 1 / ln(2 L / d). Deviation: none; the paper has
        no physical drag, only the damping kappa.
        """
        drag_across = wetted_fraction * 4.0 * math.pi * viscosity / math.log(2.0 * length / material.diameter)
        return cls(
            material=material.name,
            length=length,
            segments=segments,
            diameter=material.diameter,
            bending_stiffness=material.elastic_modulus * math.pi * material.diameter**4 / 64.0,
            drag_across=drag_across,
            drag_along=0.5 * drag_across,
            attachment=attachment,
        )
