"""Scores a predicted thread against where the thread was."""

from __future__ import annotations

import numpy as np

from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at

LEAST_SEEN = 0.5  # of the thread's length must be known, or there is no score


def prediction_error_percent(vertices: Points, curve: Points, length: float) -> float:
    """Return how far a prediction is from a thread, in % of the thread's length.

        error = 100 mean over i = 1 ... n of |x_i - X(s_i)| / L,    s_i = i L / n

    Nodes past the end of the curve, where the camera lost the thread, are left out.

    Args:
        vertices: predicted nodes, shape (n + 1, d) [m].
        curve: where the thread was, from the needle's tail on, shape (m, d) [m].
        length: L [m].

    Returns:
        The error, or nan if less than half of the thread is known.

    Source: reference set, "How a prediction is scored". Deviation: none where the curve is whole.
    """
    segments = len(vertices) - 1
    at = length * np.arange(1, segments + 1) / segments
    known = float(arc_lengths(curve)[-1]) if len(curve) > 1 else 0.0
    within = at <= known * (1.0 + 1e-9)
    if known < LEAST_SEEN * length or not within.any():
        return float("nan")
    distance = np.linalg.norm(vertices[1:][within] - points_at(curve, at[within]), axis=1)
    return float(100.0 * distance.mean() / length)
