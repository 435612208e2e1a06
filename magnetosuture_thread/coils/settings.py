"""Settings of the coil bridge."""

from __future__ import annotations

import math
import os.path
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

from magnetosuture_thread.coils.allocation import CoilAllocation, NeedleMechanics
from magnetosuture_thread.coils.calibration import CoilCalibration, read_calibration
from magnetosuture_thread.coils.field import CoilProperties, coils_around, make_coils
from magnetosuture_thread.configuration import Configuration, quantity
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.needle_arc import check_needle
from magnetosuture_thread.safety import NeedleSafetyFilter
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.shared_parameters import shared_parameter

INSIDE = 0.9  # of the distance to the coils
FEWEST = 4.0  # periods of the loop in a timeout; two of them are given away so that no current outlives it
FEWEST_HELD = 2.0  # periods of the loop in the drivers' timeout, or they would switch off between two steps
MAX_BLIND_WAY = 0.0125  # m; that the needle could go while nobody looks, was there nothing in its way


@dataclass(frozen=True)
class CoilBridgeSettings(Configuration):
    """What the coil bridge must know of the coils and of the limits on the needle."""

    GROUP: ClassVar[str] = "coil_bridge"

    autostart: str = quantity(
        "active",
        "how far the node goes by itself when it starts; armed only with a driver that moves nothing real",
        choices=("unconfigured", "inactive", "active", "armed"),
    )
    driver: str = quantity(
        "recording",
        "what the currents go to: recording keeps them, simulated sends them to rig_simulator, roboclaw is hardware",
        choices=("recording", "simulated", "roboclaw"),
    )
    rate: float = quantity(
        200.0, "how often limits and watchdog run and currents go out", unit="Hz", minimum=10.0, maximum=1000.0
    )
    realtime_priority: int = quantity(
        10,
        "of the process among the real-time ones, where the system allows any; 0 asks for none",
        minimum=0,
        maximum=99,
    )
    command_timeout: float = quantity(
        0.1, "without a new velocity command for this long the coils go to zero", unit="s", minimum=0.01, maximum=1.0
    )
    pose_timeout: float = quantity(
        0.2,
        "without a new needle pose for this long the coils go to zero: currents depend on where the needle is",
        unit="s",
        minimum=0.01,
        maximum=1.0,
    )
    zero_hold: float = quantity(
        1.0, "after a stop, zero currents are published for this long", unit="s", minimum=0.1, maximum=60.0
    )
    max_speed: float = quantity(0.02, "greatest speed of the needle's tip", unit="m/s", minimum=1e-5, maximum=0.5)
    max_acceleration: float = quantity(
        0.5, "greatest change of that velocity; a stop is not limited", unit="m/s^2", minimum=1e-3, maximum=100.0
    )
    max_current: float = quantity(
        10.0, "greatest current in a coil, in either direction", unit="A", minimum=0.01, maximum=100.0
    )
    max_current_slew: float = quantity(
        1000.0, "greatest change of a coil's current; a stop is not limited", unit="A/s", minimum=1.0, maximum=1e6
    )

    scene: str = shared_parameter("scene")
    keep_out: float = quantity(
        0.0005,
        "clearance that the needle's axis keeps of the wall and of obstacles; half of its width is within",
        unit="m",
        minimum=2.5e-5,
        maximum=0.05,
    )
    approach_rate: float = quantity(
        10.0,
        "share of its clearance by which the needle may approach, each second",
        unit="1/s",
        minimum=0.1,
        maximum=1e3,
    )
    pose_uncertainty: float = quantity(
        0.0005,
        "by how much tail and tip may be measured outside of the dish or farther on than the needle can go, besides "
        "three sigma of the pose's own covariance",
        unit="m",
        minimum=0.0,
        maximum=0.01,
    )
    prediction_timeout: float = quantity(
        0.5, "margins of the thread model are good for this long", unit="s", minimum=0.05, maximum=5.0
    )
    without_prediction: str = quantity(
        "stop",
        "what becomes of the needle while the thread is not predicted: stop, or slow, to speed_without_prediction",
        choices=("stop", "slow"),
    )
    speed_without_prediction: float = quantity(
        0.002, "greatest speed of the needle's tip then", unit="m/s", minimum=1e-5, maximum=0.5
    )

    calibration: str = quantity(
        "",
        "file of the coils' calibration, from the working directory; it replaces what the parameters say of the coils",
    )
    coil_model: str = quantity(
        "loops", "field of a coil: that of a loop, or of a dipole in its middle", choices=("loops", "dipoles")
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
    needle_length: float = shared_parameter("needle_length")
    needle_width: float = shared_parameter("needle_width")
    needle_curvature: float = shared_parameter("needle_curvature")
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

    coil_resistance: float = quantity(
        1.0,
        "of a coil with its cable, cold; for boards that set a duty cycle",
        unit="ohm",
        minimum=0.01,
        maximum=1000.0,
    )
    roboclaw_ports: tuple[str, ...] = quantity((), "serial port of each board, which has two coils in a row")
    roboclaw_addresses: tuple[int, ...] = quantity((), "address of each board, 128 if empty", minimum=128, maximum=135)
    roboclaw_baud_rate: int = quantity(115200, "of the serial lines; USB has none", minimum=2400, maximum=1000000)
    driver_timeout: float = shared_parameter("driver_timeout")
    roboclaw_answer_timeout: float = quantity(
        0.03,
        "that a board has for an answer, of which it needs 1 or 2 ms over USB; it may miss one",
        unit="s",
        minimum=0.03,
        maximum=1.0,
    )

    @property
    def reach(self) -> float:
        """How far from the dish's centre a needle may be: well within the coils [m]."""
        return INSIDE * min(coil.distance for coil in self.coils_properties())

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

    @cached_property
    def _calibration(self) -> CoilCalibration | None:
        """What the calibration file says, read once; None without one."""
        if not self.calibration:
            return None
        try:
            return read_calibration(Path(os.path.expanduser(self.calibration)))
        except ConfigurationError as error:
            # What reads the set-up puts its own file's name in front.
            name = f"{self.GROUP}.calibration, {error.source}: {error.name}"
            raise ConfigurationError(name, error.value, error.expectation) from None

    def coils_properties(self) -> tuple[CoilProperties, ...]:
        """Return the coils, in the order of their currents: as calibrated, else as the parameters have them."""
        if self._calibration is not None:
            return self._calibration.coils
        return coils_around(self.coil_angles, self.coil_distance, self.coil_radius, self.field_per_current)

    def resistances(self) -> tuple[float, ...]:
        """Return each coil's resistance with its cable, as calibrated where that is known [ohm]."""
        return tuple(coil.resistance or self.coil_resistance for coil in self.coils_properties())

    def allocation(self) -> CoilAllocation:
        """Return what turns velocities into currents."""
        model = self.coil_model if self._calibration is None else self._calibration.model
        coils = make_coils(model, self.coils_properties())
        return CoilAllocation(coils, self.needle(), self.aligning_field, self.max_current)

    @property
    def hold_time(self) -> float:
        """For how long a velocity may go on without anybody looking: until the drivers switch off, and a period [s]."""
        return self.driver_timeout + 1.0 / self.rate

    def safety_filter(self, scene: Scene) -> NeedleSafetyFilter:
        """Return what keeps the needle clear of the wall and of the shapes of a scene.

        Raises:
            ConfigurationError: the needle has no room in it.
        """
        return NeedleSafetyFilter(
            scene,
            keep_out=self.keep_out,
            approach_rate=self.approach_rate,
            hold_time=self.hold_time,
            max_speed=self.max_speed,
            max_acceleration=self.max_acceleration,
            needle_length=self.needle_length,
            needle_curvature=self.needle_curvature,
        )

    def check(self) -> None:
        """Refuse too few coils, a coiled needle, and limits that cannot hold."""
        check_needle(self.GROUP, self.needle_length, self.needle_curvature)
        if len(self.coil_angles) < 3:
            name = f"{self.GROUP}.coil_angles"
            raise ConfigurationError(name, list(self.coil_angles), "at least 3 coils' angles [rad]")
        if self._calibration is not None:
            count, known = len(self._calibration.coils), len(self.coil_angles)
            if count != known:
                name = f"{self.GROUP}.calibration"
                raise ConfigurationError(name, f"{count} coils in {self.calibration}", f"{known}, as in coil_angles")
        if self.autostart == "armed" and self.driver == "roboclaw":
            name = f"{self.GROUP}.autostart"
            raise ConfigurationError(name, self.autostart, "active at most: hardware is armed by a person")
        if self.keep_out < 0.5 * self.needle_width:
            expected = f"at least {0.5 * self.needle_width:g} m, half of {self.GROUP}.needle_width"
            raise ConfigurationError(f"{self.GROUP}.keep_out", self.keep_out, expected)
        for name in ("command_timeout", "pose_timeout"):
            if getattr(self, name) * self.rate < FEWEST:
                expected = f"at least {FEWEST / self.rate:g} s, {FEWEST:g} periods of the loop"
                raise ConfigurationError(f"{self.GROUP}.{name}", getattr(self, name), expected)
        if self.driver_timeout * self.rate < FEWEST_HELD * (1.0 - 1e-9):
            expected = f"at least {FEWEST_HELD / self.rate:g} s, {FEWEST_HELD:g} periods of the loop"
            raise ConfigurationError(f"{self.GROUP}.driver_timeout", self.driver_timeout, expected)
        if self.max_speed * self.hold_time > MAX_BLIND_WAY * (1.0 + 1e-9):
            most = MAX_BLIND_WAY / self.hold_time
            rule = f"max_speed x (driver_timeout + 1 / rate) may be at most {MAX_BLIND_WAY:g} m"
            raise ConfigurationError(f"{self.GROUP}.max_speed", self.max_speed, f"at most {most:.3g} m/s: {rule}")
        # One step may not take more than all that is left of the clearance.
        if self.approach_rate > self.rate:
            name = f"{self.GROUP}.approach_rate"
            raise ConfigurationError(name, self.approach_rate, f"at most {self.GROUP}.rate, {self.rate:g} 1/s")
