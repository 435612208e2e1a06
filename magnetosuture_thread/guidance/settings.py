"""Settings of the path follower."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from magnetosuture_thread.configuration import Configuration, quantity
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.needle_arc import check_needle
from magnetosuture_thread.guidance.follower import PathFollower
from magnetosuture_thread.scene import WALL_NAME, Scene, find_collision
from magnetosuture_thread.shared_parameters import shared_parameter


@dataclass(frozen=True)
class PathFollowerSettings(Configuration):
    """Where the needle's tip is to go, and how fast."""

    GROUP: ClassVar[str] = "path_follower"

    waypoints: tuple[float, ...] = quantity(
        (),
        "where the tip goes from where it is: x and y of each point, in the dish frame",
        unit="m",
        minimum=-0.5,
        maximum=0.5,
        multiple=2,
    )
    speed: float = quantity(0.005, "of the tip along the path", unit="m/s", minimum=1e-5, maximum=0.1)
    acceleration: float = quantity(0.01, "at both ends of the path", unit="m/s^2", minimum=1e-4, maximum=10.0)
    gain: float = quantity(
        8.0, "how fast a distance from the path is made up for", unit="1/s", minimum=0.0, maximum=50.0
    )
    integral_gain: float = quantity(4.0, "how fast a lasting distance is", unit="1/s^2", minimum=0.0, maximum=50.0)
    tolerance: float = quantity(
        0.0005, "the path is done when the tip is this near to its end", unit="m", minimum=1e-5, maximum=0.1
    )
    settle: float = quantity(
        1.5,
        "between the first pose and the start, for all nodes to have found each other and the thread to rest",
        unit="s",
        minimum=0.0,
        maximum=60.0,
    )
    audience: int = quantity(
        1, "subscribers to its commands that it waits for: the bridge, and whoever records", minimum=1, maximum=100
    )
    longest_lag: float = quantity(
        0.002, "the wish waits while the tip is farther from it", unit="m", minimum=1e-5, maximum=0.1
    )
    scene: str = shared_parameter("scene")
    needle_length: float = shared_parameter("needle_length")
    needle_curvature: float = shared_parameter("needle_curvature")

    def check(self) -> None:
        """Refuse a coiled needle."""
        check_needle(self.GROUP, self.needle_length, self.needle_curvature)

    def check_path(self, scene: Scene) -> None:
        """Refuse a waypoint beyond the wall or inside of a shape.

        Raises:
            ConfigurationError: the message names the waypoint and what is there.
        """
        for point in np.reshape(self.waypoints, (-1, 2)):
            what = find_collision(scene, point[None])
            if what:
                within = f"within the dish, {scene.dish.radius:g} m"
                expected = within if what == WALL_NAME else f"a point outside of {what}"
                raise ConfigurationError(f"{self.GROUP}.waypoints", point.tolist(), expected)

    def follower(self) -> PathFollower:
        """Return a follower of this path."""
        return PathFollower(
            np.reshape(self.waypoints, (-1, 2)),
            self.speed,
            self.acceleration,
            self.gain,
            self.integral_gain,
            self.longest_lag,
            self.tolerance,
            self.settle,
            self.needle_length,
            self.needle_curvature,
        )
