"""How a velocity of the needle's tip moves the needle: along an arc, and exactly."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.needle_arc import needle_chord

Vector = NDArray[np.float64]


@compiled
def move_pose(
    chord: tuple[float, float, float], pose: Vector, along: float, left: float, turn_rate: float, duration: float
) -> None:
    """Move a needle whose motion is constant in the frame of its body.

    Args:
        chord: its length [m], and cosine and sine of its angle against the heading.
        pose: tail [m] and heading, written, shape (4,).
        along: velocity of the chord's middle along the chord [m/s].
        left: velocity of the middle across the chord, to its left [m/s].
        turn_rate: [rad/s].
        duration: [s].
    """
    length, c0, s0 = chord
    x, y, heading_x, heading_y = pose[0], pose[1], pose[2], pose[3]
    ex, ey = c0 * heading_x - s0 * heading_y, c0 * heading_y + s0 * heading_x
    lever, half = 0.5 * length, 0.5 * turn_rate * duration
    reach = duration * (math.sin(half) / half if half != 0.0 else 1.0)
    c, s = math.cos(half), math.sin(half)
    ux, uy = c * ex - s * ey, s * ex + c * ey  # the chord's direction halfway
    middle_x = x + lever * ex + reach * (along * ux - left * uy)
    middle_y = y + lever * ey + reach * (along * uy + left * ux)
    c, s = c * c - s * s, 2.0 * c * s
    hx, hy = c * heading_x - s * heading_y, s * heading_x + c * heading_y
    size = math.hypot(hx, hy)
    hx, hy = hx / size, hy / size
    pose[0], pose[1] = middle_x - lever * (c0 * hx - s0 * hy), middle_y - lever * (c0 * hy + s0 * hx)
    pose[2], pose[3] = hx, hy


@dataclass(frozen=True)
class NeedleKinematics:
    """A needle that is driven along its chord and turned about the middle of it.

        u = v . e,    omega = (v . n - w) / (chord / 2)
        x_middle(t) = x_middle + t sinc(omega t / 2) R(omega t / 2) (u e + w n),    heading(t) = R(omega t) heading

    with the tip's velocity v when the motion begins, the unit vector e from tail to tip and n to its left, and the
    velocity w at which the whole needle drifts across its chord, if it does. The velocity is constant in the frame of
    the needle's body: currents that do not change pull and turn the needle with it. A needle of length 0 is a point,
    which goes straight.

    Attributes:
        length: of the needle along its body; 0 for a point [m].
        curvature: of its arc, positive to the left of its heading [1/m].
    """

    length: float
    curvature: float = 0.0

    @cached_property
    def _chord(self) -> tuple[float, float, float]:
        """Length of the chord [m], cosine and sine of its angle against the heading."""
        chord, turn = needle_chord(self.length, self.curvature)
        return chord, float(turn[0, 0]), float(turn[1, 0])

    @property
    def chord(self) -> float:
        """Distance from tail to tip [m]."""
        return self._chord[0]

    def chord_direction(self, heading: Vector) -> Vector:
        """Return the unit vector from tail to tip for the heading at the tail, shapes (2,)."""
        _, c, s = self._chord
        x, y = float(heading[0]), float(heading[1])
        return np.array([c * x - s * y, s * x + c * y])

    def tip(self, tail: Vector, heading: Vector) -> Vector:
        """Return where the tip is, shape (2,) [m]."""
        return np.asarray(tail + self.chord * self.chord_direction(heading))

    def body_velocity(self, heading: Vector, velocity: Vector) -> tuple[float, float]:
        """Return the components of a tip velocity along the chord and across it, to its left [m/s]."""
        e = self.chord_direction(heading)
        x, y = float(velocity[0]), float(velocity[1])
        return float(e[0]) * x + float(e[1]) * y, float(e[0]) * y - float(e[1]) * x

    def moved(
        self, tail: Vector, heading: Vector, along: float, across: float, duration: float, drift: float = 0.0
    ) -> tuple[Vector, Vector]:
        """Return tail and heading after a motion.

        Args:
            tail: shape (2,) [m].
            heading: unit vector at the tail, shape (2,).
            along: of the tip's velocity, the part along the chord [m/s].
            across: the part across it, to its left [m/s].
            duration: of the motion [s].
            drift: as much of that part is of the whole needle; the rest turns it [m/s].
        """
        pose = np.array([tail[0], tail[1], heading[0], heading[1]], np.float64)
        if self.length == 0.0:
            move_pose(self._chord, pose, float(along), float(across), 0.0, float(duration))
        else:
            turn_rate = (across - drift) / (0.5 * self.chord)
            move_pose(self._chord, pose, float(along), float(drift), float(turn_rate), float(duration))
        return pose[:2], pose[2:]
