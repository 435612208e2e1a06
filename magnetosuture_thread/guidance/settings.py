"""Settings of the path follower."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from magnetosuture_thread.configuration import Configuration, autostart_parameter, quantity
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.needle_arc import check_needle
from magnetosuture_thread.guidance.follower import PathFollower
from magnetosuture_thread.scene import WALL_NAME, Scene, find_collision
from magnetosuture_thread.shared_parameters import shared_parameter


@dataclass(frozen=True)
class PathFollowerSettings(Configuration):
    """Path of the needle's tip, its speed and the controller gains."""

    GROUP: ClassVar[str] = "path_follower"

    autostart: str = autostart_parameter()
    waypoints: tuple[float, ...] = quantity(
        (),
        "waypoints of the tip after its initial position: x and y of each, in the dish frame",
        unit="m",
        minimum=-0.5,
        maximum=0.5,
        multiple=2,
    )
    speed: float = quantity(0.005, "of the tip along the path", unit="m/s", minimum=1e-5, maximum=0.1)
    acceleration: float = quantity(0.01, "at both ends of the path", unit="m/s^2", minimum=1e-4, maximum=10.0)
    gain: float = quantity(8.0, "proportional gain on the tip's position error", unit="1/s", minimum=0.0, maximum=50.0)
    integral_gain: float = quantity(
        4.0, "integral gain on the tip's position error", unit="1/s^2", minimum=0.0, maximum=50.0
    )
    tolerance: float = quantity(
        0.0005, "the path is done when the tip is this close to its end", unit="m", minimum=1e-5, maximum=0.1
    )
    settle: float = quantity(
        1.5,
        "between the first pose and the start, for node discovery and for the thread to come to rest",
        unit="s",
        minimum=0.0,
        maximum=60.0,
    )
    pose_timeout: float = quantity(
        0.5, "a needle pose that is older on arrival gives no command", unit="s", minimum=0.05, maximum=5.0
    )
    audience: int = quantity(
        1, "subscribers to its commands that it waits for: the bridge, and any recorder", minimum=1, maximum=100
    )
    max_lag: float = quantity(
        0.002,
        "maximum distance from the tip to its setpoint while the setpoint moves",
        unit="m",
        minimum=1e-5,
        maximum=0.1,
    )
    scene: str = shared_parameter("scene")
    needle_length: float = shared_parameter("needle_length")
    needle_curvature: float = shared_parameter("needle_curvature")

    def check(self) -> None:
        """Reject a coiled needle."""
        check_needle(self.GROUP, self.needle_length, self.needle_curvature)

    def check_path(self, scene: Scene) -> None:
        """Reject a waypoint beyond the wall or inside a shape.

        Raises:
            ConfigurationError: the message names the waypoint and the shape.
        """
        for point in np.reshape(self.waypoints, (-1, 2)):
            what = find_collision(scene, point[None])
            if what:
                within = f"within the dish, {scene.dish.radius:g} m"
                expected = within if what == WALL_NAME else f"a point outside of {what}"
                raise ConfigurationError(f"{self.GROUP}.waypoints", point.tolist(), expected)

    def follower(self) -> PathFollower:
        """Return a controller for this path."""
        return PathFollower(
            np.reshape(self.waypoints, (-1, 2)),
            self.speed,
            self.acceleration,
            self.gain,
            self.integral_gain,
            self.max_lag,
            self.tolerance,
            self.settle,
            self.needle_length,
            self.needle_curvature,
        )
