"""What the bridge promises: as collision_monitor, diff_drive_controller and Servo promise it of a base or an arm.

A plant in Python: a clock, a commander, a tracker and a driver, each of which can fail. Nothing waits here.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from magnetosuture_thread.coils.bridge import FIRST_MOTION, FIRST_SPEED, BridgeOutput, CoilBridge
from magnetosuture_thread.coils.drivers import DriverState
from magnetosuture_thread.coils.latch import ArmingLatch
from magnetosuture_thread.coils.motion_observer import FollowMonitor
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError

PERIOD = 0.005
READY = DriverState(True)
EAST, TAIL = np.array([1.0, 0.0]), np.array([-0.0035, 0.0])


@dataclass
class Plant:
    """A bridge under a clock; commands come at 50 Hz and poses at 60, unless they are switched off."""

    settings: CoilBridgeSettings = field(default_factory=CoilBridgeSettings)
    scene: Scene | None = field(default_factory=Scene)
    thread: bool = True
    time: float = 100.0
    velocity: tuple[float, ...] | None = (0.005, 0.002)  # of the tip, or the motion in the needle's frame
    tail: NDArray[np.float64] | None = field(default_factory=lambda: TAIL.copy())
    driver: DriverState = READY
    outputs: list[tuple[float, BridgeOutput]] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Make the bridge, not active yet."""
        self.bridge = CoilBridge(self.settings, ArmingLatch(), self.scene)
        self.commands = self.poses = 0
        self._next_command = self._next_pose = self.time

    def ready(self) -> Plant:
        """Activate and arm."""
        self.bridge.latch.activate()
        self.bridge.arm(self.driver)
        return self

    def run(self, duration: float) -> list[BridgeOutput]:
        """Let time go on; return what each step asked of the coils."""
        begin = len(self.outputs)
        for _ in range(round(duration / PERIOD)):
            self.time += PERIOD
            if self.tail is not None and self.time >= self._next_pose:
                self.poses += 1
                self.bridge.extrapolator.update(self.tail, EAST, self.time, self.poses, self.time, self.time)
                self._next_pose = self.time + 1.0 / 60.0
            if self.velocity is not None and self.time >= self._next_command:
                self.command(self.velocity)
                self._next_command = self.time + 0.02
            if self.thread:
                self.bridge.on_margins(self.time, True, 1.0, self.bridge.scene_version, self.time)
            self.outputs.append((self.time, self.bridge.step(self.time, self.time, self.driver)))
        return [output for _, output in self.outputs[begin:]]

    def command(
        self,
        velocity: tuple[float, ...],
        stamp: float | None = None,
        number: int | None = None,
        source: str = "needle",
    ) -> None:
        """Send one command now."""
        self.commands += 1
        stamp = self.time if stamp is None else stamp
        self.bridge.command(source, np.array(velocity), stamp, number or self.commands, self.time, self.time)


def still(output: BridgeOutput) -> bool:
    """Return whether no coil has a current."""
    return not np.any(output.allocation.currents)


def stopped_after(plant: Plant, since: float) -> float:
    """Return how long after a time the coils first were at zero, for good [s]."""
    moving = [time for time, output in plant.outputs if not still(output)]
    return max(0.0, moving[-1] + PERIOD - since)


def test_while_all_is_well_it_drives():
    outputs = Plant().ready().run(1.0)
    assert not any(still(output) for output in outputs[4:])
    assert outputs[-1].reasons == ()
    assert outputs[-1].allocation.velocity.tolist() == pytest.approx([0.005, 0.002], rel=0.02)


def test_no_false_stops():
    """Twelve seconds of commands and poses that come late, but in time: not one zero."""
    plant = Plant().ready()
    plant.run(0.2)
    jitter = np.random.default_rng(3)
    plant.velocity = plant.tail = None
    at = {"command": plant.time + 0.04, "pose": plant.time + 0.04}
    numbers = {"command": plant.commands, "pose": plant.poses}
    for _ in range(2400):
        plant.time += PERIOD
        for name in ("command", "pose"):
            if plant.time >= at[name]:
                numbers[name] += 1
                age = float(jitter.uniform(0.0, 0.03))
                if name == "command":
                    plant.command((0.004, -0.001), plant.time - age, numbers[name])
                else:
                    stamp = plant.time - age
                    plant.bridge.extrapolator.update(TAIL, EAST, stamp, numbers[name], plant.time, plant.time)
                at[name] = plant.time + float(jitter.uniform(0.04, 0.055))
        plant.bridge.on_margins(plant.time, True, 1.0, plant.bridge.scene_version, plant.time)
        assert not still(plant.bridge.step(plant.time, plant.time, READY))


@pytest.mark.parametrize("timeout", [0.05, 0.1, 0.4])
def test_source_timeout_and_time_to_stop(timeout: float):
    plant = Plant(CoilBridgeSettings(command_timeout=timeout)).ready()
    plant.run(0.5)
    plant.velocity, last = None, plant.bridge.watchdogs["needle"].stamp
    outputs = plant.run(1.0)
    assert outputs[-1].reasons == (f"no command for {timeout:g} s",)
    assert timeout - 3 * PERIOD < stopped_after(plant, last) <= timeout - PERIOD + 1e-9


def test_cease_after_stop():
    """Zeros are told for a while, then no more; the coils are held at zero all the time."""
    plant = Plant(CoilBridgeSettings(zero_hold=0.3)).ready()
    plant.run(0.5)
    plant.velocity = None
    outputs = plant.run(2.0)
    zeros = [output for output in outputs if still(output)]
    assert sum(output.publish for output in zeros) == pytest.approx(0.3 / PERIOD, abs=2)
    assert not zeros[-1].publish
    plant.velocity = (0.005, 0.0)
    assert plant.run(0.1)[-1].publish


@pytest.mark.parametrize("how_far", ["inactive", "active"])
def test_inactive_and_disarmed_pass_nothing(how_far: str):
    plant = Plant()
    if how_far == "active":
        plant.bridge.latch.activate()
    outputs = plant.run(1.0)
    assert all(still(output) for output in outputs)
    assert outputs[-1].reasons == ("inactive" if how_far == "inactive" else "disarmed",)


@pytest.mark.parametrize("press", ["stop", "disarm", "deactivate", "trip"])
def test_whatever_is_pressed_works_with_the_next_step_and_stays(press: str):
    plant = Plant().ready()
    assert not still(plant.run(0.5)[-1])
    getattr(plant.bridge.latch, press)(*(["a fault"] if press == "trip" else []))
    assert all(still(output) for output in plant.run(1.0))


@pytest.mark.parametrize("gone", [DriverState(False, "no answer", 1), DriverState(True, "", 1)])
def test_a_driver_that_was_lost_even_for_a_moment_is_a_fault_until_a_reset(gone: DriverState):
    plant = Plant().ready()
    plant.run(0.5)
    plant.driver = gone
    outputs = plant.run(0.2)
    assert all(still(output) for output in outputs)
    assert outputs[-1].reasons[0].startswith("driver: ")
    plant.driver = DriverState(True, "", 1)  # back by itself
    assert all(still(output) for output in plant.run(1.0))
    plant.bridge.reset(plant.driver)
    assert all(still(output) for output in plant.run(0.1))
    plant.bridge.arm(plant.driver)
    assert not still(plant.run(0.1)[-1])


def test_stops_are_at_once_and_starts_are_not():
    """Acceleration and slew are limited while the needle is driven; a stop may take no time."""
    settings = CoilBridgeSettings(max_acceleration=0.1, max_current_slew=100.0)
    plant = Plant(settings, velocity=(0.015, 0.0)).ready()
    outputs = plant.run(1.0)
    plant.velocity = (-0.015, 0.0)
    outputs += plant.run(1.0)
    for before, after in itertools.pairwise(outputs):
        assert np.linalg.norm(after.filtered - before.filtered) <= 0.1 * 2 * PERIOD + 1e-12
        assert np.abs(after.allocation.currents - before.allocation.currents).max() <= 100.0 * 2 * PERIOD + 1e-9
    steps = [np.linalg.norm(b.filtered - a.filtered) for a, b in itertools.pairwise(outputs[1:])]
    assert max(steps) == pytest.approx(0.1 * PERIOD, rel=1e-6)
    assert not still(outputs[-1])
    plant.velocity = (0.0, 0.0)
    at_rest = plant.run(0.05)
    assert at_rest[-1].reasons == ()
    assert at_rest[-1].publish
    assert [still(output) for output in at_rest[4:]] == [True] * (len(at_rest) - 4)
    assert not any(0.0 < np.linalg.norm(output.filtered) < 0.014 for output in at_rest)


def test_after_a_stall_in_which_the_driver_went_to_zero_it_starts_from_rest():
    settings = CoilBridgeSettings(max_current_slew=100.0, command_timeout=0.1)
    plant = Plant(settings, velocity=(0.015, 0.0)).ready()
    assert np.abs(plant.run(1.0)[-1].allocation.currents).max() > 3.0
    plant.time += 0.21  # until when the coils have certainly stopped
    plant.bridge.extrapolator.update(TAIL, EAST, plant.time, plant.poses + 1, plant.time, plant.time)
    plant.command((0.015, 0.0))
    plant.bridge.on_margins(plant.time, True, 1.0, plant.bridge.scene_version, plant.time)
    after = plant.bridge.step(plant.time, plant.time, READY)
    assert not still(after)
    assert np.abs(after.allocation.currents).max() <= 100.0 * 2 * PERIOD + 1e-9


def driven(
    plant: Plant,
    steps: int,
    *,
    tail: NDArray[np.float64] = TAIL,
    pull: NDArray[np.float64] | float = 0.0,
    error: NDArray[np.float64] | float = 0.0,
    latency: int = 0,
    interval: int = 1,
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Yield the needle's tail and heading after each step, by what its coils give it.

    It is pulled at a velocity; its poses are off by an error, and come late and seldom, both in periods.
    """
    heading, needle, plant.tail = EAST, plant.settings.needle().kinematics, None
    poses: list[tuple[float, NDArray[np.float64], NDArray[np.float64]]] = []
    for number in range(1, steps):
        now = plant.time + PERIOD  # of the step, from which on its currents move the needle
        poses.append((now, tail, heading))
        if number > latency and number % interval == 0:
            then, old_tail, old_heading = poses[number - 1 - latency]
            plant.bridge.on_pose(old_tail - error, old_heading, then, number, now, now)
        found = plant.run(PERIOD)[0].allocation
        e = needle.chord_direction(heading)
        n = np.array([-e[1], e[0]])
        drift = found.drift if plant.settings.motion_compensation else 0.0  # else it counts as part of the turn
        along, across = needle.body_velocity(heading, found.velocity)
        tail, heading = needle.moved(tail, heading, along, across - drift, PERIOD)
        tail = tail + PERIOD * (drift * n + pull)
        yield tail, heading


@pytest.mark.parametrize("towards", [(0.7, 0.7), (-1.0, 0.0)])
@pytest.mark.parametrize("obstacles", [(), (0.006, 0.0, 0.002)])
@pytest.mark.parametrize(
    ("compensates", "pull", "latency", "interval"),
    [(False, 0.0, 0, 1), (False, 0.0, 30, 6), (True, 0.0, 10, 10), (True, 1e-3, 10, 10)],
)
def test_the_needle_never_comes_closer_than_it_may(
    towards: tuple[float, float],
    obstacles: tuple[float, ...],
    compensates: bool,
    pull: float,
    latency: int,
    interval: int,
):
    """Told to go on for ever, it comes to rest before the wall or the obstacle, also where it is pulled to it."""
    settings = CoilBridgeSettings(motion_compensation=compensates)
    posts = (SceneShape("post", "instrument", Disc(obstacles[:2], obstacles[2])),) if obstacles else ()
    scene = Scene(Dish(0.035), posts)
    plant = Plant(settings, scene, velocity=(0.02 * towards[0], 0.02 * towards[1])).ready()
    safety, drag = settings.safety_filter(scene), pull * np.array(towards)
    begin = TAIL - np.array([0.004, 0.0])
    motion = driven(plant, 1000, tail=begin, pull=drag, latency=latency, interval=interval)
    least = min(safety.clearance(tail, heading) for tail, heading in motion)
    assert least > settings.keep_out - 1e-9
    assert least < 0.003  # it did get there


@pytest.mark.parametrize(("compensates", "slew"), [(False, 1000.0), (True, 1000.0), (True, 10.0)])
@pytest.mark.parametrize("twist", [(-0.01, 0.004, 0.0), (0.0, 0.004, 0.0), (0.005, -0.004, 2.0), (0.01, 0.0, 0.0)])
def test_a_motion_in_its_own_frame_brings_the_needle_no_closer_than_it_may(
    twist: tuple[float, ...], compensates: bool, slew: float
):
    """Also with currents that change slowly, where those that would hold the needle cannot be had at once."""
    settings = CoilBridgeSettings(motion_compensation=compensates, max_current_slew=slew)
    scene = Scene(Dish(0.035), (SceneShape("post", "instrument", Disc((0.006, 0.004), 0.002)),))
    plant, safety = Plant(settings, scene, velocity=twist).ready(), settings.safety_filter(scene)
    motion = driven(plant, 600, tail=TAIL - np.array([0.004, 0.0]), latency=4, interval=10)
    least = min(safety.clearance(tail, heading) for tail, heading in motion)
    assert least > settings.keep_out - 1e-9
    assert not plant.bridge.latch.fault


@pytest.mark.parametrize("compensates", [False, True])
@pytest.mark.parametrize(
    "twist", [(0.0, 0.0, 5e-324), (0.0, 1.79e308, 1.79e308), (-1e300, 0.0, 1e-300), (0.0, 0.0, 1e6)]
)
def test_a_hostile_motion_is_limited_and_no_fault(twist: tuple[float, ...], compensates: bool):
    plant = Plant(CoilBridgeSettings(motion_compensation=compensates), velocity=twist).ready()
    outputs = plant.run(0.3)
    assert all(
        np.isfinite([*output.allocation.currents, *output.commanded, *output.filtered]).all() for output in outputs
    )
    assert not plant.bridge.latch.fault


def test_both_ends_of_a_needle_go_no_faster_than_the_greatest_speed():
    settings = CoilBridgeSettings(max_speed=0.004, max_current=100.0)
    lever = settings.needle().kinematics.lever
    plant = Plant(settings, velocity=(0.0, 0.004, -0.004 / lever)).ready()  # the tip rests, and the tail sweeps
    output = plant.run(0.3)[-1]
    assert math.hypot(*output.filtered) < 1e-9
    assert "speed" in output.active


def test_an_operator_commands_the_tip_alone():
    plant = Plant().ready()
    with pytest.raises(InvalidInputError, match="operator/servo_cv"):
        plant.bridge.command("operator", np.array([1e-3, 0.0, 0.1]), plant.time, 1, plant.time, plant.time)


def test_a_pose_error_within_pose_margin_brings_the_needle_no_closer_than_keep_out():
    """Each pose is measured 20 um farther from the wall than the needle is, which the bridge cannot know."""
    error, least = 2e-5, {}
    for margin in (0.0, error):
        settings, scene = CoilBridgeSettings(pose_margin=margin), Scene(Dish(0.035), ())
        plant = Plant(settings, scene, velocity=(0.02, 0.0)).ready()
        *_, at_end = driven(plant, 800, tail=np.array([0.004, 0.0]), error=error * EAST, interval=10)
        tip = settings.needle().kinematics.tip(*at_end)
        least[margin] = scene.dish.radius - math.hypot(*tip) - settings.keep_out
    assert least[0.0] < -0.8 * error
    assert -1e-9 < least[error] < 1e-5


def test_an_error_that_nobody_foresaw_ends_at_zero_and_is_latched(monkeypatch: pytest.MonkeyPatch):
    plant = Plant().ready()
    plant.run(0.2)

    def broken(*_: object) -> None:
        raise FloatingPointError("no such number")

    monkeypatch.setattr(plant.bridge._coils, "allocate", broken)
    outputs = plant.run(0.2)
    assert all(still(output) for output in outputs)
    assert plant.bridge.latch.fault == "internal error: FloatingPointError: no such number"


def test_4000_hostile_inputs_and_not_one_current_outside_of_the_limits():
    source = np.random.default_rng(11)
    settings = CoilBridgeSettings(max_current_slew=500.0)
    plant = Plant(settings, velocity=None, tail=None).ready()
    odd = np.array([0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324, 0.01, -0.02, 1e-6])
    before, driven, tail = np.zeros(4), 0, np.zeros(2)
    number = {"command": 0, "pose": 0}
    for k in range(4000):
        plant.time += float(source.choice([0.0, 1e-4, PERIOD, 0.03]))
        hostile = source.uniform() < 0.3
        stamp = plant.time + (float(source.choice([-1e9, -1.0, 0.2, 1e9])) if hostile and k % 3 == 0 else 0.0)
        values = source.choice(odd, 4) if hostile else np.array([*source.uniform(-0.03, 0.03, 2), 1.0, 0.0])
        tail = np.clip(tail + source.uniform(-2e-4, 2e-4, 2), -0.006, 0.006)
        name = "command" if k % 2 else "pose"
        number[name] += int(source.choice([-5, 0, 200])) if source.uniform() < 0.002 else 1
        try:
            if name == "command":
                plant.bridge.command("needle", values[:2], stamp, number[name], plant.time, plant.time)
            else:
                where = 0.4 * values[:2] if hostile else tail
                plant.bridge.extrapolator.update(where, values[2:], stamp, number[name], plant.time, plant.time)
        except InvalidInputError:
            pass
        plant.bridge.on_margins(plant.time, True, 1.0, plant.bridge.scene_version, plant.time)
        currents = plant.bridge.step(plant.time, plant.time, READY).allocation.currents
        assert np.all(np.isfinite(currents))
        assert np.abs(currents).max() <= settings.max_current
        if currents.any():
            # Towards zero the filter may take any share off, as a stop does.
            change = settings.max_current_slew * 2 * PERIOD + 1e-9
            assert (currents <= np.maximum(before + change, 0.0)).all()
            assert (currents >= np.minimum(before - change, 0.0)).all()
        before, driven = currents, driven + bool(currents.any())
        assert plant.bridge.latch.fault == ""
    assert driven > 200  # there was something to go wrong


def test_without_a_scene_it_does_not_arm():
    plant = Plant(scene=None)
    plant.bridge.latch.activate()
    with pytest.raises(InvalidInputError, match="no scene"):
        plant.bridge.arm(READY)
    plant.bridge.set_scene(Scene())
    plant.bridge.arm(READY)
    assert not still(plant.run(0.2)[-1])
    plant.bridge.set_scene(None)
    assert plant.run(PERIOD)[0].reasons[0] == "no scene"


def test_another_scene_holds_from_the_next_step_on():
    plant = Plant(velocity=(0.01, 0.0)).ready()
    before = plant.run(0.2)[-1]
    post = SceneShape("post", "instrument", Disc((0.0065, 0.0), 0.002))
    plant.bridge.set_scene(Scene(Dish(), (post,)))
    after = plant.run(PERIOD)[0]
    assert before.active == ()
    assert after.scene_version == Scene(Dish(), (post,)).version != before.scene_version
    assert "post" in after.active
    assert np.linalg.norm(after.applied) < 0.6 * np.linalg.norm(before.applied)


def test_rejected_scene_leaves_the_previous_one_in_force():
    plant = Plant().ready()
    with pytest.raises(ConfigurationError, match="room for the needle"):
        plant.bridge.set_scene(Scene(Dish(0.006)))
    assert plant.bridge.scene == Scene()
    assert not still(plant.run(0.2)[-1])


def test_while_a_scene_that_was_heard_is_not_in_force_the_coils_are_at_zero():
    plant = Plant().ready()
    plant.run(0.2)
    plant.bridge.scene_problem = "scene refused: cut off"
    stopped = plant.run(PERIOD)[0]
    assert still(stopped)
    assert stopped.reasons == ("scene refused: cut off",)
    plant.bridge.scene_problem = ""
    assert not still(plant.run(0.1)[-1])


def test_an_operator_takes_over_by_commanding_and_gives_back_by_silence():
    plant = Plant(velocity=(0.005, 0.0)).ready()
    assert (plant.run(0.2)[-1].source, plant.outputs[-1][1].overridden) == ("needle", "")
    for k in range(20):
        plant.command((0.0, 0.004), number=9000 + k, source="operator")
        plant.commands -= 1
        output = plant.run(PERIOD)[0]
        assert (output.source, output.overridden) == ("operator", "needle")
        assert output.commanded.tolist() == [0.0, 0.004]
    assert plant.run(0.12)[-1].source == "needle"
    assert plant.outputs[-1][1].commanded.tolist() == [0.005, 0.0]


def test_two_operators_at_once_stop_the_needle_whoever_else_commands():
    plant = Plant().ready()
    plant.command((0.0, 0.004), number=1, source="operator")
    plant.run(0.1)
    with pytest.raises(InvalidInputError, match="operator/servo_cv"):
        plant.command((0.0, 0.004), number=7777, source="operator")
    assert plant.run(0.05)[-1].reasons == ("several publishers of operator/servo_cv at once",)


def test_without_a_prediction_it_stops_and_says_so():
    plant = Plant(thread=False).ready()
    output = plant.run(0.2)[-1]
    assert still(output)
    assert (output.reasons, output.active) == (("no thread prediction yet",), ("no prediction",))
    plant.thread = True
    assert not still(plant.run(0.1)[-1])
    plant.thread = False
    assert not still(plant.run(0.45)[-1])
    assert plant.run(0.1)[-1].reasons == ("no thread prediction for 0.5 s",)


def test_without_a_prediction_it_may_go_on_slowly():
    settings = CoilBridgeSettings(without_prediction="slow", speed_without_prediction=0.002)
    plant = Plant(settings, thread=False, velocity=(0.01, 0.0)).ready()
    output = plant.run(0.3)[-1]
    assert output.reasons == ()
    assert np.linalg.norm(output.filtered) == pytest.approx(0.002)
    assert output.active == ("no prediction", "speed")


@pytest.mark.parametrize(
    ("feedback", "source", "slowdown"),
    [("all", "needle", 0.5), ("all", "operator", 0.5), ("operator", "needle", 1.0), ("operator", "operator", 0.5)],
)
def test_friction_slows_the_commands_that_it_is_fed_back_to(feedback: str, source: str, slowdown: float):
    plant = Plant(CoilBridgeSettings(friction_feedback=feedback), thread=False, velocity=None).ready()
    for _ in range(40):
        plant.bridge.on_margins(plant.time, True, 0.5, plant.bridge.scene_version, plant.time)
        plant.command((0.01, 0.0), source=source)
        output = plant.run(PERIOD)[0]
    assert output.source == source
    assert output.filtered.tolist() == pytest.approx([slowdown * 0.01, 0.0])
    assert output.slowdown == slowdown


def test_model_and_bridge_on_different_scenes_for_half_a_second_stop_the_needle():
    plant = Plant(thread=False).ready()

    def run(duration: float, version: str) -> BridgeOutput:
        for _ in range(round(duration / PERIOD)):
            plant.bridge.on_margins(plant.time, True, 1.0, version, plant.time)
            plant.run(PERIOD)
        return plant.outputs[-1][1]

    mine = plant.bridge.scene_version
    assert not still(run(0.2, mine))
    assert not still(run(0.45, "0123"))
    assert run(0.1, "0123").reasons == (f"scene: thread_model has 0123, coil_bridge has {mine}",)
    assert not still(run(0.05, mine))
    assert run(0.6, "").reasons == (f"scene: thread_model has none, coil_bridge has {mine}",)


def test_a_needle_that_is_commanded_to_move_and_rests_says_what_stops_it():
    """Against the wall, head on, by the filter."""
    plant = Plant(velocity=(0.01, 0.0)).ready()
    keep = plant.settings.keep_out
    plant.tail = np.array([Scene().dish.radius - keep - plant.settings.needle_length, 0.0])
    for output in plant.run(0.5)[4:]:
        assert still(output)
        assert output.reasons == ("stopped by wall",)
        assert "wall" in output.active
        assert output.commanded.tolist() == [0.01, 0.0]


def test_a_jump_of_the_pose_is_not_accepted_by_itself_while_armed():
    plant = Plant().ready()
    plant.run(0.2)
    tail, plant.tail = plant.tail + np.array([0.0, 3e-3]), None  # another object is tracked from now on
    for _ in range(5):
        plant.run(0.02)
        plant.poses += 1
        with pytest.raises(InvalidInputError, match="its tail jumped"):
            plant.bridge.on_pose(tail, EAST, plant.time, plant.poses, plant.time, plant.time)
    plant.run(PERIOD)
    assert "needle does not follow: its tail jumped by 0.003 m" in plant.bridge.latch.fault
    assert still(plant.outputs[-1][1])


HARDWARE = DriverState(True, timeout=0.2)


def frozen(plant: Plant, seconds: float) -> BridgeOutput:
    """Let a bridge drive, stand still, and go on; return what it does then, with new commands and poses."""
    plant.run(0.5)
    plant.time += seconds
    return plant.run(0.2)[-1]


def test_a_bridge_that_stood_still_until_the_boards_stopped_is_in_fault():
    plant = Plant(driver=HARDWARE).ready()
    output = frozen(plant, 0.3)
    assert plant.bridge.latch.fault == "the bridge stood still for 0.30 s: the coils stopped by themselves"
    assert still(output)
    plant.bridge.reset(HARDWARE)
    plant.bridge.arm(HARDWARE)
    assert not still(plant.run(0.2)[-1])


def test_an_operator_may_take_over_from_two_that_dispute_the_needle():
    plant = Plant().ready()
    plant.run(0.2)
    with pytest.raises(InvalidInputError, match="2 publishers at once"):
        plant.command((-0.01, 0.0), number=7777)
    plant.velocity = None
    assert plant.run(PERIOD)[0].reasons == ("several publishers of needle/servo_cv at once",)
    plant.command((0.0, 0.004), number=1, source="operator")
    assert plant.run(PERIOD)[0].source == "operator"


def test_an_invalid_prediction_leaves_the_last_valid_one_until_that_is_old():
    plant = Plant(thread=False).ready()
    plant.run(0.02)
    plant.bridge.on_margins(plant.time, True, 0.5, plant.bridge.scene_version, plant.time)
    for _ in range(8):
        plant.bridge.on_margins(plant.time, False, 1.0, plant.bridge.scene_version, plant.time)
        assert plant.run(0.05)[-1].slowdown == 0.5
    for _ in range(4):
        plant.bridge.on_margins(plant.time, False, 1.0, plant.bridge.scene_version, plant.time)
        plant.run(0.05)
    assert plant.outputs[-1][1].reasons == ("no thread prediction for 0.5 s",)
    for slowdown in (float("nan"), -0.1, 1.5):
        with pytest.raises(InvalidInputError, match="slowdown"):
            plant.bridge.on_margins(plant.time, True, slowdown, "", plant.time)


def test_a_new_scene_that_takes_long_is_no_fault():
    plant = Plant(driver=HARDWARE).ready()
    plant.run(0.5)
    plant.time += 0.4
    plant.bridge.set_scene(Scene(Dish(0.036)))
    assert not still(plant.run(0.2)[-1])


def test_after_a_stop_the_needle_starts_from_rest():
    """Neither speed nor currents nor the motion that a pose is carried on by outlive a stop."""
    settings = CoilBridgeSettings(max_acceleration=0.1, max_current_slew=100.0)
    plant = Plant(settings, velocity=(0.015, 0.0)).ready()
    plant.run(1.0)
    plant.bridge.latch.disarm()
    plant.run(PERIOD)
    plant.tail = None
    at_rest = plant.bridge.extrapolator.pose(plant.time, plant.time)
    later = plant.bridge.extrapolator.pose(plant.time + 0.05, plant.time + 0.05)
    assert at_rest is not None
    assert later is not None
    assert later.tail.tolist() == at_rest.tail.tolist()
    plant.bridge.arm(READY)
    plant.command((0.015, 0.0))
    first = plant.run(PERIOD)[0]
    assert 0.0 < np.linalg.norm(first.filtered) <= 0.1 * 2 * PERIOD + 1e-12
    assert np.abs(first.allocation.currents).max() <= 100.0 * 2 * PERIOD + 1e-9


@pytest.mark.parametrize("compensates", [False, True])
@pytest.mark.parametrize("twist", [(0.008, 0.0), (0.006, 0.004), (0.008, 0.0, 0.1)])
def test_a_needle_that_moves_for_the_first_time_is_driven_slowly_until_it_has_followed(
    compensates: bool, twist: tuple[float, ...]
):
    plant = Plant(CoilBridgeSettings(motion_compensation=compensates), Scene(Dish(0.08)), velocity=twist).ready()
    plant.bridge.slow_way = plant.bridge.first_way = 2e-3
    places = [tail for tail, _ in driven(plant, 400, tail=TAIL - np.array([0.01, 0.0]), latency=2, interval=4)]
    steps = np.hypot(*np.diff(places, axis=0).T)
    travel = np.cumsum(steps)
    slow = [FIRST_MOTION in output.active for _, output in plant.outputs[1:]]
    begin, since = slow.index(True), len(slow) - slow[::-1].index(True)
    assert all(slow[begin:since])
    assert begin < 10
    assert steps[:since].max() < 1.05 * FIRST_SPEED * PERIOD
    assert 1.9e-3 < travel[since] < 2.3e-3
    assert steps[since + 20 :].max() > 0.006 * PERIOD


@pytest.mark.parametrize("factor", [2.0, 4.0])
def test_in_its_first_motion_a_needle_that_is_too_swift_is_not_driven_faster_for_that(factor: float):
    """Its excess is taken for a pull, and compensated by no more than that speed by the model."""
    plant = Plant(CoilBridgeSettings(motion_compensation=True), Scene(Dish(0.08)), velocity=(0.008, 0.0, 0.0)).ready()
    plant.bridge.slow_way = plant.bridge.first_way = 0.01
    error, speeds = np.zeros(2), []
    for tail, heading in driven(plant, 400, error=error, latency=10, interval=10):
        way = tail - TAIL + 0.0035 * (heading - EAST)
        error[:] = (1.0 - factor) * way
        applied = plant.outputs[-1][1].allocation
        speeds.append(math.hypot(*applied.velocity))
        if plant.bridge.latch.fault or not plant.bridge.first_way:
            break
    assert max(speeds) < 1.05 * FIRST_SPEED


def test_a_fault_of_following_is_followed_by_a_slow_motion():
    plant = Plant(velocity=(0.008, 0.0)).ready()
    plant.bridge.slow_way, error = 0.01, np.zeros(2)
    for tail, heading in driven(plant, 400, error=error, latency=2, interval=4):
        error[:] = 2.0 * (tail - TAIL + 0.0035 * (heading - EAST))  # poses move back
        if plant.bridge.latch.fault:
            break
    assert plant.bridge.latch.fault.startswith("needle does not follow")
    assert plant.bridge.first_way == 0.01


@pytest.mark.parametrize("shown", [(0.0, 0.0), (0.0, -1.0), (-0.5, 0.0)])
def test_poses_that_do_not_follow_end_no_first_motion(shown: tuple[float, float]):
    """They stand still, move to a side, or back, and tremble."""
    plant, random = Plant(velocity=(0.008, 0.0)).ready(), np.random.default_rng(1)
    plant.bridge.slow_way = plant.bridge.first_way = 2e-3
    error = np.zeros(2)
    for tail, heading in driven(plant, 400, error=error, latency=2, interval=4):
        way = tail - TAIL + 0.0035 * (heading - EAST)  # of the middle
        error[:] = way - math.hypot(*way) * np.array(shown) + 2e-5 * random.standard_normal(2)
    assert math.hypot(*way) > 5e-4
    assert plant.bridge.first_way > 1.8e-3


@pytest.mark.parametrize("let_go", [0.0, 1.0])
def test_a_needle_that_is_let_go_moves_with_its_pull_as_is_expected_of_it(
    let_go: float, monkeypatch: pytest.MonkeyPatch
):
    """See `FollowMonitor.unproven_pull`."""
    monkeypatch.setattr(FollowMonitor, "unproven_pull", lambda self, pull: let_go * pull)
    plant = Plant(CoilBridgeSettings(motion_compensation=True), Scene(Dish(0.08)), velocity=(0.0, 0.0, 0.1)).ready()
    pull = np.array([1.6e-3, 1.2e-3])
    places = [tail + 0.0035 * heading for tail, heading in driven(plant, 600, pull=pull, latency=2, interval=4)]
    assert not plant.bridge.latch.fault
    speed = np.diff(places[-200:], axis=0).mean(axis=0) / PERIOD
    assert speed == pytest.approx(let_go * pull, abs=1e-4)
