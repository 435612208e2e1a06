"""Connectivity and compression: a segment is neither longer nor shorter than at rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.barriers.rows import NO_OBSTACLE, BarrierKind, BarrierRows


@dataclass(frozen=True)
class Connectivity:
    """No segment is longer than its rest length.

        h_con,i = (D^2 - |x_i - x_{i-1}|^2) / 2,    i = 1 ... n

    The first row holds the thread to the needle, x_0. Unit of h: that of the positions, squared.

    Source: [Forghani2025], connectivity functions h_con,i and h_con,1. Deviation: none.

    Attributes:
        segment_length: D, in the unit of the positions.
    """

    segment_length: float

    def rows(self, positions: Points) -> BarrierRows:
        """Return the n rows at positions of shape (n + 1, d)."""
        return _segment_rows(positions, self.segment_length, BarrierKind.CONNECTIVITY, 1.0)


@dataclass(frozen=True)
class Compression:
    """No segment is shorter than its rest length.

        h_cmp,i = (|x_i - x_{i-1}|^2 - D^2) / 2,    i = 1 ... n

    Together with the connectivity it makes the thread inextensible. Unit of h: that of the positions,
    squared.

    Source: none. Deviation: the paper leaves it out, so that nodes may coincide in a loop; without it
    the thread bunches up where it is pushed.

    Attributes:
        segment_length: D, in the unit of the positions.
    """

    segment_length: float

    def rows(self, positions: Points) -> BarrierRows:
        """Return the n rows at positions of shape (n + 1, d)."""
        return _segment_rows(positions, self.segment_length, BarrierKind.COMPRESSION, -1.0)


def _segment_rows(positions: Points, segment_length: float, kind: BarrierKind, sign: float) -> BarrierRows:
    segments = np.diff(positions, axis=0)
    count = len(segments)
    lengths = np.linalg.norm(segments, axis=1)
    first = np.arange(count)
    return BarrierRows(
        kind=kind,
        nodes=np.column_stack([first, first + 1]),
        obstacle=np.full(count, NO_OBSTACLE),
        value=sign * 0.5 * (segment_length**2 - lengths**2),
        gradient=sign * np.stack([segments, -segments], axis=1),
        clearance=sign * (segment_length - lengths),
    )
