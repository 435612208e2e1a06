"""Settings of the friction by which a thread holds the needle back."""

from __future__ import annotations

from dataclasses import dataclass

from magnetosuture_thread.configuration import Configuration, quantity
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.model.friction import FrictionLaw, NodeMotion


@dataclass(frozen=True)
class FrictionSettings(Configuration):
    """What the thread model must know to tell where the thread is under friction."""

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

    def check_friction(self, group: str, margin_range: float) -> None:
        """Refuse a threshold that the barriers do not reach.

        Args:
            group: section of the settings, for the error.
            margin_range: greatest distance at which a node and an obstacle have a barrier [m].
        """
        if self.friction_threshold > margin_range:
            expected = f"at most {group}.margin_range, {margin_range:g} m"
            raise ConfigurationError(f"{group}.friction_threshold", self.friction_threshold, expected)

    def friction_law(self) -> FrictionLaw:
        """Return what tells friction."""
        return FrictionLaw(self.friction_threshold, self.friction_slowdown, self.resting_speed)

    def node_motion(self) -> NodeMotion:
        """Return what follows the nodes' velocities."""
        return NodeMotion(self.friction_averaging)
