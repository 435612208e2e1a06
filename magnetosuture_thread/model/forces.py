"""The forces of a step: what its multipliers and the rod's energies say in newtons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.margins import FrictionState
from magnetosuture_thread.model.program import Vector

SLIDING_TOLERANCE = 1e-6  # of a friction's limit


@dataclass(frozen=True, eq=False)
class ThreadForces:
    """The forces in a thread and on it, at the end of a step.

    A row's multiplier is the force that keeps its barrier. With the program in units of the segment's length D, and of
    the metric's scale Z = zeta_perp + mu / dt, and f_j what the thread's own segments push node j with, by tension and
    bending (`keep_internal_forces`),

        T_i = Z D^2 t_i' sum_{j<i} f_j,    N_i = Z D^2 sum_c lambda_c n_c

    over the contacts c of node i, those of friction included. The thread pulls the needle with what its first segment
    does, and with the loads on half of that,

        F = Z D^2 f_0 + N_0 + (D / 2) (mu (g - dv / dt) - zeta_perp v + (zeta_perp - zeta_par) t_1 t_1' v)

    with the tail's velocity v, in the drag against the medium, and turns it, if clamped, by
    M = -dE_bend / d(heading angle).

    Attributes:
        tension: T_i of each segment, positive where it is pulled, shape (n,) [N]: what the one half of the thread pulls
            at the other with, along the segment.
        contact: N_i, the force of shapes and wall upon each node, shape (n + 1, d) [N].
        needle_force: F, of the thread upon the needle, at its tail, shape (d,) [N].
        needle_moment: M about the tail, counter-clockwise, 0 of a pinned thread; in the plane only, else NaN [N m].
        friction: the part of N_i along the shapes, shape (n + 1,) [N].
        friction_use: the same over its limit mu N of the shape where it is nearest to it: 1 where the node slides, 0
            where it has no friction, shape (n + 1,).

    Source: Lagrange's multipliers; the paper works no force out. Deviation: none but that friction on the first segment
    is not in F.
    """

    tension: Vector
    contact: Points
    needle_force: Vector
    needle_moment: float
    friction: Vector
    friction_use: Vector

    @property
    def friction_states(self) -> tuple[FrictionState, ...]:
        """Of each node: free of friction, stuck, or sliding."""
        slides, sticks = self.friction_use >= 1.0 - SLIDING_TOLERANCE, self.friction_use > 0.0
        return tuple(
            FrictionState.SLIDING if slide else FrictionState.STUCK if stick else FrictionState.FREE
            for slide, stick in zip(slides.tolist(), sticks.tolist(), strict=True)
        )

    @property
    def peak_tension(self) -> float:
        """The greatest tension of all segments [N]."""
        return float(np.max(self.tension))
