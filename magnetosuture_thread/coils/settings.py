"""Settings of the coil bridge."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from magnetosuture_thread.coils.allocation import CoilAllocation, NeedleMechanics
from magnetosuture_thread.coils.field import LoopCoils
from magnetosuture_thread.configuration import Configuration, quantity
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.arc import require_needle

INSIDE = 0.9  # of the distance to the coils


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
    pose_timeout: float = quantity(
        0.2,
        "without a new needle pose for this long the coils go to zero: currents depend on where the needle is",
        unit="s",
        minimum=0.01,
        maximum=1.0,
    )
    max_current: float = quantity(
        10.0, "greatest current in a coil, in either direction", unit="A", minimum=0.01, maximum=100.0
    )
    field_per_current: float = quantity(
        1.2e-3,
        "field of one coil at the dish's centre, for each ampere in it",
        unit="T/A",
        minimum=1e-6,
        maximum=1.0,
    )
    coil_distance: float = quantity(
        0.05, "from the dish's centre to the middle of a coil", unit="m", minimum=0.01, maximum=1.0
    )
    coil_radius: float = quantity(0.025, "mean radius of a coil's windings", unit="m", minimum=0.002, maximum=0.5)
    aligning_field: float = quantity(
        0.008, "field along the needle that holds its direction", unit="T", minimum=1e-4, maximum=1.0
    )
    needle_length: float = quantity(0.007, "length of the needle along its body", unit="m", minimum=1e-3, maximum=0.05)
    needle_curvature: float = quantity(
        0.0, "of the needle's arc, positive to the left of its heading", unit="1/m", minimum=-1000.0, maximum=1000.0
    )
    needle_moment: float = quantity(
        8.8e-4, "magnetic moment of the needle, were it straight", unit="A m^2", minimum=1e-6, maximum=1.0
    )
    needle_drag: float = quantity(
        0.0255,
        "force along the needle for a speed of 1 m/s, what the thread adds to it included",
        unit="N s/m",
        minimum=1e-5,
        maximum=10.0,
    )
    needle_drag_across: float = quantity(0.033, "the same across the needle", unit="N s/m", minimum=1e-5, maximum=10.0)
    needle_turning_drag: float = quantity(
        1.6e-7, "torque that turns the needle by 1 rad/s", unit="N m s", minimum=1e-11, maximum=1e-2
    )
    coil_angles: tuple[float, ...] = quantity(
        (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi),
        "direction of each coil from the dish's centre, against the x axis",
        unit="rad",
        minimum=-2.0 * math.pi,
        maximum=2.0 * math.pi,
    )

    @property
    def reach(self) -> float:
        """How far from the dish's centre a needle may be: well within the coils [m]."""
        return INSIDE * self.coil_distance

    def needle(self) -> NeedleMechanics:
        """Return the needle's mechanics."""
        return NeedleMechanics(
            self.needle_length,
            self.needle_curvature,
            self.needle_moment,
            self.needle_drag,
            self.needle_drag_across,
            self.needle_turning_drag,
        )

    def allocation(self) -> CoilAllocation:
        """Return what turns velocities into currents."""
        coils = LoopCoils(self.coil_angles, self.coil_distance, self.coil_radius, self.field_per_current)
        return CoilAllocation(coils, self.needle(), self.aligning_field, self.max_current)

    def check(self) -> None:
        """Refuse fewer than three coils, which could not pull in every direction, and a coiled needle."""
        require_needle(self.GROUP, self.needle_length, self.needle_curvature)
        if len(self.coil_angles) < 3:
            name = f"{self.GROUP}.coil_angles"
            raise ConfigurationError(name, list(self.coil_angles), "at least 3 coils' angles [rad]")
