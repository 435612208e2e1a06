"""What goes into a predictor and comes out: the needle's stamped pose, and the thread at one instant."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from magnetosuture_thread.geometry.needle_arc import MAX_NORM_ERROR
from magnetosuture_thread.geometry.polyline import Points, Vector, as_numbers
from magnetosuture_thread.settings.configuration import Quantity, plain
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.thread.margins import Margins
from magnetosuture_thread.thread.mechanics import ThreadForces

MAX_COORDINATE = 1.0  # m; nothing that a dish could hold is farther away
TIME = Quantity("", "s")
STARTED = "started"  # status of a prediction that no step led to


class NeedleMotion(NamedTuple):
    """The needle's motion at a pose.

    Attributes:
        velocity: of its tail, shape (d,) [m/s].
        turning: rate at which its heading turns, counter-clockwise, in the plane [rad/s].
    """

    velocity: Vector
    turning: float


@dataclass(frozen=True)
class NeedlePose:
    """The needle at one instant, in the dish frame.

    Attributes:
        stamp: [s]
        tail: the blunt end, where the thread is attached, shape (d,) [m].
        heading: unit vector from tail to tip, shape (d,); made so where it is one to `MAX_NORM_ERROR`.
        deviation: standard deviations of the tail in each direction [m] and of the heading [rad]; zeros if not known.
        motion: of the needle, for the forces; None if only the poses tell.
    """

    stamp: float
    tail: Points
    heading: Points
    deviation: tuple[float, float] = (0.0, 0.0)
    motion: NeedleMotion | None = None

    def __post_init__(self) -> None:
        """Take sequences of numbers as arrays, and numbers of other types as floats."""
        object.__setattr__(self, "stamp", plain(self.stamp))
        object.__setattr__(self, "tail", as_numbers("needle pose tail", self.tail))
        heading = as_numbers("needle pose heading", self.heading)
        error = abs(math.hypot(*heading.ravel().tolist()) - 1.0)
        if 1e-9 < error <= MAX_NORM_ERROR:  # not that of rounding: a heading that is given on stays as it is
            heading = heading / np.linalg.norm(heading)
        object.__setattr__(self, "heading", heading)


@dataclass(eq=False)
class Prediction:
    """The thread at one instant. Not to be written to.

    Attributes:
        stamp: [s]
        formulation: name of the formulation.
        scene_version: of the scene that it was predicted in; empty where the model knows none.
        positions: of all nodes, shape (n + 1, d) [m].
        strain: each segment's length from end to end over what it should be, less one, shape (n,).
        interval: time since the previous prediction [s].
        substeps: number of steps it was divided into.
        solver: the solver's name.
        status: the solver's own word; where one did not solve at once, what had to be tried.
        residual: the largest scaled residual of the solves.
        converged: whether every step ended where the barriers themselves hold, not only their linearisations;
            if not, the margins are those of a thread that is not where the equations say.
        compute_margins: of this prediction.
        compute_forces: of this prediction.
    """

    stamp: float
    formulation: str
    scene_version: str
    positions: Points
    strain: Vector
    interval: float
    substeps: int
    solver: str
    status: str
    residual: float
    converged: bool
    compute_margins: Callable[[], Margins] = field(repr=False)
    compute_forces: Callable[[], ThreadForces | None] = field(default=lambda: None, repr=False)

    @cached_property
    def margins(self) -> Margins:
        """The margins of every barrier by its name, in SI units; computed at first access."""
        return self.compute_margins()

    @cached_property
    def forces(self) -> ThreadForces | None:
        """Tension, contact forces and the thread's pull on the needle; computed at first access.

        None before the first step, and with a formulation that is of no mechanics.
        """
        return self.compute_forces()

    def __getstate__(self) -> dict[str, Any]:
        """Return everything computed, for `copy` and `pickle`: what computes it belongs to the predictor."""
        margins, forces = self.margins, self.forces
        return {**self.__dict__, "compute_margins": None, "compute_forces": None, "margins": margins, "forces": forces}

    @property
    def tension(self) -> Vector | None:
        """Tension of each segment, shape (n,) [N]; None where there are no `forces`."""
        return None if self.forces is None else self.forces.tension


def check_pose(pose: NeedlePose, reach: float = MAX_COORDINATE, dimension: int = 2) -> None:
    """Raise `InvalidInputError` unless a pose can be one: finite, its tail within reach, its heading a unit vector.

    Args:
        pose: of the needle.
        reach: greatest distance of its tail from the dish's centre [m].
        dimension: of the space that it is in.
    """
    # In plain floats: for two or three of them numpy takes ten times as long, in every step.
    if not TIME.within(pose.stamp):
        raise InvalidInputError("needle pose stamp", pose.stamp, "a finite time [s]")
    if not pose.tail.shape == pose.heading.shape == (dimension,):
        shapes = f"tail and heading of shapes {pose.tail.shape} and {pose.heading.shape}"
        remedy = "; in space, with a Workspace of dimension=3 for the scene" if dimension == 2 else ""
        raise InvalidInputError("needle pose", shapes, f"shapes ({dimension},){remedy}")
    if dimension == 3 and pose.motion is not None:
        raise InvalidInputError("needle pose motion", "one in space", "None, as it turns in the plane only")
    tail, heading = pose.tail.tolist(), pose.heading.tolist()
    if not math.hypot(*tail) <= reach:
        expected = f"finite coordinates, at most {reach:g} m from the dish's centre"
        raise InvalidInputError("needle pose position", tail, expected + Quantity("", "m", -reach, reach).hint(tail))
    try:
        first, second = map(float, pose.deviation)
    except (TypeError, ValueError):
        first = second = math.nan
    if not (0.0 <= first < math.inf and 0.0 <= second < math.inf):
        raise InvalidInputError("needle pose deviation", pose.deviation, "two finite numbers, not negative")
    if not abs((size := math.hypot(*heading)) - 1.0) <= MAX_NORM_ERROR:
        raise InvalidInputError("needle pose heading", f"{heading}, norm {size:g}", "a unit vector")
