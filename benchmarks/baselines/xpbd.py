"""An XPBD rope: position-based dynamics with compliances, no inertia, viscous drag, bending.

    minimise over x   zeta D / (2 dt) sum_i m_i |x_i - y_i|^2 + E_bend(x)    subject to   |x_i - x_{i-1}| = D

y is the last position, m_i = 1 and 1/2 at the end. Each iteration goes once from the lead to the end and
gives each constraint its multiplier as if it were alone; with w_i = dt / (zeta D m_i) a correction is

    distance:  |x_i - x_{i-1}| - D = 0                      dl = -C / (w_{i-1} + w_i)
    bending:   C = x_{i-1} - 2 x_i + x_{i+1}, stiffness k   dl = -(C + l / k) / (w_{i-1} + 4 w_i + w_{i+1} + 1 / k)

Source: M. Macklin, M. Mueller, N. Chentanez, "XPBD", 2016. Deviation: without inertia, the drag takes the
place of the mass over dt.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.baselines.simulators import Scaled, check
from benchmarks.solver.cases import Case
from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points

ITERATIONS = 20


class XpbdRope:
    """A rope of n segments.

    Args:
        case: the motion.
        iterations: of each sub-step.
        substeps: of each pose sample.
    """

    name = "xpbd"
    physics = "same model with isotropic drag, not iterated to the end"

    def __init__(self, case: Case, iterations: int = ITERATIONS, substeps: int = 1) -> None:
        check(case)
        self._scaled = Scaled(case.thread)
        self._iterations, self._substeps = iterations, substeps
        self._interval = case.interval / substeps
        self._positions = case.start / self._scaled.unit
        self._lead = self._positions[0].copy()

    def advance(self, tail: NDArray[np.float64]) -> Points:
        """Move the lead; see `Simulator`."""
        target = tail / self._scaled.unit
        begun = self._lead
        for i in range(1, self._substeps + 1):
            self._positions[0] = begun + (target - begun) * (i / self._substeps)
            relax(self._positions, self._interval, self._scaled.joint, self._iterations)
        self._lead = target
        return self._positions * self._scaled.unit


@compiled
def relax(x: Points, interval: float, stiffness: float, iterations: int) -> None:
    """Move all nodes but the first, which is the lead, in place.

    Args:
        x: shape (n + 1, d) [D].
        interval: dt [s].
        stiffness: k, of a joint [1/s].
        iterations: sweeps from the lead to the end.
    """
    nodes, dimension = x.shape
    w = np.full(nodes, interval)
    w[0], w[-1] = 0.0, 2.0 * interval
    moments = np.zeros((nodes, dimension))
    compliance = 1.0 / stiffness
    for _ in range(iterations):
        for i in range(1, nodes):
            square = 0.0
            for a in range(dimension):
                square += (x[i, a] - x[i - 1, a]) ** 2
            length = np.sqrt(square)
            if length > 0.0:
                share = (length - 1.0) / (length * (w[i - 1] + w[i]))
                for a in range(dimension):
                    pull = share * (x[i, a] - x[i - 1, a])
                    x[i - 1, a] += w[i - 1] * pull
                    x[i, a] -= w[i] * pull
            if i + 1 < nodes:
                total = w[i - 1] + 4.0 * w[i] + w[i + 1] + compliance
                for a in range(dimension):
                    turn = x[i - 1, a] - 2.0 * x[i, a] + x[i + 1, a]
                    change = -(turn + compliance * moments[i, a]) / total
                    moments[i, a] += change
                    x[i - 1, a] += w[i - 1] * change
                    x[i, a] -= 2.0 * w[i] * change
                    x[i + 1, a] += w[i + 1] * change
