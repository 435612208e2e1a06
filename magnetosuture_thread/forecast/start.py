"""Where a forecast starts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.arguments import bounded, checked_arguments
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.estimator import ThreadEstimate
from magnetosuture_thread.model.formulations.step import WarmStart
from magnetosuture_thread.model.prediction import NeedlePose
from magnetosuture_thread.model.predictor import ThreadPredictor
from magnetosuture_thread.model.thread import Thread

Vector = NDArray[np.float64]


@checked_arguments("forecast start", InvalidInputError)
@dataclass(frozen=True, eq=False)
class ForecastStart:
    """Needle and thread at the start of a forecast.

    Attributes:
        pose: of the needle's tail.
        vertices: of the thread, shape (n + 1, 2) [m].
        velocities: of the thread's nodes over the last step, shape (n + 1, 2) [m/s]; None for a thread at rest.
        interval: duration of that step; 0 if there was none [s].
        tip_velocity: filtered velocity of the tip before the start, shape (2,) [m/s], from which the acceleration is
            limited; None if it is not known, and then the first change is not limited.
        needle_force: of the thread upon the needle, shape (2,) [N], from which a needle with drag goes on; None if it
            is not known.
        warm_start: of the formulation, which brings friction that holds already; None for none.
        thread: with the stiffness, rest curvature and drag to forecast with; None for the forecaster's own.
    """

    pose: NeedlePose
    vertices: Points
    velocities: Points | None = None
    interval: Annotated[float, bounded("s", 0.0, 10.0)] = 0.0
    tip_velocity: Vector | None = None
    warm_start: WarmStart | None = None
    needle_force: Vector | None = None
    thread: Thread | None = None

    @classmethod
    def of_estimate(
        cls, estimate: ThreadEstimate, pose: NeedlePose, tip_velocity: Vector | None = None
    ) -> ForecastStart:
        """Return the start from an estimate, with what the estimator has learned of the thread.

        Args:
            estimate: of the thread.
            pose: of the needle's tail.
            tip_velocity: see the attributes.
        """
        forces = estimate.prediction.forces
        needle_force = None if forces is None else forces.needle_force
        positions = estimate.positions
        return cls(pose, positions, tip_velocity=tip_velocity, needle_force=needle_force, thread=estimate.thread)

    @classmethod
    def of_predictor(
        cls,
        predictor: ThreadPredictor,
        pose: NeedlePose | None = None,
        tip_velocity: Vector | None = None,
        needle_force: Vector | None = None,
    ) -> ForecastStart:
        """Return the start from where a predictor is.

        Args:
            predictor: that has started.
            pose: of the needle's tail, where the thread is not fixed to that.
            tip_velocity: see the attributes.
            needle_force: see the attributes.

        Raises:
            InvalidInputError: it has not started.
        """
        if predictor.state is None or predictor.pose is None:
            raise InvalidInputError("predictor", "one before its start", "one that has started")
        state = predictor.state
        warm_start = predictor.formulation.warm_start() if state.interval > 0.0 else None
        own = predictor.pose if pose is None else pose
        return cls(own, state.positions, state.velocities, state.interval, tip_velocity, warm_start, needle_force)
