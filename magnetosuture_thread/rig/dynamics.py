"""The dish in motion: a magnetic needle that coil currents pull through glycerin, and the thread behind it.

Everything is overdamped. Needle and thread move in one implicit step: the thread's drag is greater than the
needle's, so steps in turn would not be stable. Nothing here comes from the thread model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from magnetosuture_thread.coils.field import fields_per_current
from magnetosuture_thread.geometry.compiled import compiled, compiled_inline, compiled_uncounted
from magnetosuture_thread.geometry.needle_arc import needle_axis
from magnetosuture_thread.geometry.polyline import Points, Vector, chain_along
from magnetosuture_thread.rig import rod as elastic
from magnetosuture_thread.rig.contact import Shapes, Surface, clear, point_contacts
from magnetosuture_thread.rig.rod import WIDTH, NeedleJoint, Rod, StepTerms, System, ThreadProperties
from magnetosuture_thread.settings.errors import SolverError

__all__ = ["NeedleJoint", "RigDynamics", "Surface", "ThreadProperties"]

MU_0 = 4e-7 * math.pi  # T m/A
TOLERANCE = 1e-9  # m; the last move of Newton's iteration, which then converges quadratically
STALLED = 10.0  # times the tolerance; where the energy tells no better place apart, the last move is rounding
MIN_PART = 1e-6  # of Newton's move, below which the line search ends
MAX_ITERATIONS = 60  # of Newton in a step
CONTACTS_PER_NODE = 8  # rows of contact with surfaces


class CoilField:
    """The flux density of coils of one uniform layer around the dish, in its plane.

    A coil is a sheet of current, integrated by Gauss and Legendre: loops at the nodes, and turns by the weights. With
    six of them the field is right to 1e-6 from half a radius off a coil as long as its radius.

    Args:
        angles: direction of each coil from the dish's centre, and of its field for a positive current [rad].
        distance: from the dish's centre to the middle of a coil [m].
        radius: mean radius of the winding [m].
        length: of the winding along its axis, 0 for a flat coil [m].
        turns: their number.
        loops: along the length of a coil.
        gains: by which the field of each coil differs from that, 1 each if not given.
        residual: flux density that is there without currents, shape (2,) [T].
    """

    def __init__(
        self,
        angles: Sequence[float],
        distance: float,
        radius: float,
        length: float,
        turns: float,
        loops: int = 6,
        *,
        gains: Sequence[float] = (),
        residual: ArrayLike = (0.0, 0.0),
    ) -> None:
        nodes, weights = np.polynomial.legendre.leggauss(loops if length > 0.0 else 1)
        away = distance + 0.5 * length * nodes
        field = 0.5 * weights * turns * MU_0 * radius**2 / (2.0 * (radius**2 + away**2) ** 1.5)
        direction = np.repeat(np.asarray(angles, dtype=np.float64), len(nodes))
        self._axes = np.array([np.cos(direction), np.sin(direction)])
        self._numbers = np.tile(np.array([away, np.full(len(nodes), radius), field]), len(angles))
        self._numbers[2] *= np.repeat(np.asarray(gains or np.ones(len(angles))), len(nodes))
        self._residual = np.asarray(residual, dtype=np.float64)
        self._shape = 2, len(angles), len(nodes)

    def per_current(self, point: Vector) -> Vector:
        """Return the flux density at a point of shape (2,) [m] for one ampere in each coil, shape (2, m) [T/A]."""
        loops = fields_per_current(float(point[0]), float(point[1]), self._axes, self._numbers)
        return np.asarray(loops.reshape(self._shape).sum(axis=2))

    def at(self, point: Vector, currents: Vector) -> Vector:
        """Return the flux density at a point of shape (2,) [m] under currents of shape (m,) [A], shape (2,) [T]."""
        return np.asarray(self.per_current(point) @ currents + self._residual)


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
        nodes, weights = np.polynomial.legendre.leggauss(16)
        points, tangent = needle_axis(np.zeros(2), 0.0, self.length, self.curvature, 0.5 * (nodes + 1.0))
        local = (along - across) * tangent[:, :, None] * tangent[:, None, :] + across * np.eye(2)
        jacobian = np.zeros((len(nodes), 2, 3))
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


class Bodies(NamedTuple):
    """Needle, thread, and what they can touch."""

    needle: Needle
    rod: Rod
    shapes: Shapes


@compiled_uncounted
def add_needle(q: Vector, bodies: Bodies, terms: StepTerms, system: System, convex: bool) -> float:
    """Add the needle's terms: drag, poles in the field of the step, contact of its outline.

        E = q_m B_tail . x_tail - q_m B_tip . x_tip,    x_tip = x_0 + R(theta) tip

    Args:
        q: state, its first three are heading, x and y of the tail [rad, m].
        bodies: needle, thread, and what they can touch.
        terms: of the step.
        system: added to.
        convex: whether to leave out what makes second derivatives indefinite.
    """
    needle, shapes, rest, field, k = bodies.needle, bodies.shapes, terms.rest, terms.field, bodies.shapes.stiffness
    gradient, band, rows, energy = system.gradient, system.band, system.contacts, 0.0
    for i in range(3):
        force = 0.0
        for j in range(3):
            force += terms.turned[i, j] * (q[j] - rest[j])
            if j <= i:
                band[i, i - j] += terms.turned[i, j]
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
    band[0, 0] += max(fx * tx + fy * ty, 0.0 if convex else -np.inf)
    for i in range(needle.outline.shape[0]):
        ox = c * needle.outline[i, 0] - s * needle.outline[i, 1]
        oy = s * needle.outline[i, 0] + c * needle.outline[i, 1]
        if clear(q[1] + ox, q[2] + oy, needle.radius, shapes):
            continue
        for row in range(point_contacts(0, q[1] + ox, q[2] + oy, needle.radius, shapes, rows, 0)):
            depth, nx, ny = rows[row, 2], rows[row, 3], rows[row, 4]
            bend, arm = -rows[row, 5] * depth, nx * ox + ny * oy
            along, across = (ny * ox - nx * oy, nx, ny), (arm, -ny, nx)  # ways of the point by the three unknowns
            if convex:
                bend, arm = max(bend, 0.0), max(arm, 0.0)
            energy += 0.5 * k * depth * depth
            for r in range(3):
                gradient[r] -= k * depth * along[r]
                for j in range(r + 1):
                    band[r, r - j] += k * (along[r] * along[j] + bend * across[r] * across[j])
            band[0, 0] += k * depth * arm
    return float(energy)


@compiled_uncounted
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
    along = min(ux * hx + uy * hy, 0.0 if convex else np.inf)
    gradient[0] += 2.0 * d * (uy * hx - ux * hy)
    for i, force in ((1, 2.0 * d * ux), (2, 2.0 * d * uy)):
        gradient[i] -= force
        gradient[i + 2] += force
    band[0, 0] += 2.0 * d * (hx * hx + hy * hy - along)
    for i, sign in ((1, 1.0), (3, -1.0)):  # tail, and the node behind it
        band[i, i] += sign * 2.0 * d * hy
        band[i + 1, i + 1] -= sign * 2.0 * d * hx
        band[i, 0] += 2.0 * d
        band[i + 1, 0] += 2.0 * d
    band[3, 2] -= 2.0 * d
    band[4, 2] -= 2.0 * d
    return float(d * (ux * ux + uy * uy))


class Field(Protocol):
    """The flux density of coils."""

    def at(self, point: Vector, currents: Vector) -> Vector:
        """Return that at a point of shape (2,) [m] under currents of shape (m,) [A], shape (2,) [T]."""


@compiled_uncounted
def _assemble_energy(q: Vector, bodies: Bodies, terms: StepTerms, system: System, driven: bool, convex: bool) -> float:
    """Write gradient and band of what a step makes least, and return its value [J].

    Where the needle is driven, its three unknowns are known: they get no force and no coupling.
    """
    rod, shapes = bodies.rod, bodies.shapes
    g, band, rows = system.gradient, system.band, system.contacts
    g[:] = 0.0
    band[:, :] = 0.0
    energy = elastic.add_drag(q, terms.rest, terms.drag, g, band)
    energy += elastic.add_stretching(q, rod, g, band, convex) + elastic.add_bending(q, rod, g, band)
    contacts = rows[: elastic.find_contacts(q, rod, shapes, rows)]
    energy += elastic.add_contact(q, shapes.stiffness, contacts, g, band, convex)
    energy += elastic.add_rows(q, terms, rod, shapes.stiffness, system)
    energy += add_clamp(q, bodies.needle, rod.segment, g, band, convex)
    if not driven:
        return energy + add_needle(q, bodies, terms, system, convex)
    for i in range(3):
        g[i] = 0.0
        band[i, :] = 0.0
        band[i, 0] = 1.0
        for j in range(3, min(i + WIDTH, q.shape[0])):
            band[j, j - i] = 0.0
    return energy


@compiled
def _largest(values: Vector, lever: float) -> float:
    """Return the greatest of a state's values, the first of them, which is of the heading, times a lever."""
    largest = abs(values[0]) * lever
    for value in values[1:]:
        largest = max(largest, abs(value))
    return float(largest)


@compiled_inline
def _move(start: Vector, part: float, step: Vector, moved: Vector) -> None:
    """Write the state after a part of a step; to assign an array to a slice takes seconds to compile."""
    for i in range(len(start)):
        moved[i] = start[i] + part * step[i]


@compiled
def minimise(trial: Vector, bodies: Bodies, terms: StepTerms, driven: bool) -> tuple[int, float, float]:
    """Move a state to where a step's value is least.

    Newton with a line search, and with the convex part of the second derivatives where they are not positive definite.

    Args:
        trial: state from which to begin, replaced by the state found, shape (N,) [rad, m].
        bodies: needle, thread, and what they can touch.
        terms: of the step.
        driven: whether the needle's motion is given.

    Returns:
        Iterations, or -1 if the last move is more than `TOLERANCE`, or `STALLED` times as much where the energy's
        rounding ends the search; the last move [m]; the largest force that is left, torque as one at the tip [N].
    """
    size, room = trial.shape[0], CONTACTS_PER_NODE * (trial.shape[0] // 2)
    system = System(np.empty(size), np.empty((size, WIDTH)), np.zeros(len(terms.rows)), np.empty((room, 6)))
    gradient = system.gradient
    lever = math.sqrt(bodies.needle.tip[0] ** 2 + bodies.needle.tip[1] ** 2)  # of an angle as a way of the tip
    current, move = trial.copy(), np.inf
    energy = _assemble_energy(trial, bodies, terms, system, driven, False)
    force = _largest(gradient, 1.0 / lever)
    for iteration in range(1, MAX_ITERATIONS + 1):
        chol = system.band.copy()
        if not elastic.factor(chol):
            _assemble_energy(current, bodies, terms, system, driven, True)
            chol = system.band.copy()
            if not elastic.factor(chol):
                return -1, np.inf, force
        step = -gradient
        elastic.back_substitute(chol, step)
        elastic.couple(chol, terms.rows, system.second, 3 if driven else 0, step)
        slope, move = float(np.dot(gradient, step)), _largest(step, lever)
        rounding = 1e-10 * abs(energy) + 1e-18  # J; the energy is a sum of larger terms, or moves by the tolerance
        if not max(abs(slope), move) < np.inf:
            return -1, np.inf, force
        # Between a place that is low enough and one that is not, until it is no more as steep as at the start: one that
        # stopped short of a contact would meet it again, and stop a little nearer, without end.
        low, high, part = 0.0, np.inf, 1.0
        low_energy, low_slope, high_energy, high_slope = energy, slope, energy, slope
        while True:
            _move(current, part, step, trial)
            new = _assemble_energy(trial, bodies, terms, system, driven, False)
            force = _largest(gradient, 1.0 / lever)
            if move <= TOLERANCE:
                return iteration, move, force
            new_slope = float(np.dot(gradient, step))
            if new > energy + 1e-4 * part * slope + rounding:
                high, high_energy, high_slope = part, new, new_slope
            elif new_slope < 0.9 * slope and MIN_PART < high - part < np.inf:
                low, low_energy, low_slope = part, new, new_slope
            else:
                break
            width, share = high - low, 1.0
            if width < MIN_PART:
                if low == 0.0:
                    return (iteration if move <= STALLED * TOLERANCE else -1), move, force
                part = low
                continue
            # The least of the cubic through the values and slopes at both (Nocedal and Wright, Numerical Optimization,
            # equation 3.59), bounded: a new contact begins after a small part of a step.
            middle = low_slope + high_slope - 3.0 * (high_energy - low_energy) / width
            square = middle * middle - low_slope * high_slope
            if square >= 0.0:
                root = math.sqrt(square)
                share = 1.0 - (high_slope + root - middle) / (high_slope - low_slope + 2.0 * root)
            part = low + width * min(max(share, 2e-3), 0.5)
        current, energy = trial.copy(), new
    return (MAX_ITERATIONS if move <= STALLED * TOLERANCE else -1), move, force


class RigDynamics:
    """Needle and thread over time.

    Args:
        needle: the needle.
        thread: the thread.
        surface: what can be touched.
        field: of the coils; without it the needle can only be driven.
        tail: where the needle's tail is, (x, y) [m].
        heading: of the needle at its tail [rad].
        thread_points: a polyline from the tail on, along which the thread is laid, shape (m, 2) [m].
        largest_step: of the integration [s].

    Attributes:
        time: since the start [s].
        residual: the largest force that is out of balance after the last step [N].
        iterations: of Newton in the last call.
        halvings: of steps that did not converge at first, in the last call.
    """

    def __init__(
        self,
        needle: NeedleBody,
        thread: ThreadProperties,
        surface: Surface,
        field: Field | None,
        tail: ArrayLike,
        heading: float,
        thread_points: Points,
        *,
        largest_step: float = 2e-3,
    ) -> None:
        self.field = field
        length = thread.length / thread.segments
        nodes = chain_along(np.asarray(thread_points, dtype=np.float64), thread.segments, length)
        self._q = np.concatenate([[heading], nodes.ravel()])
        self._q[1:3] = tail
        self._before, self._last_dt = self._q.copy(), 0.0
        self._largest_step = largest_step
        self._shapes = surface.packed()
        stretching, bending, reach = thread.stretching_stiffness, thread.bending_stiffness, 0.5 * thread.diameter
        self._rod = Rod(length, stretching, bending, thread.drag_across, thread.drag_along, reach + surface.skin)
        clamp = bending / length**3 if thread.attachment is NeedleJoint.CLAMPED else 0.0
        outline = needle.outline(min(int(2.0 * needle.length / needle.diameter) + 2, 48))
        radius = 0.5 * needle.diameter + surface.skin
        self._needle = Needle(needle.resistance, needle.tip, needle.pole, outline, radius, clamp)
        self._rows = np.empty((CONTACTS_PER_NODE * (thread.segments + 1), 6))
        self._pairs = np.empty((16 * (thread.segments + 1), 6))  # rows of contact of the thread with itself
        self._move, self._held = 0.0, np.zeros(0)
        self.time = self.residual = 0.0
        self.iterations = self.halvings = 0

    @property
    def tail(self) -> Vector:
        """The needle's tail, shape (2,) [m]."""
        return np.array(self._q[1:3])

    @property
    def heading(self) -> float:
        """Of the needle at its tail, unwrapped [rad]."""
        return float(self._q[0])

    @property
    def tip(self) -> Vector:
        """The needle's tip, shape (2,) [m]."""
        return np.asarray(self._q[1:3] + self._turned(self._q, self._needle.tip))

    @property
    def body(self) -> Points:
        """Points along the needle's axis, from the tail to the tip, shape (m, 2) [m]."""
        return np.array([self._q[1:3] + self._turned(self._q, point) for point in self._needle.outline])

    @property
    def thread(self) -> Points:
        """The thread's nodes, the tail first, shape (n + 1, 2) [m]."""
        return np.array(self._q[1:].reshape(-1, 2))

    @property
    def tension(self) -> Vector:
        """Tension of each segment, positive when pulled, shape (n,) [N]."""
        chords = np.linalg.norm(np.diff(self._q[1:].reshape(-1, 2), axis=0), axis=1)
        return np.asarray(self._rod.stretching * (chords / self._rod.segment - 1.0))

    @property
    def thread_pull(self) -> Vector:
        """Force of the thread on the needle, at the tail, shape (2,) [N]: of stretching, bending and the clamp."""
        rod, edges = self._rod, np.diff(self.thread[:3], axis=0)
        stretch = self.tension[0] * edges[0] / np.linalg.norm(edges[0])
        gap = edges[0] + self._turned(self._q, np.array([rod.segment, 0.0]))
        return np.asarray(
            stretch - rod.bending / rod.segment**3 * (edges[1] - edges[0]) + 2.0 * self._needle.clamp * gap
        )

    @property
    def thread_moment(self) -> float:
        """Moment of the thread upon the needle about its tail, counter-clockwise [N m]: of the clamp; 0 if pinned."""
        direction = self._turned(self._q, np.array([self._rod.segment, 0.0]))
        edge = self.thread[1] - self.thread[0]
        return float(2.0 * self._needle.clamp * (direction[1] * edge[0] - direction[0] * edge[1]))

    def set_surface(self, surface: Surface) -> None:
        """Touch other things from now on; needle and thread must be outside of them."""
        self._shapes = surface.packed()
        # The last two states may be farther apart than a step that touches something can follow.
        self._before, self._last_dt = self._q.copy(), 0.0

    def step(self, currents: ArrayLike, dt: float, max_iterations: float = math.inf) -> float:
        """Move on under coil currents, which are held; return for how long [s].

        Args:
            currents: signed, one for each coil, shape (k,) [A].
            dt: time, in which the rig takes as many steps as it needs [s].
            max_iterations: of Newton, those of steps that fail too, after which no other step begins: less than dt has
                passed then.

        Raises:
            SolverError: Newton's iteration did not converge, however small the step; the state is that of the last
                step that did.
        """
        if not np.array_equal(currents, self._held):
            # Speeds jump with currents: a formula that looks back over the jump would lag by part of a step.
            self._held, self._last_dt = np.array(currents, dtype=np.float64), 0.0
        return self._integrate(dt, self._held, None, max_iterations)

    def drive(self, tail: ArrayLike, heading: float, dt: float) -> None:
        """Move the needle at constant velocity and turn rate, and the thread with it.

        Args:
            tail: where the tail is after dt, (x, y) [m].
            heading: the same, by whichever way round is shorter [rad].
            dt: [s].

        Raises:
            SolverError: see `step`.
        """
        turned = self._q[0] + math.remainder(heading - self._q[0], 2.0 * math.pi)
        self._integrate(dt, None, np.array([turned, *np.asarray(tail)]))

    def _integrate(
        self, dt: float, currents: Vector | None, goal: Vector | None, max_iterations: float = math.inf
    ) -> float:
        """Take steps until dt is over, or the iterations are used up; a step that does not converge is halved."""
        regular = dt / max(math.ceil(dt / self._largest_step - 1e-9), 1)
        done, h, tries = 0.0, regular, 0
        self.iterations = self.halvings = 0
        begin = self._q[:3].copy()
        while (left := dt - done) > 1e-12 * dt:
            # At least one step is taken, or fails for good: nothing is tried again and again in call after call.
            if done and self.iterations + MAX_ITERATIONS * self.halvings >= max_iterations:
                return done
            if self._last_dt > 0.0:
                # A step is at most twice the one before; the formula is stable up to 1 + sqrt(2).
                h = min(h, 2.0 * self._last_dt)
            # What is left is taken whole or in two like steps, never with a sliver at the end.
            if left < 1.5 * h:
                h = left if left < 1.01 * h else 0.5 * left
            pose = None if goal is None else begin + (done + h) / dt * (goal - begin)
            if self._take(h, currents, pose):
                done, h, tries = done + h, regular, 0
                continue
            tries += 1
            if tries > 8:
                raise SolverError("rig", "no convergence", self._move, TOLERANCE)
            self.halvings += 1
            h *= 0.5
        return dt

    def _take(self, h: float, currents: Vector | None, pose: Vector | None) -> bool:
        """Take one step of the second backward difference formula; return whether it converged.

            Z(q*) (q - rest) / (beta dt) + dE/dq = 0,    w = dt / dt_before
            rest = ((1 + w)^2 q_0 - w^2 q_-1) / (1 + 2 w),    beta = (1 + w) / (1 + 2 w),    q* = q_0 + w (q_0 - q_-1)

        which is where E + (q - rest)' Z (q - rest) / (2 beta dt) is least; a first step, with w = 0, is backward Euler.

        Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, section III.5. Deviation: none.

        Args:
            h: dt [s].
            currents: of the coils [A]; None where the needle is driven.
            pose: of a driven needle at the end of the step, heading, x and y [rad, m].
        """
        w = h / self._last_dt if self._last_dt > 0.0 else 0.0
        q, before, rod, shapes, needle = self._q, self._before, self._rod, self._shapes, self._needle
        trial = q + w * (q - before)
        flux = np.zeros((2, 2))
        if currents is not None and self.field is not None:
            tip = trial[1:3] + self._turned(trial, needle.tip)
            flux = np.array([self.field.at(at, currents) for at in (trial[1:3], tip)])
        if pose is not None:
            trial[:3] = pose
        c, s = math.cos(trial[0]), math.sin(trial[0])
        turn = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        scale = (1.0 + 2.0 * w) / ((1.0 + w) * h)  # 1 / (beta dt)
        rows, crossed = np.empty((0, 6)), np.empty((0, 0), np.bool_)
        if shapes.self_contact:
            crossed = elastic.crossings(q)
            if (pairs := elastic.find_pairs(q, rod, shapes, crossed, self._pairs)) < 0:
                return False
            rows = self._pairs[:pairs]
        if shapes.friction > 0.0:
            contacts = self._rows[: elastic.find_contacts(q, rod, shapes, self._rows)]
            rows = np.vstack([rows, elastic.find_friction(contacts, shapes)])
        terms = StepTerms(
            begin=q,
            rest=((1.0 + w) ** 2 * q - w**2 * before) / (1.0 + 2.0 * w),
            drag=elastic.drag_matrices(trial, rod, scale),
            turned=scale * turn @ needle.resistance @ turn.T,
            field=flux,
            slip=2e-6 * h,  # m/s; what should stick by friction creeps, at less than this speed
            rows=rows,
        )
        iterations, self._move, residual = minimise(trial, Bodies(needle, rod, shapes), terms, currents is None)
        if iterations < 0 or (shapes.self_contact and (elastic.crossings(trial) & ~crossed).any()):
            return False
        self._before, self._q, self._last_dt = q, trial, h
        self.time, self.residual, self.iterations = self.time + h, residual, self.iterations + iterations
        return True

    @staticmethod
    def _turned(q: Vector, vector: Vector) -> Vector:
        c, s = math.cos(q[0]), math.sin(q[0])
        return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])
