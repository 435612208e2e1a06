"""Settings of the coil bridge."""

from __future__ import annotations

import hashlib
import math
import os.path
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

from magnetosuture_thread.coils.allocation import (
    MIN_ALIGNING_SHARE,
    CoilAllocation,
    NeedleMechanics,
)
from magnetosuture_thread.coils.calibration import CoilCalibration, read_calibration
from magnetosuture_thread.coils.field import CoilProperties, LoopCoils, coils_around
from magnetosuture_thread.coils.filter import NeedleSafetyFilter
from magnetosuture_thread.coils.heading_observer import HeadingObserver
from magnetosuture_thread.geometry.barrier import load_barriers
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.settings import shared_parameters as shared
from magnetosuture_thread.settings.configuration import quantity
from magnetosuture_thread.settings.errors import ConfigurationError

# Of the loop: two of the first four are the lookahead of the bridge; drivers would switch off between two steps.
MIN_TIMEOUT_PERIODS = {"command_timeout": 4.0, "pose_timeout": 4.0, "driver_timeout": 2.0 * (1.0 - 1e-9)}
MAX_THREAD_SHARE = 0.9  # of needle_drag, where the motion is compensated
MAX_BLIND_DISTANCE = 0.0125  # m; maximum distance of free motion within the hold time


@dataclass(frozen=True)
class CoilBridgeSettings(
    shared.SceneName, shared.CommandFilter, shared.NeedleArc, shared.NeedleWidth, shared.CoilDrivers
):
    """Parameters of the coil bridge: coils, needle, limits, timeouts and driver."""

    GROUP: ClassVar[str] = "coil_bridge"

    autostart: str = quantity(
        "active",
        "state that the node enters by itself at start; armed only with a driver that is known to move nothing",
        choices=("unconfigured", "inactive", "active", "armed"),
    )
    commissioning: bool = quantity(
        False, "whether pulses of the coils are given, for commission, and no velocity command is followed"
    )
    stop_file: str = quantity(
        "",
        "file that keeps the emergency stop over a restart, one for each bridge; empty: a name of its own in "
        "$XDG_STATE_HOME/magnetosuture or ~/.local/state/magnetosuture",
    )
    driver: str = quantity(
        "recording",
        "sink of the currents: recording keeps them, simulated sends them to rig_simulator, roboclaw is hardware",
        choices=("recording", "simulated", "roboclaw"),
    )
    rate: float = quantity(
        200.0, "of the loop that checks limits and timeouts and sends currents", unit="Hz", minimum=10.0, maximum=1000.0
    )
    realtime_priority: int = quantity(
        10, "real-time priority of the process, where permitted; 0 for none", minimum=0, maximum=99
    )
    command_timeout: float = quantity(
        0.1, "the coils go to zero after this long without a new velocity command", unit="s", minimum=0.01, maximum=1.0
    )
    pose_timeout: float = quantity(
        0.2, "the coils go to zero after this long without a new needle pose", unit="s", minimum=0.01, maximum=1.0
    )
    zero_hold: float = quantity(
        1.0, "after a stop, zero currents are published for this long", unit="s", minimum=0.1, maximum=60.0
    )
    max_speed: float = quantity(0.02, "maximum speed of the needle's ends", unit="m/s", minimum=1e-5, maximum=0.5)
    max_acceleration: float = quantity(
        0.5,
        "maximum acceleration of a tip whose velocity is commanded; a stop is not limited",
        unit="m/s^2",
        minimum=1e-3,
        maximum=100.0,
    )
    max_current: float = quantity(
        10.0, "maximum current in a coil, in either direction", unit="A", minimum=0.01, maximum=100.0
    )
    max_current_slew: float = quantity(
        1000.0, "maximum slew rate of a current; a stop is not limited", unit="A/s", minimum=1.0, maximum=1e6
    )

    barriers: tuple[str, ...] = quantity((), "barriers of your own for the needle, each as module:class; see Barrier")
    approach_rate: float = quantity(
        10.0,
        "gain of the needle's barriers: fraction of the clearance by which it may approach per second",
        unit="1/s",
        minimum=0.1,
        maximum=1e3,
    )
    pose_uncertainty: float = quantity(
        0.0005,
        "error of tail and tip in the checks of bounds and jumps, in addition to three sigma of the pose's covariance",
        unit="m",
        minimum=0.0,
        maximum=0.01,
    )
    prediction_timeout: float = quantity(
        0.5, "margins of the thread model are valid for this long", unit="s", minimum=0.05, maximum=5.0
    )
    without_prediction: str = quantity(
        "stop",
        "behaviour while the thread is not predicted: stop, or slow, to speed_without_prediction",
        choices=("stop", "slow"),
    )
    speed_without_prediction: float = quantity(
        0.002, "maximum speed of the needle's tip without a prediction", unit="m/s", minimum=1e-5, maximum=0.5
    )

    calibration: str = quantity(
        "", "file of the coils' calibration, from the working directory; it replaces the coil parameters"
    )
    field_per_current: float = quantity(
        1.2e-3, "field of one coil at the dish's centre, for each ampere in it", unit="T/A", minimum=1e-6, maximum=1.0
    )
    coil_distance: float = quantity(
        0.05, "from the dish's centre to the middle of a coil", unit="m", minimum=0.01, maximum=1.0
    )
    coil_radius: float = quantity(0.025, "mean radius of a coil's windings", unit="m", minimum=0.002, maximum=0.5)
    aligning_field: float = quantity(
        0.008,
        "field along the needle that holds its direction; a strong one also pulls it, off a weak one a thread turns it",
        unit="T",
        minimum=1e-4,
        maximum=1.0,
    )
    needle_moment: float = quantity(
        8.8e-4, "magnetic moment of the straight needle", unit="A m^2", minimum=1e-6, maximum=1.0
    )
    needle_drag: float = quantity(
        0.0255, "drag along the needle at 1 m/s, the thread's included", unit="N s/m", minimum=1e-5, maximum=10.0
    )
    needle_drag_across: float = quantity(
        0.033, "drag across the needle at 1 m/s", unit="N s/m", minimum=1e-5, maximum=10.0
    )
    thread_drag: float = quantity(
        0.0,
        "part of needle_drag that a straight thread behind the needle adds; a slack thread adds nothing",
        unit="N s/m",
        minimum=0.0,
        maximum=10.0,
    )
    max_pull: float = quantity(
        1e-4,
        "greatest force of the thread upon the needle that motion_compensation holds against, whatever poses show",
        unit="N",
        minimum=1e-8,
        maximum=0.1,
    )
    motion_compensation: bool = quantity(
        False, "whether the coils compensate what the needle's poses show of its motion beside the commanded one"
    )
    motion_delay: float = quantity(
        0.0,
        "from a current to the motion that poses show, by their stamps, as commission measures it; of the needle's "
        "planner, and for motion_compensation, which corrects it while the needle turns",
        unit="s",
        minimum=0.0,
        maximum=0.2,
    )
    needle_turning_drag: float = quantity(
        1.6e-7, "drag torque of the needle at 1 rad/s", unit="N m s", minimum=1e-11, maximum=1e-2
    )

    coil_resistance: float = quantity(
        1.0,
        "of a coil with its cable, cold; for boards that set a duty cycle",
        unit="ohm",
        minimum=0.01,
        maximum=1000.0,
    )
    roboclaw_ports: tuple[str, ...] = quantity(
        (), "serial port of each board, which has two coils in a row, by a path under /dev/serial/by-path"
    )
    roboclaw_addresses: tuple[int, ...] = quantity(
        (),
        "address of each board, 128 if empty; different ones, unless each port has a path that stays with its plug",
        minimum=128,
        maximum=135,
    )
    roboclaw_baud_rate: int = quantity(115200, "of the serial lines; USB has none", minimum=2400, maximum=1000000)
    roboclaw_answer_timeout: float = quantity(
        0.03,
        "timeout of a board's answer, which takes 1 or 2 ms over USB; one timeout is tolerated",
        unit="s",
        minimum=0.03,
        maximum=1.0,
    )

    @property
    def reach(self) -> float:
        """Maximum distance of the needle from the dish's centre, inside the coils [m]."""
        # The coils begin at 0.9 of the nearest one's distance.
        return 0.9 * min(coil.distance for coil in self.coils_properties())

    def needle(self) -> NeedleMechanics:
        """Return the needle's mechanics.

        Where the motion is compensated, the drag is the needle's own: what a thread adds is a part of the pull that
        `MotionObserver` estimates.
        """
        drag = self.needle_drag - self.thread_drag if self.motion_compensation else self.needle_drag
        return NeedleMechanics(
            self.needle_length,
            self.needle_curvature,
            self.needle_moment,
            drag,
            self.needle_drag_across,
            self.needle_turning_drag,
            self.needle_drag - self.thread_drag,
            self.max_pull,
        )

    @cached_property
    def _calibration(self) -> CoilCalibration | None:
        """The calibration file, read once; None without one."""
        if not self.calibration:
            return None
        try:
            return read_calibration(Path(os.path.expanduser(self.calibration)))
        except ConfigurationError as error:
            # The reader of the setup prepends its own file name.
            name = f"{self.GROUP}.calibration, {error.source}: {error.name}"
            raise ConfigurationError(name, error.value, error.expectation) from None

    def coils_properties(self) -> tuple[CoilProperties, ...]:
        """Return the coils, in the order of their currents: as calibrated, else by the parameters."""
        if self._calibration is not None:
            return self._calibration.coils
        return coils_around(self.coil_angles, self.coil_distance, self.coil_radius, self.field_per_current)

    @property
    def identity(self) -> str:
        """Digits that differ between setups by which a needle moves otherwise: coils, needle, delay, boards."""
        boards = self.driver, self.roboclaw_ports, self.roboclaw_addresses, self.resistances()
        law = self.aligning_field, self.motion_compensation, self.motion_delay
        what = repr((self.coils_properties(), self.needle(), law, boards))
        return hashlib.sha256(what.encode()).hexdigest()[:16]

    def resistances(self) -> tuple[float, ...]:
        """Return each coil's resistance with its cable, as calibrated if known [ohm]."""
        return tuple(coil.resistance or self.coil_resistance for coil in self.coils_properties())

    def allocation(self) -> CoilAllocation:
        """Return the allocation of velocities to currents."""
        fixed = self.coil_field(), self.needle(), self.aligning_field, self.max_current
        return CoilAllocation(*fixed, period=1.0 / self.rate)

    def coil_field(self) -> LoopCoils:
        """Return the coils' field, as calibrated or by their geometry."""
        return LoopCoils(self.coils_properties())

    def heading_observer(self) -> HeadingObserver:
        """Return what estimates the needle's heading between its poses, and the coils' gains."""
        return HeadingObserver(self.coil_field(), self.needle(), self.aligning_field, self.motion_delay)

    @property
    def hold_time(self) -> float:
        """Maximum time for which a velocity may last without a step: driver timeout and one period [s]."""
        return self.driver_timeout + 1.0 / self.rate

    @property
    def turn_time(self) -> float:
        """Maximum time for which the needle turns on while nobody looks [s].

        The needle turns towards the field, which held currents hold. It is set ahead by the angle of a turn in the time
        in which a needle turns to its field, which the least field along it may double and more; twice that after a
        command that takes two periods to come into force. Not known, and inf, where its drift is part of its turn.
        """
        if not self.motion_compensation:
            return math.inf
        return 2.0 / self.rate + 2.0 * self.allocation().response_time / MIN_ALIGNING_SHARE

    def safety_filter(self, scene: Scene) -> NeedleSafetyFilter:
        """Return the safety filter for the wall and the shapes of a scene.

        Raises:
            ConfigurationError: the needle has no room in it, or a barrier cannot be used.
        """
        made = NeedleSafetyFilter(
            scene,
            load_barriers(self.barriers, f"{self.GROUP}.barriers"),
            keep_out=self.keep_out + self.pose_margin,
            approach_rate=self.approach_rate,
            hold_time=self.hold_time,
            max_speed=self.max_speed,
            max_acceleration=self.max_acceleration,
            needle_length=self.needle_length,
            needle_curvature=self.needle_curvature,
        )
        made.limit_turns(self.turn_time)
        return made

    def check(self) -> None:
        """Reject too few coils, and limits that cannot be kept."""
        if len(self.coil_angles) < 3:
            raise self.refused("coil_angles", "at least 3 coils' angles [rad]")
        if self._calibration is not None:
            count, known = len(self._calibration.coils), len(self.coil_angles)
            if count != known:
                name = f"{self.GROUP}.calibration"
                raise ConfigurationError(name, f"{count} coils in {self.calibration}", f"{known}, as in coil_angles")
        if self.keep_out < 0.5 * self.needle_width:
            raise self.refused("keep_out", f"at least {0.5 * self.needle_width:g} m, half of {self.GROUP}.needle_width")
        for name, periods in MIN_TIMEOUT_PERIODS.items():
            if getattr(self, name) * self.rate < periods:
                raise self.refused(name, f"at least {periods / self.rate:g} s, {periods:g} periods of the loop")
        if self.max_speed * self.hold_time > MAX_BLIND_DISTANCE * (1.0 + 1e-9):
            limit = MAX_BLIND_DISTANCE / self.hold_time
            rule = f"max_speed x (driver_timeout + 1 / rate) may be at most {MAX_BLIND_DISTANCE:g} m"
            raise self.refused("max_speed", f"at most {limit:.3g} m/s: {rule}")
        if self.motion_compensation and self.thread_drag > MAX_THREAD_SHARE * self.needle_drag:
            rule = "a needle has drag of its own, by which its motion is compensated"
            limit = MAX_THREAD_SHARE * self.needle_drag
            raise self.refused("thread_drag", f"at most {limit:g} N s/m, {MAX_THREAD_SHARE:g} of needle_drag: {rule}")
        if self.thread_drag > self.needle_drag:
            raise self.refused("thread_drag", f"at most {self.GROUP}.needle_drag, {self.needle_drag:g} N s/m")
        # One step may not use more than the whole clearance.
        if self.approach_rate > self.rate:
            raise self.refused("approach_rate", f"at most {self.GROUP}.rate, {self.rate:g} 1/s")
