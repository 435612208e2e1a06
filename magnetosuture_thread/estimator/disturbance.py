"""Disturbances: where the thread moves in a way that no force of the model explains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.estimator.correction import normals_of
from magnetosuture_thread.geometry.polyline import Mask, Points, Vector
from magnetosuture_thread.thread.material import Attachment, Thread

AVERAGING_TIME = 0.4  # s; over which corrections are added up
FOUND, LOST = 4.5, 2.5  # standard deviations at which a disturbance begins and ends


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
    value, unit = (1e3 * force, "mN") if force >= 1e-4 else (1e6 * force, "µN")
    return f"{value:.0f} {unit}" if value >= 10.0 else f"{value:.2g} {unit}"


def _way(x: float, y: float) -> str:
    """Return a direction in words, to an eighth of a turn."""
    words = ["to the right" if x > 0.0 else "to the left"] if abs(x) > math.sin(math.pi / 8.0) else []
    words += ["up" if y > 0.0 else "down"] if abs(y) > math.sin(math.pi / 8.0) else []
    return " and ".join(reversed(words))


class BendingRelaxation:
    """What the rod's own bending makes of a displacement across it.

        (1 + a C' C) e' = e,    a = dt EI / (zeta D^4),    (C e)_i = e_{i-1} - 2 e_i + e_{i+1}

    is an implicit step of a straight rod in a viscous liquid, without tension, from the displacement e. The node at the
    needle is given; where the thread is clamped, so is its direction there.

    Args:
        segments: n.
        clamped: whether the direction at the needle is given.
    """

    def __init__(self, segments: int, clamped: bool) -> None:
        curvature = np.diff(np.eye(segments + 1), 2, axis=0)
        if clamped:  # half a segment of curvature 2 (e_1 - e_0 - slope)
            first = math.sqrt(2.0) * (np.eye(1, segments + 1, 1) - np.eye(1, segments + 1))
            curvature = np.vstack([first, curvature])
        matrix = curvature.T @ curvature
        self._at_needle, self._clamped = matrix[1:, :1], clamped
        self._eigenvalues, self._modes = np.linalg.eigh(matrix[1:, 1:])

    def relaxed(self, amount: float, displacement: Points, slope: Vector | float = 0.0) -> Points:
        """Return e'.

        Args:
            amount: a.
            displacement: e, with that of the needle as its first row, shape (n + 1, k).
            slope: by how much the first node is displaced farther than the needle, if clamped, shape (k,).
        """
        right = displacement[1:] - amount * self._at_needle * displacement[0]
        if self._clamped:
            right[0] += 2.0 * amount * slope
        modes = (self._modes.T @ right) / (1.0 + amount * np.maximum(self._eigenvalues, 0.0))[:, None]
        return np.vstack([displacement[:1], self._modes @ modes])


@np.errstate(divide="ignore", invalid="ignore")
def significance(
    displacement: Points, normals: Points, variance: Vector, response: Points, deviations: Vector
) -> float:
    """Return how significant a displacement is in its worst window, against what needs no disturbance.

        z = |mean displacement| / (2 r + sum_j (g_j s_j)^2)^(1/2)

    Of a right model the displacement is a difference of two errors of the estimate, and neither is larger than that of
    the points alone, r; and g_j s_j are what errors of the needle's pose displace it by.

    Args:
        displacement: shape (n + 1, 2).
        normals: of the nodes, shape (n + 1, 2).
        variance: r of the mean of a window's points, inf where nothing is measured, shape (w,).
        response: g, displacement of each node across the thread by each error of the pose, shape (n + 1, 2).
        deviations: s, standard deviation of each error of the pose, shape (2,).
    """
    windows, nodes = len(variance), len(displacement)
    across = np.column_stack([np.einsum("ia,ia->i", normals, displacement), response * deviations])[1:]
    window = np.arange(1, nodes) * windows // nodes
    sums = np.array([np.bincount(window, each, windows) for each in across.T])
    mean, *posed = sums / np.bincount(window, minlength=windows)
    return float(np.nanmax(np.abs(mean) / np.sqrt(2.0 * variance + posed[0] ** 2 + posed[1] ** 2)))


def strongest(rate: Points, positions: Points, thread: Thread, significance: float, since: float) -> Disturbance:
    """Return the stretch of thread with the greatest force to one side that explains a velocity nobody predicts.

        f_i = D zeta_perp n_i . r_i + (dt EI / D^3) n_i . (second differences of c(r))_i + T_i kappa_i
        T_i = -sum_{j > i} D zeta_par t_j . r_j,    c(r)_i = r_{i+1} - 2 r_i + r_{i-1}

    The force of what touches the thread is across it; along it the tension alone balances the drag.

    Args:
        rate: r, by how much faster each node moves than predicted, over the time dt, shape (n + 1, 2) [m/s].
        positions: shape (n + 1, 2) [m].
        thread: the thread.
        significance: [standard deviations]
        since: [s]
    """
    normal, unit, medium = normals_of(positions), thread.segment_length, thread.medium
    pull = unit * medium.drag_along * (normal[:, 1] * rate[:, 0] - normal[:, 0] * rate[:, 1])
    tensions = np.cumsum(pull[::-1])[::-1] - pull
    turn, curved = np.zeros(len(positions)), np.zeros((len(positions) + 2, 2))
    turn[1:-1] = np.einsum("ia,ia->i", np.diff(positions, 2, axis=0), normal[1:-1]) / unit
    curved[2:-2] = np.diff(rate, 2, axis=0)
    bending = thread.bending_stiffness * AVERAGING_TIME / unit**3
    forces = unit * medium.drag_across * rate + bending * np.diff(curved, 2, axis=0)
    force = np.einsum("ia,ia->i", normal, forces) + tensions * turn
    # Stretches of one sign; the needle itself, node 0, carries what acts on it.
    starts = np.concatenate([[1], np.flatnonzero(np.diff(np.sign(force[1:]))) + 2])
    sums = np.add.reduceat(force, starts)
    k = int(np.abs(sums).argmax())
    nodes = np.arange(starts[k], [*starts, len(force)][k + 1])
    share = force[nodes] / sums[k] if sums[k] != 0.0 else np.full(len(nodes), 1.0 / len(nodes))
    middle = float(share @ nodes)
    place = np.array([np.interp(middle, np.arange(len(positions)), axis) for axis in positions.T])
    direction = math.copysign(1.0, sums[k]) * normal[round(middle)]
    size = abs(float(sums[k]))
    return Disturbance(middle * unit, len(nodes) * unit, place, direction, size, significance, since)


class DisturbanceTest:
    """Tests whether the camera moves the thread farther than model, camera and needle can be wrong.

    Arrays are replaced and never written to, so that a shallow copy keeps a state.

    What corrections move the thread by is added up, and relaxes by bending meanwhile, as a thread does that is
    displaced:

        (1 + a C' C) e_k = exp(-dt / T) e_{k-1} + d_k        see `BendingRelaxation`

    so e is by how much a model that was left alone over the time T would have gone another way. Of a pose of the
    needle, a shape or a camera that is a little off, that stays about as much: a sum of the corrections alone would
    count the same error anew with every frame.

    Where shapes or wall that the model knows pushed the thread within the last times T, they may push more or less than
    the model says, or earlier or later: a free end that is braced against the wall slips at a force that a few
    micrometres of the needle's pose decide. So forces at such nodes, by least squares, may explain e: it is a
    disturbance only where what they leave of it is significant too.

    Args:
        thread: the thread.
    """

    def __init__(self, thread: Thread) -> None:
        nodes = thread.segments + 1
        self._thread = thread
        self._rate = thread.bending_stiffness / (thread.medium.drag_across * thread.segment_length**4)  # 1/s
        self._bending = BendingRelaxation(thread.segments, thread.attachment is Attachment.CLAMPED)
        # Displacement of the nodes over that of the tail, and over an error of the heading [m/rad].
        slope, tail = np.array([0.0, thread.segment_length]), np.zeros((nodes, 2))
        tail[0, 0] = 1.0
        self._response = self._bending.relaxed(AVERAGING_TIME * self._rate, tail, slope)
        self._displacement = self._explained = np.zeros((nodes, 2))  # e, and of it by forces of known contacts [m]
        self._untouched = np.full(nodes, np.inf)  # time since a contact pushed each node [s]
        self._since, self._significance = math.nan, 0.0
        self._gap = False

    def decay(self, interval: float, in_contact: Mask) -> None:
        """Let time pass.

        Args:
            interval: [s]
            in_contact: nodes that known shapes or the wall pushed meanwhile, shape (n + 1,).
        """
        # Nobody knows which way the needle went in a gap between poses, so the next correction says nothing.
        self._gap = self._gap or interval > AVERAGING_TIME
        decayed = math.exp(-interval / AVERAGING_TIME) * self._displacement
        self._displacement = self._bending.relaxed(interval * self._rate, decayed)
        self._untouched = np.where(in_contact, 0.0, self._untouched + interval)

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
        self._displacement, self._explained = self._displacement + moved, np.zeros_like(moved)
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

        A force on node c displaces as `BendingRelaxation` says of a load there.
        """
        # What a known contact did is forgotten after three averaging times.
        touched = self._untouched <= 3.0 * AVERAGING_TIME
        touched[0] = False
        ends = np.flatnonzero(touched & (np.convolve(touched, (1, 0, 1), "same") < 2))  # of each stretch
        shapes = np.eye(len(normals))[:, ends]
        shapes = self._bending.relaxed(AVERAGING_TIME * self._rate, shapes)
        shapes /= np.maximum(np.linalg.norm(shapes, axis=0), 1e-12)
        across = np.hstack([normals[:, :1] * shapes, normals[:, 1:] * shapes])
        aside = np.einsum("ij,ij->i", normals, self._displacement)
        forces = np.linalg.lstsq(across, aside, rcond=1e-3)[0].reshape(2, -1)
        return np.asarray(shapes @ forces.T)

    def found(self, stamp: float, positions: Points) -> tuple[Disturbance, ...]:
        """Return the force that explains what the camera moves the thread by, if it does so for long."""
        if not stamp - self._since >= 0.25 * AVERAGING_TIME:
            return ()
        rate = (self._displacement - self._explained) / AVERAGING_TIME
        return (strongest(rate, positions, self._thread, self._significance, self._since),)
