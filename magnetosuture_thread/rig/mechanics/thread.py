"""The properties of the thread in its liquid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from magnetosuture_thread.errors import ConfigurationError


class NeedleJoint(str, Enum):
    """How the thread is tied to the needle's tail."""

    PINNED = "pinned"
    CLAMPED = "clamped"


@dataclass(frozen=True)
class ThreadProperties:
    """The thread in its liquid.

    Attributes:
        length: L [m].
        segments: n.
        bending_stiffness: EI, 0 for a chain [N m^2].
        stretching_stiffness: EA [N].
        drag_across: per length, across the thread [Pa s].
        drag_along: the same along it.
        attachment: pinned, it turns freely at the needle's tail, or clamped, it leaves against the heading.
        rest_curvature: of the thread when nothing acts, positive to the left from the tail on [1/m].
        diameter: for contact [m].

    Raises:
        ConfigurationError: a value is not finite, or out of bounds.
    """

    length: float
    segments: int
    bending_stiffness: float
    stretching_stiffness: float
    drag_across: float
    drag_along: float
    attachment: NeedleJoint
    rest_curvature: float = 0.0
    diameter: float = 0.0

    def __post_init__(self) -> None:
        """Check what was given."""
        for name in ("length", "stretching_stiffness", "drag_across", "drag_along"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise ConfigurationError(f"thread.{name}", getattr(self, name), "a positive number")
        if not self.segments >= 3:
            raise ConfigurationError("thread.segments", self.segments, "at least 3")
        if not (math.isfinite(self.bending_stiffness) and self.bending_stiffness >= 0.0):
            raise ConfigurationError("thread.bending_stiffness", self.bending_stiffness, "0 or more [N m^2]")
        if not abs(self.rest_curvature) * self.length / self.segments < 1.0:
            raise ConfigurationError("thread.rest_curvature", self.rest_curvature, "a turn of less than 1 a segment")
        if not 0.0 <= self.diameter < self.length:
            raise ConfigurationError("thread.diameter", self.diameter, "from 0 to less than the length [m]")
