"""Disturbances: where the thread moves in a way that no force of the model explains."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.estimator.relaxation import relax, significance
from magnetosuture_thread.model.thread import Attachment, Thread

Vector = NDArray[np.float64]

FOUND, LOST = 4.5, 2.5  # standard deviations at which a disturbance begins and ends
STRAIGHT = np.zeros(2)  # a heading that is right
CONFIRMED = 0.25  # of the averaging time, for which it must last
CONTACT_TIME = 3.0  # averaging times, in which what a known contact did is forgotten


@dataclass(frozen=True)
class Disturbance:
    """A force on the thread that the model does not know: a contact, a hand, a current.

    Attributes:
        arc_length: of the middle of the force, from the needle's tail [m].
        extent: length of the stretch of thread that it acts on [m].
        position: of the middle, shape (2,) [m].
        direction: unit vector of the force, shape (2,).
        force: [N]
        significance: of the innovations, in standard deviations.
        since: when it was first found [s].
    """

    arc_length: float
    extent: float
    position: Points
    direction: Points
    force: float
    significance: float
    since: float

    def __str__(self) -> str:
        """Return it in words."""
        return disturbance_text(self.arc_length, self.force, self.direction)


def disturbance_text(arc_length: float, force: float, direction: Sequence[float] | Points) -> str:
    """Return a disturbance in words, with directions as in the dish frame: right is x, up is y.

    >>> disturbance_text(0.031, 2e-4, (-1.0, 0.0))
    'held at 31 mm of the thread: 0.2 mN to the left'
    """
    return f"held at {1e3 * arc_length:.0f} mm of the thread: {_amount(force)} {_way(*direction)}"


def _amount(force: float) -> str:
    value, unit = (1e3 * force, "mN") if force >= 1e-4 else (1e6 * force, "uN")
    return f"{value:.0f} {unit}" if value >= 10.0 else f"{value:.2g} {unit}"


def _way(x: float, y: float) -> str:
    """Return a direction in words, to an eighth of a turn."""
    words = ["to the right" if x > 0.0 else "to the left"] if abs(x) > math.sin(math.pi / 8.0) else []
    words += ["up" if y > 0.0 else "down"] if abs(y) > math.sin(math.pi / 8.0) else []
    return " and ".join(reversed(words))


def force_density(
    rate: Points, positions: Points, drag_across: float, drag_along: float, bending: float = 0.0
) -> Vector:
    """Return the normal force on each node that explains a velocity that the model does not predict [N].

        f_i = D zeta_perp n_i . r_i + (dt EI / D^3) n_i . (second differences of c(r))_i + T_i kappa_i
        T_i = -sum_{j > i} D zeta_par t_j . r_j,    c(r)_i = r_{i+1} - 2 r_i + r_{i-1}

    The force of what touches the thread is across it; along it the tension alone balances the drag.

    Args:
        rate: r, by how much faster each node moves than predicted, shape (n + 1, 2) [m/s].
        positions: shape (n + 1, 2) [m].
        drag_across: zeta_perp [Pa s].
        drag_along: zeta_par [Pa s].
        bending: dt EI, the stiffness times the interval over which r was averaged [N m^2 s].
    """
    along = np.gradient(positions, axis=0)
    size = np.maximum(np.hypot(*along.T), 1e-12)
    tangent = along / size[:, None]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    unit = float(size.mean())
    pull = unit * drag_along * np.einsum("ij,ij->i", tangent, rate)
    tensions = -(np.cumsum(pull[::-1])[::-1] - pull)
    turn = np.zeros(len(positions))
    bend = positions[2:] - 2.0 * positions[1:-1] + positions[:-2]
    turn[1:-1] = np.einsum("ij,ij->i", bend, normal[1:-1]) / unit
    curved = np.zeros_like(rate)
    curved[1:-1] = rate[2:] - 2.0 * rate[1:-1] + rate[:-2]
    bent = -2.0 * curved
    bent[1:] += curved[:-1]
    bent[:-1] += curved[1:]
    force = unit * drag_across * rate + bending / unit**3 * bent
    return np.asarray(np.einsum("ij,ij->i", normal, force) - tensions * turn)


def strongest(force: Vector, positions: Points, unit: float, significance: float, since: float) -> Disturbance:
    """Return the stretch of thread with the greatest force to one side.

    Args:
        force: on each node along its normal, shape (n + 1,) [N].
        positions: shape (n + 1, 2) [m].
        unit: D [m].
        significance: [standard deviations]
        since: [s]
    """
    # Stretches of one sign; the needle itself, node 0, carries what acts on it.
    signs = np.sign(force[1:])
    starts = np.concatenate([[0], np.flatnonzero(np.diff(signs)) + 1, [len(signs)]])
    sums = np.add.reduceat(force[1:], starts[:-1])
    k = int(np.abs(sums).argmax())
    nodes = np.arange(starts[k], starts[k + 1]) + 1
    share = force[nodes] / sums[k] if sums[k] != 0.0 else np.full(len(nodes), 1.0 / len(nodes))
    middle = float(share @ nodes)
    along = np.gradient(positions, axis=0)
    at = round(middle)
    tangent = along[at] / max(float(np.hypot(*along[at])), 1e-12)
    place = np.array([np.interp(middle, np.arange(len(positions)), positions[:, axis]) for axis in range(2)])
    side = 1.0 if sums[k] >= 0.0 else -1.0
    return Disturbance(
        arc_length=middle * unit,
        extent=len(nodes) * unit,
        position=place,
        direction=side * np.array([-tangent[1], tangent[0]]),
        force=abs(float(sums[k])),
        significance=significance,
        since=since,
    )


class DisturbanceTest:
    """Tests whether the camera moves the thread farther than model, camera and needle can be wrong.

    What corrections move the thread by is added up, and relaxes by bending meanwhile, as a thread does that is
    displaced:

        (1 + a C' C) e_k = exp(-dt / T) e_{k-1} + d_k        see `relax`

    so e is by how much a model that was left alone over the time T would have gone another way. Of a pose of the
    needle, a shape or a camera that is a little off, that stays about as much: a sum of the corrections alone would
    count the same error anew with every frame.

    Where shapes or wall that the model knows pushed the thread within the last times T, they may push more or less than
    the model says, or earlier or later: a free end that is braced against the wall slips at a force that a few
    micrometres of the needle's pose decide. So forces at such nodes, by least squares, may explain e: it is a
    disturbance only where what they leave of it is significant too.

    Args:
        thread: the thread.
        time: T, over which corrections are added up [s].
    """

    def __init__(self, thread: Thread, time: float) -> None:
        self._use(thread, time)
        self._displacement = np.zeros((thread.segments + 1, 2))  # e [m]
        self._explained = np.zeros_like(self._displacement)  # of it, by forces of known contacts [m]
        self._untouched = np.full(thread.segments + 1, np.inf)  # time since a contact pushed each node [s]
        self._since, self._significance = math.nan, 0.0
        self._gap = False

    def _use(self, thread: Thread, time: float) -> None:
        self._thread, self._time = thread, time
        self._clamped = thread.attachment is Attachment.CLAMPED
        self._stiffness = thread.bending_stiffness / (thread.medium.drag_across * thread.segment_length**4)  # 1/s
        # Displacement of the nodes over that of the tail, and over an error of the heading [m/rad].
        self._response = np.zeros((thread.segments + 1, 2))
        self._response[0, 0] = 1.0
        relax(time * self._stiffness, self._clamped, np.array([0.0, thread.segment_length]), self._response)

    def copied(self) -> DisturbanceTest:
        """Return a copy."""
        other = copy.copy(self)
        other._displacement, other._explained = self._displacement.copy(), self._explained.copy()
        other._untouched = self._untouched.copy()
        return other

    def resampled(self, thread: Thread, time: float) -> DisturbanceTest:
        """Return the same test of another thread, or with another averaging time [s]."""
        other = copy.copy(self)
        other._use(thread, time)
        nodes = self._thread.segment_length * np.arange(self._thread.segments + 1)
        at = thread.segment_length * np.arange(thread.segments + 1)
        other._displacement = np.column_stack([np.interp(at, nodes, along) for along in self._displacement.T])
        other._explained = np.column_stack([np.interp(at, nodes, along) for along in self._explained.T])
        nearest = np.rint(at / self._thread.segment_length).astype(np.int64)
        other._untouched = self._untouched[np.minimum(nearest, self._thread.segments)]
        return other

    def decay(self, interval: float, in_contact: NDArray[np.bool_]) -> None:
        """Let time pass.

        Args:
            interval: [s]
            in_contact: nodes that known shapes or the wall pushed meanwhile, shape (n + 1,).
        """
        # Nobody knows which way the needle went in a gap between poses, so the next correction says nothing.
        self._gap = self._gap or interval > self._time
        self._displacement *= math.exp(-interval / self._time)
        relax(interval * self._stiffness, self._clamped, STRAIGHT, self._displacement)
        self._untouched += interval
        self._untouched[in_contact] = 0.0

    def add(self, moved: Points, normals: Points, variance: Vector, stamp: float, deviations: Vector) -> None:
        """Add a correction.

        Args:
            moved: by it, shape (n + 1, 2) [m].
            normals: of the nodes, shape (n + 1, 2).
            variance: of the mean of each window's points, inf where nothing is measured, shape (w,) [m^2].
            stamp: [s]
            deviations: standard deviations of the needle's tail [m] and heading [rad].
        """
        if self._gap:
            self._gap = False
            return
        self._displacement += moved
        self._explained[:] = 0.0
        self._significance = significance(self._displacement, normals, variance, self._response, deviations)
        if self._significance > LOST:
            explained = self._by_contacts(normals)
            left = significance(self._displacement - explained, normals, variance, self._response, deviations)
            if left <= FOUND:
                self._explained, self._significance = explained, left
        if self._significance > FOUND:
            self._since = stamp if math.isnan(self._since) else self._since
        elif self._significance < LOST:
            self._since = math.nan

    def _by_contacts(self, normals: Points) -> Points:
        """Return the displacement by forces at the nodes of known contacts that comes closest to e, shape (n + 1, 2).

        A force on node c displaces as `relax` says of a load there.
        """
        touched = np.flatnonzero(self._untouched <= CONTACT_TIME * self._time)
        touched = touched[touched > 0]
        if not len(touched):
            return np.zeros_like(normals)
        runs = np.split(touched, np.flatnonzero(np.diff(touched) > 1) + 1)
        columns = []
        for node in sorted({int(end) for run in runs for end in (run[0], run[-1])}):
            loads = np.zeros_like(normals)
            loads[node] = 1.0
            relax(self._time * self._stiffness, self._clamped, STRAIGHT, loads)
            columns += [loads * (1.0, 0.0), loads * (0.0, 1.0)]
        responses = np.array(columns)
        responses /= np.maximum(np.linalg.norm(responses, axis=(1, 2)), 1e-12)[:, None, None]
        across = np.einsum("ij,kij->ik", normals, responses)
        aside = np.einsum("ij,ij->i", normals, self._displacement)
        forces = np.linalg.lstsq(across, aside, rcond=1e-3)[0]
        return np.asarray(np.einsum("k,kij->ij", forces, responses))

    def confirmed(self, stamp: float) -> bool:
        """Return whether the camera has moved the thread too far for long."""
        return stamp - self._since >= CONFIRMED * self._time

    def found(self, stamp: float, positions: Points) -> tuple[Disturbance, ...]:
        """Return the forces that explain what the camera moves the thread by, if it does so for long."""
        if not self.confirmed(stamp):
            return ()
        thread = self._thread
        drag, bending = thread.medium, thread.bending_stiffness * self._time
        rate = (self._displacement - self._explained) / self._time
        force = force_density(rate, positions, drag.drag_across, drag.drag_along, bending)
        return (strongest(force, positions, thread.segment_length, self._significance, self._since),)
