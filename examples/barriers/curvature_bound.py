"""A barrier that bounds the thread's curvature."""

from __future__ import annotations

import numpy as np

from magnetosuture_thread import Barrier, Gradient


class CurvatureBound(Barrier):
    """h_i = (kappa_max^2 D^4 - |x_{i+1} - 2 x_i + x_{i-1}|^2) / 2, i = 1 ... n - 1, with segments of length D [m^2]."""

    name = "curvature_bound"

    def __init__(self, max_curvature=150.0, segment_length=0.019 / 25):  # 1/m and m
        self.bound = max_curvature * segment_length**2

    def value(self, positions):
        second = positions[2:] - 2.0 * positions[1:-1] + positions[:-2]
        return 0.5 * (self.bound**2 - np.einsum("id,id->i", second, second))

    def gradient(self, positions):
        second = positions[2:] - 2.0 * positions[1:-1] + positions[:-2]
        nodes = np.arange(len(second))[:, None] + np.arange(3)
        return Gradient(nodes, -second[:, None, :] * np.array([1.0, -2.0, 1.0])[None, :, None])
