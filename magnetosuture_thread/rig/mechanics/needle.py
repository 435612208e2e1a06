"""The needle as a magnet in a viscous liquid: its shape, its poles, its resistance, and its terms in a step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.rig.mechanics.contact import Shapes, clear, point_contacts

NODES = 16  # of the integration along the body


@dataclass(frozen=True)
class NeedleBody:
    """A slender round needle, straight or an arc, magnetised along its body.

    Its frame has the origin at the tail and the x axis along the heading, the tangent at the tail. The
    thread is tied to the tail; the tip is the other end.

    Attributes:
        length: along the body [m].
        diameter: [m].
        curvature: 0 when straight, positive when it bends to the left on the way from tail to tip [1/m].
        magnetisation: along the body, from tail to tip [A/m].
        viscosity: of the liquid [Pa s].
    """

    length: float
    diameter: float
    curvature: float
    magnetisation: float
    viscosity: float

    @property
    def pole(self) -> float:
        """The pole at the tip, q = M pi d^2 / 4; the one at the tail is -q [A m]."""
        return self.magnetisation * math.pi * self.diameter**2 / 4.0

    @cached_property
    def tip(self) -> NDArray[np.float64]:
        """The tip in the needle's frame, shape (2,) [m]."""
        return np.asarray(self.points(np.array([self.length]))[0])

    def points(self, along: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points of the body in its frame.

            x = s sinc(c s),    y = c s^2 / 2 sinc(c s / 2)^2,    sinc(u) = sin(u) / u

        Args:
            along: arc lengths s from the tail, shape (m,) [m].

        Returns:
            Shape (m, 2) [m].
        """
        turn = self.curvature * along / math.pi
        return np.column_stack([along * np.sinc(turn), 0.5 * math.pi * turn * along * np.sinc(0.5 * turn) ** 2])

    def outline(self, count: int) -> NDArray[np.float64]:
        """Return equally spaced points of the body in its frame, tail first, shape (count, 2) [m]."""
        return self.points(np.linspace(0.0, self.length, count))

    @cached_property
    def drag(self) -> tuple[float, float, float]:
        """Drag of the straight needle: along [N s/m], across [N s/m], and turning about the middle [N m s].

            along  = 2 pi eta L / (ln p - 0.207 + 0.980 / p - 0.133 / p^2),    p = L / d
            across = 4 pi eta L / (ln p + 0.839 + 0.185 / p + 0.233 / p^2)
            turn   = pi eta L^3 / (3 (ln p - 0.662 + 0.917 / p - 0.050 / p^2))

        Source: Tirado and Garcia de la Torre, J. Chem. Phys. 71 (1979) 2581 and 73 (1980) 1986, for
        2 <= p <= 30. Deviation: none.
        """
        p = self.length / self.diameter
        unit = math.pi * self.viscosity * self.length
        along = 2.0 * unit / (math.log(p) - 0.207 + 0.980 / p - 0.133 / p**2)
        across = 4.0 * unit / (math.log(p) + 0.839 + 0.185 / p + 0.233 / p**2)
        turn = unit * self.length**2 / (3.0 * (math.log(p) - 0.662 + 0.917 / p - 0.050 / p**2))
        return along, across, turn

    @cached_property
    def resistance(self) -> NDArray[np.float64]:
        """Resistance to (v_x, v_y, omega) of the tail in the needle's frame, shape (3, 3).

            R = integral over s of J' (along / L t t' + across / L n n') J,    J = [1, 0, -y; 0, 1, x]

        Force (f_x, f_y) and torque about the tail that move the needle are R (v_x, v_y, omega) [N s/m, N s,
        N m s]. What the ends add to the turning, turn - across L^2 / 12, is a couple beside it, so that a
        straight needle has exactly the values of `drag`.
        """
        along, across, turn = self.drag
        nodes, weights = np.polynomial.legendre.leggauss(NODES)
        s = 0.5 * self.length * (nodes + 1.0)
        angle = self.curvature * s
        tangent = np.column_stack([np.cos(angle), np.sin(angle)])
        local = (along - across) * tangent[:, :, None] * tangent[:, None, :] + across * np.eye(2)
        jacobian = np.zeros((NODES, 2, 3))
        jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
        jacobian[:, 0, 2], jacobian[:, 1, 2] = -self.points(s)[:, 1], self.points(s)[:, 0]
        total = np.einsum("s,sia,sij,sjb->ab", 0.5 * weights, jacobian, local, jacobian)
        total[2, 2] += turn - across * self.length**2 / 12.0
        return np.asarray(total)


class Needle(NamedTuple):
    """A needle as kernels read it.

    Attributes:
        resistance: to (omega, v_x, v_y) of the tail in the needle's frame, shape (3, 3).
        tip: in the needle's frame, shape (2,) [m].
        pole: at the tip [A m].
        outline: points that touch, in the needle's frame, shape (m, 2) [m].
        radius: of these [m].
        clamp: stiffness d of a clamped thread's d |x_1 - x_0 + R (D, 0)|^2, 0 when pinned [N/m].
    """

    resistance: NDArray[np.float64]
    tip: NDArray[np.float64]
    pole: float
    outline: NDArray[np.float64]
    radius: float
    clamp: float


@compiled
def find_poles(
    q: NDArray[np.float64],
    before: NDArray[np.float64],
    ratio: float,
    tip: NDArray[np.float64],
    poles: NDArray[np.float64],
) -> None:
    """Write x and y of tail and tip after a step, as the step before goes on, shape (2, 3) [m].

    Args:
        q: state, its first three are heading, x and y of the tail [rad, m].
        before: the state one step earlier.
        ratio: of the step to the one before.
        tip: in the needle's frame, shape (2,) [m].
        poles: written.
    """
    heading = q[0] + ratio * (q[0] - before[0])
    c, s = math.cos(heading), math.sin(heading)
    poles[0, 0], poles[0, 1] = q[1] + ratio * (q[1] - before[1]), q[2] + ratio * (q[2] - before[2])
    poles[1, 0], poles[1, 1] = poles[0, 0] + c * tip[0] - s * tip[1], poles[0, 1] + s * tip[0] + c * tip[1]


@compiled
def turn_resistance(needle: Needle, heading: float, scale: float, turned: NDArray[np.float64]) -> None:
    """Write the resistance to (omega, v_x, v_y) in the dish's frame, times a factor, shape (3, 3)."""
    c, s = math.cos(heading), math.sin(heading)
    r = needle.resistance
    turned[0, 0] = scale * r[0, 0]
    turned[1, 0] = scale * (c * r[1, 0] - s * r[2, 0])
    turned[2, 0] = scale * (s * r[1, 0] + c * r[2, 0])
    turned[1, 1] = scale * (c * c * r[1, 1] - 2.0 * c * s * r[1, 2] + s * s * r[2, 2])
    turned[2, 2] = scale * (s * s * r[1, 1] + 2.0 * c * s * r[1, 2] + c * c * r[2, 2])
    turned[2, 1] = scale * (c * s * (r[1, 1] - r[2, 2]) + (c * c - s * s) * r[1, 2])
    turned[0, 1], turned[0, 2], turned[1, 2] = turned[1, 0], turned[2, 0], turned[2, 1]


@compiled
def add_needle(
    q: NDArray[np.float64],
    field: NDArray[np.float64],
    needle: Needle,
    shapes: Shapes,
    rest: NDArray[np.float64],
    turned: NDArray[np.float64],
    rows: NDArray[np.float64],
    gradient: NDArray[np.float64],
    band: NDArray[np.float64],
    convex: bool,
) -> float:
    """Add the needle's terms: drag, poles in a given field, contact of its outline.

    E = q_m B_tail . x_tail - q_m B_tip . x_tip,    x_tip = x_0 + R(theta) tip
    """
    energy = 0.0
    for i in range(3):
        force = 0.0
        for j in range(3):
            force += turned[i, j] * (q[j] - rest[j])
            if j <= i:
                band[i, i - j] += turned[i, j]
        energy += 0.5 * force * (q[i] - rest[i])
        gradient[i] += force
    c, s = math.cos(q[0]), math.sin(q[0])
    tx, ty = c * needle.tip[0] - s * needle.tip[1], s * needle.tip[0] + c * needle.tip[1]
    fx, fy = needle.pole * field[1, 0], needle.pole * field[1, 1]
    lx, ly = fx - needle.pole * field[0, 0], fy - needle.pole * field[0, 1]
    # From where the step began, so that the sum keeps its digits.
    energy -= lx * (q[1] - rest[1]) + ly * (q[2] - rest[2]) + fx * tx + fy * ty
    gradient[0] -= fy * tx - fx * ty
    gradient[1] -= lx
    gradient[2] -= ly
    band[0, 0] += max(fx * tx + fy * ty, 0.0) if convex else fx * tx + fy * ty
    k = shapes.stiffness
    for i in range(needle.outline.shape[0]):
        ox = c * needle.outline[i, 0] - s * needle.outline[i, 1]
        oy = s * needle.outline[i, 0] + c * needle.outline[i, 1]
        if clear(q[1] + ox, q[2] + oy, needle.radius, shapes.grid, shapes.clearances):
            continue
        for row in range(point_contacts(q[1] + ox, q[2] + oy, needle.radius, shapes, rows)):
            depth, nx, ny = rows[row, 0], rows[row, 1], rows[row, 2]
            bend = -rows[row, 3] * depth
            arm = nx * ox + ny * oy
            if convex:
                bend, arm = max(bend, 0.0), max(arm, 0.0)
            energy += 0.5 * k * depth * depth
            turn = ny * ox - nx * oy
            xx, xy, yy = bend + (1.0 - bend) * nx * nx, (1.0 - bend) * nx * ny, bend + (1.0 - bend) * ny * ny
            gradient[0] -= k * depth * turn
            gradient[1] -= k * depth * nx
            gradient[2] -= k * depth * ny
            band[0, 0] += k * (oy * oy * xx - 2.0 * ox * oy * xy + ox * ox * yy + depth * arm)
            band[1, 1] += k * (ox * xy - oy * xx)
            band[2, 2] += k * (ox * yy - oy * xy)
            band[1, 0] += k * xx
            band[2, 1] += k * xy
            band[2, 0] += k * yy
    return float(energy)


@compiled
def add_clamp(
    q: NDArray[np.float64],
    needle: Needle,
    segment: float,
    gradient: NDArray[np.float64],
    band: NDArray[np.float64],
    convex: bool,
) -> float:
    """Add d |x_1 - x_0 + R (D, 0)|^2, the half cell of bending at a clamped tail.

    With d = EI / D^3 that is EI D / 4 curvature^2, the curvature from a mirrored node before the tail: of second order
    in D.
    """
    d = needle.clamp
    if d == 0.0:
        return 0.0
    hx, hy = math.cos(q[0]) * segment, math.sin(q[0]) * segment
    ux, uy = q[3] - q[1] + hx, q[4] - q[2] + hy
    along = ux * hx + uy * hy
    if convex:
        along = min(along, 0.0)
    gradient[0] += 2.0 * d * (uy * hx - ux * hy)
    gradient[1] -= 2.0 * d * ux
    gradient[2] -= 2.0 * d * uy
    gradient[3] += 2.0 * d * ux
    gradient[4] += 2.0 * d * uy
    band[0, 0] += 2.0 * d * (hx * hx + hy * hy - along)
    band[1, 1] += 2.0 * d * hy
    band[2, 2] -= 2.0 * d * hx
    band[3, 3] -= 2.0 * d * hy
    band[4, 4] += 2.0 * d * hx
    for i in range(1, 5):
        band[i, 0] += 2.0 * d
    band[3, 2] -= 2.0 * d
    band[4, 2] -= 2.0 * d
    return float(d * (ux * ux + uy * uy))
