"""Pulses of the coils: how long and how strong they are, and all that ends them before."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from magnetosuture_thread.coils.bridge import BridgeOutput
from magnetosuture_thread.coils.drivers import DriverState
from magnetosuture_thread.coils.latch import ArmingLatch
from magnetosuture_thread.coils.pulses import IS_OVER, MotionGuard, PulseBridge, guard_reach
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.scene import Scene, SceneShape
from magnetosuture_thread.settings.errors import InvalidInputError

PERIOD, FRAME = 0.005, 1.0 / 60.0
EAST = np.array([1.0, 0.0])
PULSE = np.array([0.5, 0.0, -0.2, 0.0])


@dataclass
class Plant:
    """A bridge that commissions, under a clock; a needle that goes at a speed while currents flow, and a camera."""

    settings: CoilBridgeSettings = field(default_factory=lambda: CoilBridgeSettings(driver_timeout=0.1))
    middle: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    velocity: NDArray[np.float64] = field(default_factory=lambda: np.array([1e-3, 0.0]))
    time: float = 100.0
    driver: DriverState = field(default_factory=lambda: DriverState(True, timeout=0.1))
    poses: bool = True
    sent: int = 0
    outputs: list[BridgeOutput] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Make the bridge, armed, with a pose."""
        self.bridge = PulseBridge(self.settings, ArmingLatch(), Scene())
        self._next_pose = self.time
        self.bridge.latch.activate()
        self.bridge.arm(self.driver)
        self.run(0.1)

    def run(self, duration: float) -> list[BridgeOutput]:
        """Let time go on; return what each step asked of the coils."""
        begin = len(self.outputs)
        for _ in range(round(duration / PERIOD)):
            self.time += PERIOD
            if self.poses and self.time >= self._next_pose:
                self.pose()
            self.step()
            if self.outputs[-1].allocation.currents.any():
                self.middle = self.middle + PERIOD * self.velocity
        return self.outputs[begin:]

    def step(self) -> None:
        """Step now."""
        self.outputs.append(self.bridge.step(self.time, self.time, self.driver))

    def pose(self) -> None:
        """Measure the needle now."""
        self._next_pose, self.sent = self.time + FRAME, self.sent + 1
        tail = self.middle - 0.5 * self.settings.needle_length * EAST
        with suppress(InvalidInputError):  # as the node, which reports it
            self.bridge.on_pose(tail, EAST, self.time, self.sent, self.time, self.time)

    def pulse(self, currents: NDArray[np.float64] = PULSE, duration: float = 0.3) -> None:
        """Ask for a pulse now."""
        self.bridge.pulse(currents, duration, self.time, self.time, self.driver)


def flowing(outputs: list[BridgeOutput]) -> int:
    """Return for how many steps any current flowed."""
    return sum(bool(output.allocation.currents.any()) for output in outputs)


def test_a_pulse_gives_its_currents_for_its_time_and_then_zeros():
    plant = Plant()
    plant.pulse()
    outputs = plant.run(0.6)
    assert flowing(outputs) == round(0.3 / PERIOD)
    assert flowing(outputs[:61]) == 60  # in a row, from the next step on
    assert all(np.array_equal(output.allocation.currents, PULSE) for output in outputs[:60])
    assert outputs[60].reasons == (IS_OVER,)
    plant.pulse(-PULSE, 0.1)
    assert flowing(plant.run(0.3)) == 20


def test_the_longest_pulse_ends_by_itself_whoever_asked_for_it_is_gone():
    """As after a kill -9 or Ctrl-C of the caller: nothing more is asked, and nothing needs to be."""
    plant = Plant(velocity=np.zeros(2))
    plant.pulse(duration=0.5)
    outputs = plant.run(5.0)
    assert flowing(outputs) == 100
    assert not outputs[100].allocation.currents.any()


@pytest.mark.parametrize(
    ("currents", "duration", "named"),
    [
        (PULSE, 0.51, "coils/pulse.duration: got 0.51, expected above 0, at most 0.5 s"),
        (PULSE, 0.0, "coils/pulse.duration"),
        (PULSE, math.nan, "coils/pulse.duration"),
        (np.array([2.1, 0.0, 0.0, 0.0]), 0.1, "coils/pulse.current: .* expected 4 numbers of at most 2 A"),
        (np.array([0.0, -2.1, 0.0, 0.0]), 0.1, "coils/pulse.current"),
        (np.array([0.1, math.nan, 0.0, 0.0]), 0.1, "coils/pulse.current"),
        (np.array([0.1, 0.1, 0.1]), 0.1, "coils/pulse.current"),
    ],
)
def test_too_long_too_strong_or_no_pulse_at_all_is_refused_by_name(
    currents: NDArray[np.float64], duration: float, named: str
):
    plant = Plant(CoilBridgeSettings(max_current=2.0))
    with pytest.raises(InvalidInputError, match=named):
        plant.pulse(currents, duration)
    assert flowing(plant.run(0.5)) == 0


def test_currents_rise_within_the_slew_limit_and_fall_at_once():
    plant = Plant(CoilBridgeSettings(max_current_slew=10.0))
    plant.pulse(np.array([0.2, 0.0, 0.0, 0.0]), 0.1)
    rising = [float(output.allocation.currents[0]) for output in plant.run(0.12)]
    assert max(np.diff([0.0, *rising])) == pytest.approx(0.05)
    assert rising[3:20] == pytest.approx([0.2] * 17)
    assert rising[20] == 0.0


def stop(plant: Plant) -> None:
    plant.bridge.latch.stop()


def disarm(plant: Plant) -> None:
    plant.bridge.latch.disarm()


def lose_driver(plant: Plant) -> None:
    plant.driver = DriverState(False, "a board is off", losses=1, timeout=0.1)


def lose_driver_for_a_moment(plant: Plant) -> None:
    plant.driver = DriverState(True, losses=1, timeout=0.1)


def refuse_scene(plant: Plant) -> None:
    plant.bridge.scene_problem = "scene refused: damaged"


def command(plant: Plant) -> None:
    plant.bridge.command("operator", np.array([1e-3, 0.0]), plant.time, 1, plant.time, plant.time)


def jump(plant: Plant) -> None:
    plant.middle = plant.middle + np.array([3e-3, 0.0])
    plant.pose()


def stand_still(plant: Plant) -> None:
    plant.time += 0.3
    plant.pose()


@pytest.mark.parametrize(
    ("happens", "reason", "latched"),
    [
        (stop, "emergency stop", True),
        (disarm, "disarmed", False),
        (lose_driver, "driver: a board is off", True),
        (lose_driver_for_a_moment, "driver: currents were lost for a moment", True),
        (refuse_scene, "scene refused: damaged", False),
        (command, "operator/servo_cv commands the needle", False),
        (jump, "needle pose rejected", False),
        (stand_still, "the bridge stood still for 0.30 s", True),
    ],
)
def test_a_pulse_ends_with_the_next_step_after(happens: Callable[[Plant], None], reason: str, latched: bool):
    plant = Plant()
    plant.pulse(duration=0.5)
    assert flowing(plant.run(0.1)) == 20
    happens(plant)
    plant.step()
    assert not plant.outputs[-1].allocation.currents.any()
    assert plant.outputs[-1].reasons[0].startswith(reason)
    assert bool(plant.bridge.latch.latched_reason) is latched
    assert flowing(plant.run(1.0)) == 0  # whatever has gone by, it does not go on


def test_a_pulse_ends_when_poses_do_before_they_are_too_old():
    plant = Plant(CoilBridgeSettings(pose_timeout=0.1))
    plant.pulse(duration=0.5)
    plant.run(0.05)
    plant.poses, last = False, plant._next_pose - FRAME
    outputs = plant.run(0.45)
    assert "no needle pose for 0.1 s" in outputs[-1].reasons
    assert flowing(outputs) * PERIOD + 0.05 <= last + 0.1 - plant.time + 0.5 + 1e-9
    with pytest.raises(InvalidInputError, match=r"no needle pose for 0\.1 s"):
        plant.pulse()


@pytest.mark.parametrize("switch", [stop, disarm, lose_driver, command])
def test_no_pulse_begins_while_something_stops_the_coils(switch: Callable[[Plant], None]):
    plant = Plant()
    switch(plant)
    with pytest.raises(InvalidInputError, match="expected a bridge that may give currents"):
        plant.pulse()
    assert flowing(plant.run(0.5)) == 0


def test_a_second_pulse_waits_for_the_end_of_the_first():
    plant = Plant()
    plant.pulse()
    plant.run(0.1)
    with pytest.raises(InvalidInputError, match="a pulse that flows"):
        plant.pulse(2.0 * PULSE)
    assert np.array_equal(plant.run(PERIOD)[0].allocation.currents, PULSE)


def test_pulses_are_given_in_an_empty_dish():
    plant = Plant()
    plant.bridge.set_scene(Scene(shapes=(SceneShape("post", "tissue", Disc((5e-3, 5e-3), 1e-3)),)))
    with pytest.raises(InvalidInputError, match="1 shapes in the dish, expected an empty dish"):
        plant.pulse()


def test_a_pulse_ends_after_a_way_by_speed_and_at_the_wall_by_measured_poses():
    far = Plant(velocity=np.array([4e-3, 0.0]))
    far.pulse(duration=0.5)
    outputs = far.run(0.6)
    assert outputs[flowing(outputs)].reasons == ("the needle has moved 1.5 mm",)
    assert 1.5e-3 < far.middle[0] < 1.5e-3 + 4e-3 * 2.0 * FRAME
    fast = Plant(velocity=np.array([0.0, 9e-3]))
    fast.pulse(duration=0.5)
    outputs = fast.run(0.6)
    assert outputs[flowing(outputs)].reasons[0].startswith("the needle moves at ")
    assert fast.middle[1] < 9e-3 * 5.0 * FRAME
    radius = Scene().dish.radius
    outer = Plant(middle=np.array([0.59 * radius, 0.0]), velocity=np.array([3e-3, 0.0]))
    outer.pulse(duration=0.5)
    outputs = outer.run(0.6)
    assert outputs[flowing(outputs)].reasons == ("the needle comes to the wall",)
    assert outer.middle[0] < 0.6 * radius + 3e-3 * 2.0 * FRAME + 5e-5
    outer.velocity = -outer.velocity  # away from it, it may go
    outer.pulse(duration=0.2)
    assert flowing(outer.run(0.3)) == 40


def test_a_long_needle_stays_off_the_wall_by_its_ends():
    assert guard_reach(0.0175, 0.007, 0.0005) == pytest.approx(0.6 * 0.0175)
    assert guard_reach(0.0125, 0.012, 0.0005) == pytest.approx(0.006)


def test_a_guard_that_has_no_pose_yet_counts_from_the_next():
    guard = MotionGuard(1e-2)
    guard.begin()
    assert guard.problem() == ""
    for k, place in enumerate((1.0e-3, 1.1e-3, 1.2e-3, 2.7e-3)):
        assert guard.problem() == ""
        guard.update(k, np.array([place, 0.0]))
    assert guard.problem() == "the needle has moved 1.7 mm"


def test_two_publishers_of_a_velocity_are_a_command_too():
    plant = Plant()
    for number in (1, 500):
        with suppress(InvalidInputError):
            plant.bridge.command("needle", np.array([1e-3, 0.0]), plant.time, number, plant.time, plant.time)
    with pytest.raises(InvalidInputError, match="commands the needle"):
        plant.pulse()


def test_between_two_pulses_the_coils_rest_for_as_long_as_boards_hold_a_current():
    plant = Plant()
    plant.pulse(duration=0.1)
    plant.run(0.15)
    with pytest.raises(InvalidInputError, match="coils that rest for 0"):
        plant.pulse()
    plant.run(plant.bridge._settings.driver_timeout)
    plant.pulse()


def test_an_error_that_nobody_foresaw_ends_at_zero_and_is_latched(monkeypatch: pytest.MonkeyPatch):
    plant = Plant()
    plant.pulse()
    plant.run(0.05)
    monkeypatch.setattr(MotionGuard, "problem", lambda self: 1 / 0)
    plant.step()
    assert not plant.outputs[-1].allocation.currents.any()
    assert "internal error: ZeroDivisionError" in plant.bridge.latch.fault
    assert flowing(plant.run(0.5)) == 0


def test_a_reset_after_a_stop_gives_no_pulse_before_it_is_armed():
    plant = Plant()
    stop(plant)
    plant.bridge.reset(plant.driver)
    with pytest.raises(InvalidInputError, match="disarmed"):
        plant.pulse()
    plant.bridge.arm(replace(plant.driver))
    plant.pulse()
    assert flowing(plant.run(0.5)) == 60
