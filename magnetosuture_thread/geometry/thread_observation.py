"""The thread as the camera sees it: pieces, which of their ends are real, and how much of the thread is hidden."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at


class PieceEnd(IntEnum):
    """The reason why a piece ends where it does; the numbers are those of `ThreadPiece.msg`."""

    UNKNOWN = 0  # nothing tells
    TAIL = 1  # the thread leaves the needle here
    FREE = 2  # the thread itself ends here
    COVERED = 3  # the thread goes on below what hides it
    FRAME = 4  # the thread goes on outside of the frame


@dataclass(frozen=True)
class ThreadPiece:
    """A piece of the thread that is seen without a gap.

    Attributes:
        points: along the piece, in the dish frame, shape (m, 2), m >= 2 [m].
        deviation: standard deviation of each point across the piece, shape (m,) [m].
        first_end: why it begins at `points[0]`.
        last_end: why it ends at `points[-1]`.
        arc_length: least and greatest arc length of `points[0]` from the needle's tail [m]; that of `points[k]` is
            larger by the piece's length up to it. NaN where nothing tells.
        direction_known: whether arc length surely grows along `points`. Where it is not, `arc_length` is of either end.
        confidence: that the piece is of this thread, and in this place along it, 0 to 1.
    """

    points: Points
    deviation: np.ndarray
    first_end: PieceEnd
    last_end: PieceEnd
    arc_length: tuple[float, float]
    direction_known: bool = True
    confidence: float = 1.0

    @property
    def length(self) -> float:
        """Length along the piece [m]."""
        return float(arc_lengths(self.points)[-1])


@dataclass(frozen=True)
class ThreadObservation:
    """The thread as one frame shows it.

    Attributes:
        pieces: the one that leaves the needle first, if it is seen; then the others in the order of their arc length,
            last those of which it is unknown.
        complete: whether one piece shows all of the thread, from the tail to the free end.
        hidden: outlines of what the thread may lie below, in the dish frame, each of shape (m, 2), closed [m].
    """

    pieces: tuple[ThreadPiece, ...] = ()
    complete: bool = False
    hidden: tuple[Points, ...] = ()

    @property
    def from_tail(self) -> Points | None:
        """Points of the piece that leaves the needle, shape (m, 2) [m]; None where it isn't seen."""
        if self.pieces and self.pieces[0].first_end is PieceEnd.TAIL:
            return self.pieces[0].points
        return None

    def measured_from(self, offset: float) -> ThreadObservation:
        """Return the same with arc lengths measured from where the thread is fixed, this far along it from the tail.

        Args:
            offset: [m]; what a piece that leaves the needle shows before that is no thread. Negative where the thread
                is fixed in front of the tail, so that it is hidden by the needle at first.
        """
        return replace(self, pieces=tuple(_measured_from(piece, offset) for piece in self.pieces))


def _measured_from(piece: ThreadPiece, offset: float) -> ThreadPiece:
    low, high = piece.arc_length
    if piece.first_end is not PieceEnd.TAIL:
        return replace(piece, arc_length=(low - offset, high - offset))
    if offset <= 0.0:
        return replace(piece, first_end=PieceEnd.COVERED, arc_length=(-offset, -offset))
    arcs = arc_lengths(piece.points)
    rest = arcs > offset
    if not rest.any():
        return replace(piece, first_end=PieceEnd.UNKNOWN, arc_length=(np.nan, np.nan), confidence=0.0)
    first = int(rest.argmax())
    points = np.vstack([points_at(piece.points, np.array([offset])), piece.points[first:]])
    return replace(piece, points=points, deviation=piece.deviation[first - 1 :], arc_length=(0.0, 0.0))
