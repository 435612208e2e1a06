"""One instant of a recorded experiment, as numbers: what the needle did, and where the thread was."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points


def _none() -> Points:
    return np.empty((0, 2))


@dataclass(frozen=True)
class Sight:
    """What one camera frame, or one recorded pose, says.

    Attributes:
        stamp: of the frame [ns].
        tail: the needle's tail, shape (2,) [m]; shape (0,) where the needle was not found.
        heading: unit vector from tail to tip, shape (2,); shape (0,) where the needle was not found.
        seen: the thread's centreline as the camera saw it, from the tail on, shape (m, 2) [m]; m = 0 for none.
        truth: where the thread really was, if the bag says so, shape (m, 2) [m].
        reason: why the needle was not found.
        processing: time that looking at the frame took [s]; nan where the poses were recorded.
    """

    stamp: int
    tail: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    heading: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    seen: Points = field(default_factory=_none)
    truth: Points = field(default_factory=_none)
    reason: str = ""
    processing: float = float("nan")

    @property
    def found(self) -> bool:
        """Whether the needle was found."""
        return len(self.tail) > 0
