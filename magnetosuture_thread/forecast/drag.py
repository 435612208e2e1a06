"""How the thread's pull moves the needle besides its coils."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.arguments import bounded, checked_arguments
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.model.thread import Thread


@checked_arguments("needle drag")
@dataclass(frozen=True)
class NeedleDrag:
    """The needle's drag, by which the thread's pull moves it.

    Coils allocated for a velocity v of the tip give the needle a force along its chord and a torque. With the force F
    of the thread at its tail, the unit vector e from tail to tip, n to its left, and the chord l, the needle moves with

        u = (along v . e + F . e) / (along - thread),    w = F . n / across
        omega = (v . n) / (l / 2) - (l / 2) (F . n) / turning

    where `along` has, as that of the coil bridge, the drag `thread` of a straight thread behind the needle: with that
    thread u = v . e. Source: none; force and torque balance without inertia. Deviation: the moment of a clamped thread
    is left out; and the pull moves the needle no faster than the filtered velocity times the share of the commanded one
    that this is, as a needle that the barriers hold back leans on what they keep it from.

    Attributes:
        along: drag along the needle, that of a straight thread included [N s/m].
        across: drag across it [N s/m].
        turning: torque at 1 rad/s [N m s].
        thread: part of `along` that the thread adds; None for all of its drag along itself [N s/m].

    Raises:
        ConfigurationError: a number is not positive, or the thread's part is not less than the whole.
    """

    along: Annotated[float, bounded("N s/m", 1e-15)]
    across: Annotated[float, bounded("N s/m", 1e-15)]
    turning: Annotated[float, bounded("N m s", 1e-20)]
    thread: float | None = None

    def numbers(self, thread: Thread, learned: Thread | None = None) -> NDArray[np.float64]:
        """Return what compiled code takes, see `RolloutModel`.

        Args:
            thread: with which `along` was measured.
            learned: that is driven, as the estimator has learned it; None for the same.

        Raises:
            ConfigurationError: the thread's part is not less than the whole.
        """
        part = thread.medium.drag_along * thread.length if self.thread is None else self.thread
        if not 0.0 <= part < self.along:
            raise ConfigurationError("needle drag along", self.along, f"more than the thread's part, {part:g} N s/m")
        driven = thread if learned is None else learned
        whole = driven.medium.drag_across * driven.length
        return np.array([self.along, self.along - part, self.across, self.turning, whole])
