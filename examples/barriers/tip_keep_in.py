"""A barrier that keeps the thread's loose end within a convex polygon."""

from __future__ import annotations

import numpy as np

from magnetosuture_thread import Barrier, Gradient


class TipKeepIn(Barrier):
    """h_k = n_k . (x_n - p_k) for each edge of the polygon, with its inward normal n_k and corner p_k [m]."""

    name = "tip_keep_in"

    def __init__(self, corners=((-0.022, -0.001), (0.01, -0.001), (0.01, 0.0008), (-0.022, 0.0008))):
        self.corners = np.array(corners)  # counterclockwise
        along = np.roll(self.corners, -1, axis=0) - self.corners
        self.normals = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]

    def value(self, positions):
        return np.einsum("kd,kd->k", self.normals, positions[-1] - self.corners)

    def gradient(self, positions):
        return Gradient(np.full((len(self.normals), 1), len(positions) - 1), self.normals[:, None])
