"""From a needle velocity to coil currents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

Vector = NDArray[np.float64]

REGULARISATION = 1e-4  # of the velocity's weight: makes the currents the least that do
SATURATION = 1e-3  # a velocity missed by more than this share counts as saturated


@dataclass(frozen=True)
class Allocation:
    """Currents and what they reach.

    Attributes:
        currents: of each coil, shape (m,) [A].
        velocity: that these currents give, shape (2,) [m/s].
        saturated: whether a current limit keeps the needle from the velocity asked for.
    """

    currents: Vector
    velocity: Vector
    saturated: bool


class CoilArray:
    """Coils around the dish, each of which pulls the needle towards itself.

        v = g sum_k i_k e_k,    0 <= i_k <= i_max

    with the direction e_k of coil k and the gain g. The currents are the bounded least-squares
    solution of least size.

    Source: none. Deviation: the force of a real coil depends on where the needle is and how it is
    turned; this is the linear model about the dish's centre.

    Args:
        angles: direction of each coil against the x axis [rad].
        velocity_per_current: g [m/(s A)].
        max_current: i_max [A].
    """

    def __init__(self, angles: Sequence[float], velocity_per_current: float, max_current: float) -> None:
        self.names = tuple(f"coil_{index}" for index in range(len(angles)))
        self._map = velocity_per_current * np.vstack([np.cos(angles), np.sin(angles)])
        self._max_current = max_current
        self._scale = velocity_per_current

    def allocate(self, velocity: Vector) -> Allocation:
        """Return the currents for a needle velocity of shape (2,) [m/s]."""
        count = len(self.names)
        if not np.any(velocity):
            return Allocation(np.zeros(count), np.zeros(2), False)
        system = np.vstack([self._map / self._scale, np.sqrt(REGULARISATION) * np.eye(count)])
        target = np.concatenate([velocity / self._scale, np.zeros(count)])
        found = lsq_linear(system, target, bounds=(0.0, self._max_current), method="bvls")
        currents = np.clip(found.x, 0.0, self._max_current)
        reached = self._map @ currents
        missed = float(np.linalg.norm(reached - velocity)) > SATURATION * float(np.linalg.norm(velocity))
        return Allocation(currents, reached, missed and bool(np.any(currents >= 0.999 * self._max_current)))
