"""What the estimate is compared with: the camera alone, and a registration tracker."""

from __future__ import annotations

import numpy as np

from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.thread_observation import PieceEnd, ThreadObservation


class CameraAlone:
    """The thread as the last frame shows it: nodes at their arc lengths along the pieces, straight across gaps.

    Args:
        nodes: to begin with, shape (n + 1, 2) [m].
        length: of the thread [m].
    """

    def __init__(self, nodes: Points, length: float) -> None:
        self.nodes, self._length = nodes, length

    def step(self, observation: ThreadObservation | None) -> Points:
        """Return the nodes after a frame."""
        if observation is None:
            return self.nodes
        arcs, points = [], []
        for piece in observation.pieces:
            along = arc_lengths(piece.points)
            if piece.first_end is PieceEnd.TAIL:
                arcs.append(along)
            elif piece.last_end is PieceEnd.FREE:
                arcs.append(self._length - along[-1] + along)
            else:
                continue
            points.append(piece.points)
        if arcs:
            at, where = np.concatenate(arcs), np.concatenate(points)
            order = np.argsort(at, kind="stable")
            wanted = np.linspace(0.0, self._length, len(self.nodes))
            self.nodes = np.column_stack([np.interp(wanted, at[order], where[order, axis]) for axis in range(2)])
        return self.nodes


class CoherentPointDrift:
    """Registration of the last nodes to the frame's points, by a Gaussian mixture with coherent motion.

        x ~ sum_m N(y_m + (G w)_m, s^2 I) and uniform outliers,    G_ij = exp(-(arc_i - arc_j)^2 / (2 beta^2))

    with the penalty lambda / 2 tr(w' G w); a dozen steps of expectation and maximisation a frame. Then the first node
    is moved to the needle's tail, and the others to equal distances along the registered curve.

    Source: A. Myronenko, X. Song, Point Set Registration: Coherent Point Drift, 2010; J. Xiang et al., TrackDLO, 2023.
    Deviation: TrackDLO's visibility by depth and its geodesic proximity of hidden nodes are left out.

    Args:
        nodes: to begin with, shape (n + 1, 2) [m].
        length: of the thread [m].
    """

    beta = 0.15  # of the length
    stiffness = 3.0  # lambda
    outliers = 0.1
    iterations = 12

    def __init__(self, nodes: Points, length: float) -> None:
        self.nodes, self._length = nodes / length, length
        arcs = np.linspace(0.0, 1.0, len(nodes))
        self._kernel = np.exp(-0.5 * ((arcs[:, None] - arcs[None, :]) / self.beta) ** 2)
        self._variance = 1e-4

    def step(self, tail: Points, observation: ThreadObservation | None) -> Points:
        """Return the nodes after a frame."""
        if observation is None or not observation.pieces:
            return self.nodes * self._length
        measured = np.vstack([piece.points for piece in observation.pieces]) / self._length
        before, count = self.nodes, len(self.nodes)
        moved, variance = before.copy(), max(self._variance, 1e-5)
        for _ in range(self.iterations):
            square = ((measured[:, None, :] - moved[None, :, :]) ** 2).sum(axis=2)
            belongs = np.exp(-0.5 * square / variance)
            rest = 2.0 * np.pi * variance * self.outliers / (1.0 - self.outliers) * count
            belongs /= belongs.sum(axis=1, keepdims=True) + rest
            mass = belongs.sum(axis=0)
            left = mass[:, None] * self._kernel + self.stiffness * variance * np.eye(count)
            moved = before + self._kernel @ np.linalg.solve(left, belongs.T @ measured - mass[:, None] * before)
            square = ((measured[:, None, :] - moved[None, :, :]) ** 2).sum(axis=2)
            variance = max(float((belongs * square).sum() / (2.0 * belongs.sum() + 1e-12)), 1e-7)
        self._variance = variance
        moved[0] = tail / self._length
        along = arc_lengths(moved)
        wanted = np.linspace(0.0, along[-1], count)
        self.nodes = np.column_stack([np.interp(wanted, along, moved[:, axis]) for axis in range(2)])
        return self.nodes * self._length
