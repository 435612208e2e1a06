"""A camera without an image: pieces of the true thread, with noise, gaps, outliers and what else goes wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.thread_observation import PieceEnd, ThreadObservation, ThreadPiece

SPACING = 1.6e-4  # of the points along the thread, about two pixels [m]
DEVIATION = 2e-5  # of a point across it, a quarter of a pixel [m]
CORRELATION = 2.5e-4  # over which neighbouring points err alike [m]


@dataclass(frozen=True)
class CameraModel:
    """What the camera does to the thread.

    Attributes:
        deviation: of the points across the thread [m].
        outliers: part of the points that lie elsewhere.
        outlier_distance: how far [m].
        scale: factor on all lengths about the dish's middle.
        hidden: arc lengths between which the thread is covered [m].
        hidden_time: from when to when [s].
    """

    deviation: float = DEVIATION
    outliers: float = 0.0
    outlier_distance: float = 5e-3
    scale: float = 1.0
    hidden: tuple[float, float] = (0.0, 0.0)
    hidden_time: tuple[float, float] = (0.0, 0.0)

    def observe(
        self, nodes: Points, time: float, rng: np.random.Generator, others: tuple[Points, ...] = ()
    ) -> ThreadObservation:
        """Return what is seen of a thread, and of other threads in the dish.

        Args:
            nodes: of the thread [m].
            time: [s]
            rng: of the noise.
            others: polylines [m].
        """
        length = float(arc_lengths(nodes)[-1])
        stretches = [(0.0, length)]
        if self.hidden_time[0] <= time < self.hidden_time[1]:
            low, high = self.hidden
            stretches = [(a, b) for a, b in ((0.0, low), (high, length)) if b - a > 4.0 * SPACING]
        pieces = [self._piece(nodes, a, b, length, rng) for a, b in stretches]
        for other in others:
            along = float(arc_lengths(other)[-1])
            points = points_at(other, np.arange(0.0, along, SPACING))
            noisy = points + rng.normal(0.0, self.deviation, points.shape)
            ends = PieceEnd.UNKNOWN, PieceEnd.UNKNOWN
            pieces.append(ThreadPiece(noisy, np.full(len(noisy), self.deviation), *ends, (np.nan, np.nan), False))
        return ThreadObservation(tuple(pieces), complete=len(stretches) == 1 and stretches[0] == (0.0, length))

    def _piece(self, nodes: Points, begin: float, end: float, length: float, rng: np.random.Generator) -> ThreadPiece:
        at = np.linspace(begin, end, max(int((end - begin) / SPACING), 2) + 1)
        points = points_at(nodes, at)
        along = np.gradient(points, axis=0)
        normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.hypot(*along.T)[:, None]
        # Errors that are alike over a length: an Ornstein-Uhlenbeck process along the thread.
        keep = float(np.exp(-2.0 * SPACING / CORRELATION))
        error = rng.normal(0.0, self.deviation, len(points))
        for k in range(1, len(points)):
            error[k] = keep * error[k - 1] + (1.0 - keep * keep) ** 0.5 * error[k]
        noisy = points + error[:, None] * normal
        wrong = rng.random(len(points)) < self.outliers
        angle = rng.uniform(0.0, 2.0 * np.pi, len(points))
        away = self.outlier_distance * np.column_stack([np.cos(angle), np.sin(angle)])
        noisy = np.where(wrong[:, None], noisy + away, noisy) * self.scale
        first = PieceEnd.TAIL if begin == 0.0 else PieceEnd.COVERED
        last = PieceEnd.FREE if end == length else PieceEnd.COVERED
        # What is known of the arc length: of the piece at the needle all, of one at the free end what is left.
        known = (0.0, 0.0) if begin == 0.0 else (0.98 * begin, min(1.02 * begin, length))
        return ThreadPiece(noisy, np.full(len(noisy), self.deviation), first, last, known)
