"""A barrier around a disc that moves, as the tip of an instrument does."""

from __future__ import annotations

import numpy as np

from magnetosuture_thread import Barrier, Gradient


class MovingDisc(Barrier):
    """h_i = |x_i - c(t)| - r for every node, with c(t) = c_0 + t v [m]."""

    name = "moving_disc"

    def __init__(self, centre=(-0.009, 0.004), velocity=(0.0, -0.002), radius=0.0015):
        self.start, self.velocity, self.radius = np.array(centre), np.array(velocity), radius
        self.set_time(0.0)

    def set_time(self, time):
        self.centre = self.start + time * self.velocity

    def value(self, positions):
        return np.linalg.norm(positions - self.centre, axis=1) - self.radius

    def gradient(self, positions):
        away = positions - self.centre
        return Gradient(np.arange(len(away))[:, None], (away / np.linalg.norm(away, axis=1, keepdims=True))[:, None])
