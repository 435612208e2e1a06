"""The needle as a magnet in a viscous liquid: shape, poles, resistance and terms in a step; and the coils' field."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from magnetosuture_thread.coils.field import fields_per_current
from magnetosuture_thread.geometry.compiled import compiled
from magnetosuture_thread.geometry.needle_arc import needle_axis
from magnetosuture_thread.rig.mechanics.contact import Shapes, Vector, clear, point_contacts

NODES = 16  # of the integration along the body
MU_0 = 4e-7 * math.pi  # T m/A
LOOPS = 6  # of current that stand for a coil


class CoilField:
    """The flux density of coils of one uniform layer around the dish, in its plane.

    A coil is a sheet of current, integrated by Gauss and Legendre: loops at the nodes, and turns by the weights. With
    `LOOPS` of them the field is right to 1e-6 from half a radius off a coil as long as its radius.

    Args:
        angles: direction of each coil from the dish's centre, and of its field for a positive current [rad].
        distance: from the dish's centre to the middle of a coil [m].
        radius: mean radius of the winding [m].
        length: of the winding along its axis, 0 for a flat coil [m].
        turns: their number.
        loops: along the length of a coil.
    """

    def __init__(
        self, angles: Sequence[float], distance: float, radius: float, length: float, turns: float, loops: int = LOOPS
    ) -> None:
        nodes, weights = np.polynomial.legendre.leggauss(loops if length > 0.0 else 1)
        away = distance + 0.5 * length * nodes
        field = 0.5 * weights * turns * MU_0 * radius**2 / (2.0 * (radius**2 + away**2) ** 1.5)
        each = np.repeat(np.asarray(angles, dtype=np.float64), len(nodes))
        self._axes = np.array([np.cos(each), np.sin(each)])
        self._numbers = np.tile(np.array([away, np.full(len(nodes), radius), field]), len(angles))
        self._shape = 2, len(angles), len(nodes)

    def per_current(self, point: Vector) -> Vector:
        """Return the flux density at a point of shape (2,) [m] for one ampere in each coil, shape (2, m) [T/A]."""
        found = fields_per_current(float(point[0]), float(point[1]), self._axes, self._numbers)
        return np.asarray(found.reshape(self._shape).sum(axis=2))


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
    def tip(self) -> Vector:
        """The tip in the needle's frame, shape (2,) [m]."""
        return np.asarray(self.outline(2)[1])

    def outline(self, count: int) -> Vector:
        """Return equally spaced points of the body in its frame, tail first, shape (count, 2) [m]."""
        return needle_axis(np.zeros(2), 0.0, self.length, self.curvature, np.linspace(0.0, 1.0, count))[0]

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
    def resistance(self) -> Vector:
        """Resistance to (omega, v_x, v_y) of the tail in the needle's frame, shape (3, 3).

            R = integral over s of J' (along / L t t' + across / L n n') J,    J = [-y, 1, 0; x, 0, 1]

        Torque about the tail and force (f_x, f_y) that move the needle are R (omega, v_x, v_y) [N m s, N s, N s/m].
        What the ends add to the turning, turn - across L^2 / 12, is a couple beside it, so that a straight needle has
        exactly the values of `drag`.
        """
        along, across, turn = self.drag
        nodes, weights = np.polynomial.legendre.leggauss(NODES)
        points, tangent = needle_axis(np.zeros(2), 0.0, self.length, self.curvature, 0.5 * (nodes + 1.0))
        local = (along - across) * tangent[:, :, None] * tangent[:, None, :] + across * np.eye(2)
        jacobian = np.zeros((NODES, 2, 3))
        jacobian[:, 0, 1] = jacobian[:, 1, 2] = 1.0
        jacobian[:, 0, 0], jacobian[:, 1, 0] = -points[:, 1], points[:, 0]
        total = np.einsum("s,sia,sij,sjb->ab", 0.5 * weights, jacobian, local, jacobian)
        total[0, 0] += turn - across * self.length**2 / 12.0
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

    resistance: Vector
    tip: Vector
    pole: float
    outline: Vector
    radius: float
    clamp: float


@compiled
def add_needle(
    q: Vector,
    field: Vector,
    needle: Needle,
    shapes: Shapes,
    rest: Vector,
    turned: Vector,
    rows: Vector,
    gradient: Vector,
    band: Vector,
    convex: bool,
) -> float:
    """Add the needle's terms: drag, poles in a given field, contact of its outline.

        E = q_m B_tail . x_tail - q_m B_tip . x_tip,    x_tip = x_0 + R(theta) tip

    Args:
        q: state, its first three are heading, x and y of the tail [rad, m].
        field: flux density at tail and tip, shape (2, 2) [T].
        needle: the needle.
        shapes: what can be touched.
        rest: state from which the drag is counted.
        turned: resistance of a step to (theta, x, y) in the dish's frame, shape (3, 3).
        rows: to work in, shape (k, 6).
        gradient: added to.
        band: added to.
        convex: whether to leave out what makes second derivatives indefinite.
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
        if clear(q[1] + ox, q[2] + oy, needle.radius, shapes):
            continue
        for row in range(point_contacts(q[1] + ox, q[2] + oy, needle.radius, shapes, rows)):
            depth, nx, ny = rows[row, 2], rows[row, 3], rows[row, 4]
            bend = -rows[row, 5] * depth
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
def add_clamp(q: Vector, needle: Needle, segment: float, gradient: Vector, band: Vector, convex: bool) -> float:
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
