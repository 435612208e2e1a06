"""The dish in motion: a magnetic needle that coil currents pull through glycerin, and the thread behind it.

Everything is overdamped. Needle and thread move in one implicit step: the thread's drag is greater than the
needle's, so steps in turn would not be stable.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.errors import SolverError
from magnetosuture_thread.geometry.polyline import Points, chain_along
from magnetosuture_thread.rig.mechanics.contact import Shapes, Surface
from magnetosuture_thread.rig.mechanics.field import CoilField
from magnetosuture_thread.rig.mechanics.needle import (
    Needle,
    NeedleBody,
    add_clamp,
    add_needle,
    find_poles,
    turn_resistance,
)
from magnetosuture_thread.rig.mechanics.rod import (
    SLIP_SPEED,
    WIDTH,
    NeedleJoint,
    Rod,
    ThreadProperties,
    add_bending,
    add_contact,
    add_drag,
    add_friction,
    add_stretching,
    back_substitute,
    drag_matrices,
    factor,
    find_friction,
)
from magnetosuture_thread.rig.mechanics.self_contact import add_pairs, couple, crosses_anew, find_pairs

__all__ = ["NeedleJoint", "RigDynamics", "Surface", "ThreadProperties"]

MAX_STEP = 2e-3  # s
TOLERANCE = 1e-9  # m; the last move of Newton's iteration, which then converges quadratically
MAX_HALVINGS = 8
MAX_GROWTH = 2.0  # of a step; the formula is stable up to 1 + sqrt(2)
MAX_CONTACTS = 48  # points of the needle's outline
MAX_ITERATIONS = 60  # of Newton in a step
PAIRS_PER_NODE = 16  # rows of contact with itself
MIN_LINE_SEARCH = 1e-6
MIN_PART, MAX_PART = 2e-3, 0.5  # of a trial of the line search, for the next one
DESCENT = 1e-4  # of the decrease that the slope promises
ROUNDING = 1e-10  # of the energy, which is a sum of larger terms
MIN_ENERGY = 1e-18  # J; of a thread that moves by the tolerance
STALLED = 10.0  # times the tolerance; where the energy tells no better place apart, the last move is rounding


class Bodies(NamedTuple):
    """Needle, thread, and what they can touch."""

    needle: Needle
    rod: Rod
    shapes: Shapes


class NewtonBuffers(NamedTuple):
    """What a step works in, N = 2n + 3 unknowns.

    Trial state, step, right side, bands, drag, contact rows.

    Of friction: what rubs, the state that slip is measured from, and the slip that smooths it. Of the thread's contact
    with itself: the rows of `find_pairs`, their second derivatives, and how many there are.
    """

    trial: NDArray[np.float64]
    step: NDArray[np.float64]
    gradient: NDArray[np.float64]
    band: NDArray[np.float64]
    chol: NDArray[np.float64]
    rest: NDArray[np.float64]
    drag: NDArray[np.float64]
    turned: NDArray[np.float64]
    rows: NDArray[np.float64]
    friction: NDArray[np.float64]
    begin: NDArray[np.float64]
    slip: NDArray[np.float64]
    pairs: NDArray[np.float64]
    second: NDArray[np.float64]
    paired: NDArray[np.int64]


def make_buffers(segments: int, contacts: int) -> NewtonBuffers:
    """Return memory for a thread of n segments and for so many contacts of one point or segment."""
    size = 2 * segments + 3
    return NewtonBuffers(
        trial=np.zeros(size),
        step=np.zeros(size),
        gradient=np.zeros(size),
        band=np.zeros((size, WIDTH)),
        chol=np.zeros((size, WIDTH)),
        rest=np.zeros(size),
        drag=np.zeros((segments + 1, 3)),
        turned=np.zeros((3, 3)),
        rows=np.zeros((contacts, 5)),
        friction=np.zeros((4 * segments + 1, 5)),
        begin=np.zeros(size),
        slip=np.zeros(1),
        pairs=np.zeros((PAIRS_PER_NODE * (segments + 1), 6)),
        second=np.zeros(PAIRS_PER_NODE * (segments + 1)),
        paired=np.zeros(1, dtype=np.int64),
    )


@compiled
def _assemble_energy(
    q: NDArray[np.float64],
    field: NDArray[np.float64],
    bodies: Bodies,
    buffers: NewtonBuffers,
    driven: bool,
    convex: bool,
) -> float:
    """Write gradient and band of what a step makes least, and return its value [J].

    Where the needle is driven, its three unknowns are known: they get no force and no coupling.
    """
    needle, rod, shapes = bodies.needle, bodies.rod, bodies.shapes
    buffers.gradient[:] = 0.0
    buffers.band[:, :] = 0.0
    g, band = buffers.gradient, buffers.band
    energy = add_drag(q, buffers.rest, buffers.drag, g, band)
    energy += add_stretching(q, rod, g, band, convex) + add_bending(q, rod, g, band)
    energy += add_contact(q, rod, shapes, buffers.rows, g, band, convex)
    energy += add_friction(q, buffers.begin, buffers.slip[0], buffers.friction, g, band)
    energy += add_clamp(q, needle, rod.segment, g, band, convex)
    if buffers.paired[0] > 0:
        pairs, second = buffers.pairs[: buffers.paired[0]], buffers.second[: buffers.paired[0]]
        energy += add_pairs(q, buffers.begin, buffers.slip[0], 2.0 * rod.radius, shapes.stiffness, pairs, second, g)
    if not driven:
        rest, turned, rows = buffers.rest, buffers.turned, buffers.rows
        energy += add_needle(q, field, needle, shapes, rest, turned, rows, g, band, convex)
        return energy
    for i in range(3):
        g[i] = 0.0
        band[i, :] = 0.0
        band[i, 0] = 1.0
        for j in range(3, 9):
            if j - i < band.shape[1] and j < band.shape[0]:
                band[j, j - i] = 0.0
    return energy


@compiled
def _largest(gradient: NDArray[np.float64], arm: float) -> float:
    """Return the largest force, the needle's torque as one at its tip [N]."""
    largest = abs(gradient[0]) / arm
    for i in range(1, gradient.shape[0]):
        largest = max(largest, abs(gradient[i]))
    return float(largest)


@compiled
def _shorter(part: float, slope: float, new_slope: float, rise: float) -> float:
    """Return the next part of a step to try: where the cubic through values and slopes at 0 and `part` is least.

    With slope and new_slope by the part, and rise from 0 to `part`. A new contact begins after a small part of a step,
    which the cubic finds at once.

    Source: Nocedal and Wright, Numerical Optimization, equation 3.59. Deviation: bounds.
    """
    middle = slope + new_slope - 3.0 * rise / part
    square = middle * middle - slope * new_slope
    if not square >= 0.0:
        return MAX_PART * part
    root = math.sqrt(square)
    share = 1.0 - (new_slope + root - middle) / (new_slope - slope + 2.0 * root)
    return part * min(max(share, MIN_PART), MAX_PART)


@compiled
def _minimise(
    field: NDArray[np.float64],
    bodies: Bodies,
    buffers: NewtonBuffers,
    driven: bool,
) -> tuple[int, float, float]:
    """Find in `buffers.trial`, from what is there, where a step's value is least; see `advance`.

    Newton with a line search, and with the convex part of the second derivatives where they are not positive definite.
    """
    trial, step, gradient, size = buffers.trial, buffers.step, buffers.gradient, buffers.trial.shape[0]
    arm = math.sqrt(bodies.needle.tip[0] ** 2 + bodies.needle.tip[1] ** 2)
    current = trial.copy()
    energy = _assemble_energy(trial, field, bodies, buffers, driven, False)
    move, force = np.inf, _largest(gradient, arm)
    for iteration in range(1, MAX_ITERATIONS + 1):
        buffers.chol[:, :] = buffers.band
        if not factor(buffers.chol):
            _assemble_energy(current, field, bodies, buffers, driven, True)
            buffers.chol[:, :] = buffers.band
            if not factor(buffers.chol):
                return -1, np.inf, force
        for i in range(size):
            step[i] = -gradient[i]
        back_substitute(buffers.chol, step)
        if buffers.paired[0] > 0:
            pairs, second = buffers.pairs[: buffers.paired[0]], buffers.second[: buffers.paired[0]]
            couple(buffers.chol, pairs, second, 3 if driven else 0, step)
        slope = 0.0
        move = abs(step[0]) * arm
        for i in range(size):
            slope += gradient[i] * step[i]
            if i > 0:
                move = max(move, abs(step[i]))
        if not move < np.inf:
            return -1, move, force
        part = 1.0
        while True:
            new_slope = 0.0
            for i in range(size):
                trial[i] = current[i] + part * step[i]
            new = _assemble_energy(trial, field, bodies, buffers, driven, False)
            force = _largest(gradient, arm)
            if move <= TOLERANCE:
                return iteration, move, force
            if new <= energy + DESCENT * part * slope + ROUNDING * abs(energy) + MIN_ENERGY:
                break
            for i in range(size):
                new_slope += gradient[i] * step[i]
            part = _shorter(part, slope, new_slope, new - energy)
            if part < MIN_LINE_SEARCH:
                return (iteration if move <= STALLED * TOLERANCE else -1), move, force
        current[:] = trial
        energy = new
    return (MAX_ITERATIONS if move <= STALLED * TOLERANCE else -1), move, force


@compiled
def advance(
    q: NDArray[np.float64],
    before: NDArray[np.float64],
    dt: float,
    ratio: float,
    field: NDArray[np.float64],
    bodies: Bodies,
    buffers: NewtonBuffers,
    driven: bool,
) -> tuple[int, float, float]:
    """Find the state after a step of the second backward difference formula with variable steps.

        Z(q*) (q - rest) / (beta dt) + dE/dq = 0,    w = dt / dt_before
        rest = ((1 + w)^2 q_0 - w^2 q_-1) / (1 + 2 w),    beta = (1 + w) / (1 + 2 w),    q* = q_0 + w (q_0 - q_-1)

    which is where E + (q - rest)' Z (q - rest) / (2 beta dt) is least.

    Args:
        q: state at the start, shape (N,); replaced by the state at the end. Of a driven needle its first three
            values are in `buffers.trial` [rad, m].
        before: the state one step earlier.
        dt: step [s].
        ratio: w, 0 for a first step, which is backward Euler.
        field: flux density at tail and tip at q*, shape (2, 2) [T].
        bodies: needle, thread, and what they can touch.
        buffers: to work in.
        driven: whether the needle's motion is given.

    Returns:
        Iterations, or -1 if the last move is more than `TOLERANCE`, or `STALLED` times as much where the energy's
        rounding ends the search; the last move [m]; the largest force that is left [N].

    Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, section III.5. Deviation: none.
    """
    trial, size = buffers.trial, q.shape[0]
    needle, rod, shapes = bodies.needle, bodies.rod, bodies.shapes
    beta = (1.0 + ratio) / (1.0 + 2.0 * ratio)
    for i in range(size):
        buffers.rest[i] = ((1.0 + ratio) ** 2 * q[i] - ratio**2 * before[i]) / (1.0 + 2.0 * ratio)
        if not driven or i > 2:
            trial[i] = q[i] + ratio * (q[i] - before[i])
    drag_matrices(trial, rod, 1.0 / (beta * dt), buffers.drag)
    turn_resistance(needle, trial[0], 1.0 / (beta * dt), buffers.turned)
    find_friction(q, rod, shapes, buffers.rows, buffers.friction)
    buffers.begin[:], buffers.slip[0] = q, SLIP_SPEED * dt
    buffers.paired[0] = find_pairs(q, rod, shapes, buffers.pairs) if shapes.self_contact else 0
    if buffers.paired[0] < 0:
        return -1, np.inf, np.inf
    done, move, force = _minimise(field, bodies, buffers, driven)
    if done > 0 and shapes.self_contact and crosses_anew(q, trial):
        done = -1
    if done > 0:
        q[:] = trial
    return done, move, force


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
        field: CoilField | None,
        tail: ArrayLike,
        heading: float,
        thread_points: Points,
        *,
        largest_step: float = MAX_STEP,
    ) -> None:
        self.needle, self.properties, self.field = needle, thread, field
        length = thread.length / thread.segments
        nodes = chain_along(np.asarray(thread_points, dtype=np.float64), thread.segments, length)
        self._q = np.concatenate([[heading], nodes.ravel()])
        self._q[1:3] = tail
        self._before, self._last_dt = self._q.copy(), 0.0
        self._largest_step = largest_step
        self._shapes = surface.packed()
        self._rod = Rod(
            length,
            thread.stretching_stiffness,
            thread.bending_stiffness,
            thread.drag_across,
            thread.drag_along,
            0.5 * thread.diameter + surface.skin,
        )
        clamp = thread.bending_stiffness / length**3 if thread.attachment is NeedleJoint.CLAMPED else 0.0
        touching = min(int(2.0 * needle.length / needle.diameter) + 2, MAX_CONTACTS)
        self._needle = Needle(
            np.ascontiguousarray(needle.resistance[np.ix_([2, 0, 1], [2, 0, 1])]),
            needle.tip,
            needle.pole,
            needle.outline(touching),
            0.5 * needle.diameter + surface.skin,
            clamp,
        )
        self._buffers = make_buffers(thread.segments, _contacts(self._shapes))
        self._poles, self._flux = np.zeros((2, 3)), np.zeros((2, 2))  # tail and tip, and the field there [T]
        self._move, self._held = 0.0, np.zeros(0)
        self.time = self.residual = 0.0
        self.iterations = self.halvings = 0

    @property
    def tail(self) -> NDArray[np.float64]:
        """The needle's tail, shape (2,) [m]."""
        return np.array(self._q[1:3])

    @property
    def heading(self) -> float:
        """Of the needle at its tail, unwrapped [rad]."""
        return float(self._q[0])

    @property
    def tip(self) -> NDArray[np.float64]:
        """The needle's tip, shape (2,) [m]."""
        return self._tip_of(self._q)

    @property
    def body(self) -> Points:
        """Points along the needle's axis, from the tail to the tip, shape (m, 2) [m]."""
        return np.array([self._q[1:3] + self._turned(self._q, point) for point in self._needle.outline])

    @property
    def thread(self) -> Points:
        """The thread's nodes, the tail first, shape (n + 1, 2) [m]."""
        return np.array(self._q[1:].reshape(-1, 2))

    @property
    def tension(self) -> NDArray[np.float64]:
        """Tension of each segment, positive when pulled, shape (n,) [N]."""
        chords = np.linalg.norm(np.diff(self._q[1:].reshape(-1, 2), axis=0), axis=1)
        return np.asarray(self._rod.stretching * (chords / self._rod.segment - 1.0))

    @property
    def thread_pull(self) -> NDArray[np.float64]:
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
        shapes = surface.packed()
        self._buffers = make_buffers(self.properties.segments, _contacts(shapes))
        self._shapes = shapes
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
        amperes = np.asarray(currents, dtype=np.float64)
        if not np.array_equal(amperes, self._held):
            # Speeds jump with currents: a formula that looks back over the jump would lag by part of a step.
            self._held, self._last_dt = amperes.copy(), 0.0
        return self._integrate(dt, amperes, None, max_iterations)

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
        self,
        dt: float,
        currents: NDArray[np.float64] | None,
        goal: NDArray[np.float64] | None,
        max_iterations: float = math.inf,
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
                h = min(h, MAX_GROWTH * self._last_dt)
            # What is left is taken whole or in two like steps, never with a sliver at the end.
            if left < 1.5 * h:
                h = left if left < 1.01 * h else 0.5 * left
            if goal is not None:
                self._buffers.trial[:3] = begin + (done + h) / dt * (goal - begin)
            if self._take(h, currents):
                done, h, tries = done + h, regular, 0
                continue
            tries += 1
            if tries > MAX_HALVINGS:
                raise SolverError("rig", "no convergence", self._move, TOLERANCE)
            self.halvings += 1
            h *= 0.5
        return dt

    def _take(self, h: float, currents: NDArray[np.float64] | None) -> bool:
        """Take one step; return whether it converged, and change nothing if not."""
        ratio = h / self._last_dt if self._last_dt > 0.0 else 0.0
        if currents is not None and self.field is not None:
            find_poles(self._q, self._before, ratio, self.needle.tip, self._poles)
            self._flux[:] = (currents @ self.field.per_current(self._poles).reshape(-1, 6)).reshape(2, 3)[:, :2]
        start = self._q.copy()
        iterations, self._move, residual = advance(
            self._q,
            self._before,
            h,
            ratio,
            self._flux,
            Bodies(self._needle, self._rod, self._shapes),
            self._buffers,
            currents is None,
        )
        if iterations < 0:
            return False
        self._before[:], self._last_dt = start, h
        self.time, self.residual, self.iterations = self.time + h, residual, self.iterations + iterations
        return True

    def _tip_of(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(q[1:3] + self._turned(q, self.needle.tip))

    @staticmethod
    def _turned(q: NDArray[np.float64], vector: NDArray[np.float64]) -> NDArray[np.float64]:
        c, s = math.cos(q[0]), math.sin(q[0])
        return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


def _contacts(shapes: Shapes) -> int:
    """Return with how many things one point can have to do at once at the most."""
    return len(shapes.discs) + len(shapes.corners) + 2
