"""Where a forecast starts, and its result."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.arguments import bounded, checked_arguments
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.estimator import ThreadEstimate
from magnetosuture_thread.forecast.rollout import KINDS, NEEDLE_MARGIN, NO_CONTACT, OBSTACLE_MARGIN, RolloutRecord
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread.formulations import WarmStart
from magnetosuture_thread.thread.material import Thread
from magnetosuture_thread.thread.prediction import NeedlePose
from magnetosuture_thread.thread.predictor import ThreadPredictor

Vector = NDArray[np.float64]

WALL_NAME = "wall"


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


@dataclass(frozen=True)
class ForecastMargin:
    """The least margin of one kind over a forecast.

    Attributes:
        value: a distance [m], inf where nothing comes near: the clearance of the thread's surface from shapes or wall,
            that of nodes and half segments as in `Margins`;
            a segment's length that is left until it is taut, or until it is pressed together; the distance of the
            needle's axis from shapes and wall, less `keep_out`.
        time: since the start of the forecast [s].
        node: of the thread, 0 for the needle.
        shape: name of the shape, "wall", or empty.
    """

    value: float
    time: float
    node: int
    shape: str


@dataclass(frozen=True)
class ForecastContact:
    """When the thread first touches something.

    Attributes:
        time: since the start of the forecast, 0 where it touches already [s].
        node: of the thread that touches, or the first of a segment's two.
        shape: name of the shape, or "wall".
    """

    time: float
    node: int
    shape: str


@dataclass(frozen=True, eq=False)
class Forecast:
    """Needle and thread over a horizon of k steps, at k + 1 instants; fewer where a step has no solution.

    Attributes:
        stamp: of the needle's pose at the start [s].
        times: since then, shape (k + 1,) [s].
        vertices: of the thread, shape (k + 1, n + 1, 2) [m].
        tails: of the needle, shape (k + 1, 2) [m].
        headings: of the needle at its tail, unit vectors, shape (k + 1, 2).
        commanded: velocity of the tip in each step, shape (k, 2) [m/s].
        filtered: what the thread's friction and the safety filter leave of it, shape (k, 2) [m/s].
        slowdown: by the thread's friction in each step, shape (k,).
        margins: least margin of each kind at each instant, shape (k + 1,) [m], by "obstacle", "wall", "connectivity",
            "compression" and "needle"; see `ForecastMargin`.
        friction: nodes under friction at each instant, shape (k + 1, n + 1); see `FrictionLaw`.
        tension: greatest of all segments at each instant, 0 at the first, shape (k + 1,) [N].
        needle_force: of the thread upon the needle, 0 at the first instant, shape (k + 1, 2) [N].
        converged: whether every step ended where the barriers themselves hold.
        problem: why the forecast ends before its horizon; empty if it does not.
        shapes: names of the scene's shapes, then "wall".
        scene_version: of the scene; empty where there is none.
        record: of compiled code, of at least as many steps.
    """

    stamp: float
    times: NDArray[np.float64]
    vertices: NDArray[np.float64]
    tails: Points
    headings: Points
    commanded: Points
    filtered: Points
    slowdown: NDArray[np.float64]
    margins: dict[str, NDArray[np.float64]]
    friction: NDArray[np.bool_]
    tension: NDArray[np.float64]
    needle_force: Points
    converged: bool
    problem: str
    shapes: tuple[str, ...]
    scene_version: str
    record: RolloutRecord = field(repr=False)

    @property
    def horizon(self) -> float:
        """Time that is covered [s]."""
        return float(self.times[-1])

    @cached_property
    def minima(self) -> dict[str, ForecastMargin]:
        """The least margin of each kind over the horizon, by the kind's name."""
        return {name: self._minimum(kind, name) for kind, name in enumerate(KINDS)}

    def _minimum(self, kind: int, name: str) -> ForecastMargin:
        at = int(self.margins[name].argmin())
        value, shape = float(self.margins[name][at]), int(self.record.shape[at, kind])
        named = np.isfinite(value) and (kind in (OBSTACLE_MARGIN, NEEDLE_MARGIN) or name == WALL_NAME)
        return ForecastMargin(
            value, float(self.times[at]), int(self.record.node[at, kind]), self.shapes[shape] if named else ""
        )

    @cached_property
    def friction_nodes(self) -> tuple[int, ...]:
        """Nodes that are under friction at any time, rising."""
        return tuple(np.flatnonzero(self.friction.any(axis=0)).tolist())

    @cached_property
    def first_friction(self) -> float | None:
        """When the first node is under friction [s]; None if none is."""
        found = np.flatnonzero(self.friction.any(axis=1))
        return float(self.times[found[0]]) if len(found) else None

    @property
    def peak_tension(self) -> float:
        """The greatest tension of all segments and instants [N]."""
        return float(self.tension.max())

    @property
    def peak_needle_force(self) -> float:
        """The greatest pull of the thread upon the needle [N]."""
        return float(np.hypot(self.needle_force[:, 0], self.needle_force[:, 1]).max())

    @cached_property
    def first_contact(self) -> ForecastContact | None:
        """When the thread first touches a shape or the wall, and which; None if it does not."""
        contact = self.record.contact[: len(self.times)]
        found = np.flatnonzero(contact[:, 0] != NO_CONTACT)
        if not len(found):
            return None
        at = int(found[0])
        return ForecastContact(float(self.times[at]), int(contact[at, 1]), self.shapes[int(contact[at, 0])])

    @cached_property
    def rest_time(self) -> float | None:
        """When the needle comes to rest, to stay so until the end although it is commanded to move [s]; else None."""
        rests = (self.filtered == 0.0).all(axis=1) & (self.commanded != 0.0).any(axis=1)
        moves = np.flatnonzero(~rests)
        first = int(moves[-1]) + 1 if len(moves) else 0
        return float(self.times[first]) if first < len(rests) else None

    @property
    def stopped_by(self) -> tuple[str, ...]:
        """Names of the shapes, and "wall", at which it comes to rest; empty if it does not."""
        if self.rest_time is None:
            return ()
        touched = self.record.touched[len(self.filtered) - 1]
        return tuple(name for name, active in zip(self.shapes, touched.tolist(), strict=True) if active)
