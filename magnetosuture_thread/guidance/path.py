"""Smooth path through waypoints, parametrised by arc length."""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.polyline import Points, arc_lengths

SAMPLES_PER_SPAN = 200  # between two waypoints, to measure the arc length


class SmoothPath:
    """Cubic spline through waypoints with an optional initial direction.

        p(l), 0 <= l <= L,    |dp / dl| = 1

    Args:
        waypoints: shape (m, 2), m >= 2, no two the same after one another [m].
        direction: initial unit tangent, shape (2,); free if None.

    Raises:
        InvalidInputError: the waypoints do not define a path.
    """

    def __init__(self, waypoints: Points, direction: NDArray[np.float64] | None = None) -> None:
        steps = np.linalg.norm(np.diff(waypoints, axis=0), axis=1) if len(waypoints) > 1 else np.zeros(1)
        knots = np.concatenate([[0.0], np.cumsum(steps)])
        if not np.all(np.isfinite(waypoints)) or not np.all(np.diff(knots) > 0.0):
            raise InvalidInputError("waypoints", waypoints.tolist(), "at least two that differ, finite [m]")
        from scipy.interpolate import CubicSpline  # here, as it takes a third of a second to import

        free: tuple[Literal[1, 2], NDArray[np.float64]] = (2, np.zeros(2))
        curve = CubicSpline(knots, waypoints, bc_type=(free if direction is None else (1, direction), free))
        at = np.unique(np.concatenate([np.linspace(a, b, SAMPLES_PER_SPAN) for a, b in pairwise(knots)]))
        self._points = np.asarray(curve(at))
        self._tangents = np.asarray(curve(at, 1))
        self._tangents /= np.linalg.norm(self._tangents, axis=1)[:, None]
        self._lengths = arc_lengths(self._points)

    @property
    def length(self) -> float:
        """Arc length L [m]."""
        return float(self._lengths[-1])

    def point(self, length: float) -> NDArray[np.float64]:
        """Return the point p(l), shape (2,) [m]; l is clamped to the path."""
        return np.array([np.interp(length, self._lengths, self._points[:, k]) for k in range(2)])

    def tangent(self, length: float) -> NDArray[np.float64]:
        """Return the unit tangent dp / dl, shape (2,)."""
        tangent = np.array([np.interp(length, self._lengths, self._tangents[:, k]) for k in range(2)])
        return np.asarray(tangent / np.linalg.norm(tangent))


def prepare_paths() -> None:
    """Import what the first path needs, which would delay whoever waits for that."""
    SmoothPath(np.array([[0.0, 0.0], [1e-3, 0.0]]))
