"""Settings of the coil bridge."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from magnetosuture_thread.configuration import Configuration, quantity
from magnetosuture_thread.errors import ConfigurationError


@dataclass(frozen=True)
class CoilBridgeSettings(Configuration):
    """What the coil bridge must know of the coils and of the limits on the needle."""

    GROUP: ClassVar[str] = "coil_bridge"

    driver: str = quantity(
        "recording", "what the currents go to; recording stands in without hardware", choices=("recording",)
    )
    rate: float = quantity(100.0, "how often the watchdog runs", unit="Hz", minimum=10.0, maximum=1000.0)
    command_timeout: float = quantity(
        0.1, "without a new velocity command for this long the coils go to zero", unit="s", minimum=0.01, maximum=1.0
    )
    zero_hold: float = quantity(
        1.0, "after a stop, zero currents are sent for this long", unit="s", minimum=0.1, maximum=60.0
    )
    max_speed: float = quantity(0.02, "greatest needle speed", unit="m/s", minimum=1e-5, maximum=0.5)
    max_current: float = quantity(5.0, "greatest current in a coil", unit="A", minimum=0.01, maximum=100.0)
    velocity_per_current: float = quantity(
        0.005,
        "needle speed towards a coil for each ampere in it, at the dish's centre",
        unit="m/(s A)",
        minimum=1e-6,
        maximum=1.0,
    )
    coil_angles: tuple[float, ...] = quantity(
        (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi),
        "direction of each coil from the dish's centre, against the x axis",
        unit="rad",
        minimum=-2.0 * math.pi,
        maximum=2.0 * math.pi,
    )

    def check(self) -> None:
        """Refuse fewer than three coils: they could not pull in every direction."""
        if len(self.coil_angles) < 3:
            name = f"{self.GROUP}.coil_angles"
            raise ConfigurationError(name, list(self.coil_angles), "at least 3 coils' angles [rad]")
