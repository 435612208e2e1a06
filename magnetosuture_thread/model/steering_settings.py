"""Settings of how the thread holds the needle back: friction, and the needle's own barriers."""

from __future__ import annotations

from dataclasses import dataclass

from magnetosuture_thread.configuration import Configuration, quantity
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.arc import require_needle
from magnetosuture_thread.geometry.obstacles import Surroundings
from magnetosuture_thread.model.friction import FrictionLaw, NodeMotion
from magnetosuture_thread.model.needle import NeedleFilter
from magnetosuture_thread.model.program import Solver


@dataclass(frozen=True)
class SteeringSettings(Configuration):
    """What the thread model must know to filter the velocity that an operator asks of the needle."""

    friction_threshold: float = quantity(
        5e-4, "a node this close to two obstacles is under friction", unit="m", minimum=0.0, maximum=0.1
    )
    friction_slowdown: float = quantity(
        0.9, "beta: each node under friction slows the needle by this factor", minimum=0.01, maximum=1.0
    )
    resting_speed: float = quantity(
        2e-4,
        "a thread under friction whose nodes there are not faster rests, and slows nothing",
        unit="m/s",
        minimum=0.0,
        maximum=1.0,
    )
    friction_averaging: float = quantity(
        0.2,
        "time over which the nodes' velocities are averaged for that, as tracked poses tremble",
        unit="s",
        minimum=0.0,
        maximum=10.0,
    )
    needle_length: float = quantity(
        0.007,
        "of the needle that an operator steers by its tip; 0: the needle is the point where the thread begins",
        unit="m",
        minimum=0.0,
        maximum=0.05,
    )
    needle_curvature: float = quantity(
        0.0, "of the needle's arc, positive to the left of its heading", unit="1/m", minimum=-1000.0, maximum=1000.0
    )
    needle_clearance: float = quantity(
        5e-4,
        "clearance that the steered needle's axis keeps of obstacles; half of its width is within",
        unit="m",
        minimum=0.0,
        maximum=0.05,
    )
    needle_approach_rate: float = quantity(
        10.0,
        "share of its clearance by which the steered needle may approach, each second",
        unit="1/s",
        minimum=0.1,
        maximum=1e3,
    )
    steering_timeout: float = quantity(
        0.2,
        "without a predicted thread for this long a steered needle is told to rest",
        unit="s",
        minimum=0.01,
        maximum=5.0,
    )

    def check_steering(self, group: str, margin_range: float) -> None:
        """Refuse a coiled needle, and distances that the barriers do not reach.

        Args:
            group: section of the settings, for the error.
            margin_range: greatest distance at which a node and an obstacle have a barrier [m].
        """
        if self.needle_length:
            require_needle(group, self.needle_length, self.needle_curvature)
        for name in ("friction_threshold", "needle_clearance"):
            if getattr(self, name) > margin_range:
                expected = f"at most {group}.margin_range, {margin_range:g} m"
                raise ConfigurationError(f"{group}.{name}", getattr(self, name), expected)

    def friction_law(self) -> FrictionLaw:
        """Return what tells friction."""
        return FrictionLaw(self.friction_threshold, self.friction_slowdown, self.resting_speed)

    def node_motion(self) -> NodeMotion:
        """Return what follows the nodes' velocities."""
        return NodeMotion(self.friction_averaging)

    def filter_among(self, surroundings: Surroundings, solver: Solver) -> NeedleFilter:
        """Return the steered needle's own barriers.

        Args:
            surroundings: the obstacles.
            solver: of the filter's program.
        """
        return NeedleFilter(
            surroundings,
            self.needle_clearance,
            self.needle_approach_rate,
            solver,
            length=self.needle_length,
            curvature=self.needle_curvature,
        )
