"""A bench of nodes that run: the real bridge with its lifecycle, and a tracker whose needle follows the currents."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from magnetosuture_msgs.msg import CoilCurrents
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.reading import stamp_of
from magnetosuture_thread.calibration.square import TipPath
from magnetosuture_thread.cli import main
from magnetosuture_thread.geometry.scene import Dish, Scene
from magnetosuture_thread.nodes import clients, live_bench, topics
from magnetosuture_thread.nodes.coil_bridge import CoilBridgeNode
from magnetosuture_thread.nodes.live_bench import LiveBench, LiveThreadBench
from magnetosuture_thread.nodes.node import ManagedNode
from magnetosuture_thread.rig.setups import Setup, read_setup
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import ConfigurationError, GraphError, InvalidInputError
from magnetosuture_thread.settings.interface import Service
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from test.nodes import wire
from test.nodes.bridge import press

pytestmark = pytest.mark.slow

SPEED = 0.01  # m/s for one ampere in the first coil, to the right
LEAST = np.array([0.1, 0.0, 0.0, 0.0])
BRIDGE = {"driver": "simulated", "scene": "dish_35mm", "commissioning": True}
BRIDGE |= {"command_timeout": 1.0, "driver_timeout": 0.6, "pose_timeout": 1.0}  # of a busy machine


class FakeTracker(ManagedNode[VisionTrackerSettings]):
    """A tracker of a needle that goes to the right while the first coil has a current."""

    def __init__(self, **options: Any) -> None:
        super().__init__("vision_tracker", VisionTrackerSettings, **options)
        self.x, self.current, self._until = 0.0, 0.0, time.time()
        topics.RIG_CURRENTS.subscribe(self, self.on_currents)
        self.start()

    def allocate(self, settings: VisionTrackerSettings) -> None:
        """Publish poses."""
        self._poses = topics.NEEDLE_POSE.publisher(self)
        self.every(1.0 / 60.0, self.while_active(self.publish))

    def on_currents(self, message: CoilCurrents) -> None:
        """Take the current of the first coil."""
        self.move()
        self.current = float(message.current[0])

    def move(self) -> None:
        """Move for the time that has gone by since the last call."""
        now = time.time()
        self.x, self._until = self.x + (now - self._until) * SPEED * self.current, now

    def publish(self) -> None:
        """Show the needle."""
        self.move()
        tail = np.array([self.x - 0.5 * self.configured_settings.needle_length, 0.0])
        self._poses.publish(wire.pose_message(self.get_clock().now().to_msg(), tail, np.array([1.0, 0.0])))


@pytest.fixture(scope="module")
def setup() -> Setup:
    """Return what is believed."""
    return read_setup("petri_35mm_polyamide")


@pytest.fixture
def opened(graph: Any, setup: Setup, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[LiveBench, Any, Any]]:
    """Return a function that starts bridge and tracker, and opens a bench on them whose needle has a length."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(graph.domain))

    def opening(
        length: float = 7e-3, check: Callable[[], None] = lambda: None, **parameters: Any
    ) -> tuple[LiveBench, Any, Any]:
        monkeypatch.setattr(LiveBench, "_measure_needle", lambda bench: length)
        monkeypatch.setattr(live_bench, "PATIENCE", 30.0)  # s; of a busy machine
        bridge, tracker = graph.add(CoilBridgeNode, **{**BRIDGE, **parameters}), graph.add(FakeTracker)
        return LiveBench(setup, check), bridge, tracker

    return opening


def test_a_bridge_that_does_not_commission_is_refused_with_the_way_out(opened: Callable[..., Any]):
    with pytest.raises(ConfigurationError, match=r"commissioning: got False, expected true: start the bridge by -p"):
        opened(commissioning=False)


def check_refused_until_reset(graph: Any, setup: Setup, bridge: CoilBridgeNode, reason: str) -> None:
    """Check that a bench is refused by the reason of the latch, which it leaves; and press reset."""
    with pytest.raises(GraphError, match=f"coil_bridge: {reason}"):
        LiveBench(setup, lambda: None)
    assert not bridge.system.latch.armed
    assert press(graph, Service.RESET).success


def test_a_bridge_that_disarms_ends_it_and_the_next_run_goes_on_once_it_is_reset(
    graph: Any, setup: Setup, opened: Callable[..., Any]
):
    bench, bridge, tracker = opened()
    with bench:
        bridge.system.latch.trip("driver: a board is off")
        with pytest.raises(GraphError, match="driver: a board is off"):
            bench.pulse(LEAST, 0.1)
    assert tracker.x == 0.0
    check_refused_until_reset(graph, setup, bridge, "driver: a board is off")
    assert press(graph, Service.EMERGENCY_STOP).success
    check_refused_until_reset(graph, setup, bridge, "emergency stop")
    with LiveBench(setup, lambda: None) as again:
        assert again.pulse(LEAST, 0.1).ended == ""


def test_a_pulse_is_given_and_seen_from_before_until_the_needle_rests(opened: Callable[..., Any]):
    bench, bridge, _ = opened()
    with bench:
        pulse = bench.pulse(LEAST, 0.3)
        assert pulse.ended == ""
        assert pulse.off > pulse.on
        assert pulse.times[0] < pulse.on < pulse.off < pulse.times[-1] - 0.3
        assert pulse.poses[-1, 0] > pulse.poses[0, 0]
        far = bench.pulse(20.0 * LEAST, 0.5)
        assert far.ended.startswith("the needle ")
        rest = bench.pulse(np.zeros(4), 0.2)
        assert np.ptp(rest.poses[:, 0]) == 0.0
        with pytest.raises(GraphError, match="at most 10 A"):
            bench.pulse(1e3 * LEAST, 0.1)
        assert bridge.system.latch.armed
    assert not bridge.system.latch.armed


def test_an_emergency_stop_ends_a_pulse_and_the_bench_recovers(opened: Callable[..., Any]):
    bench, bridge, _ = opened()
    with bench:
        for _ in range(5):  # of which a busy machine may press the last one too late
            pulse, begun, over = bench.disturbed_pulse(LEAST, 0.5, 0.0, bench.stopped(), 0.1)
            assert bridge.system.latch.emergency
            assert begun < over < pulse.times[-1]
            bench.recover(("emergency stop",))
            assert bridge.system.latch.armed
            if pulse.ended == "emergency stop":
                break
        assert pulse.ended == "emergency stop"
    assert not bridge.system.latch.armed


def test_a_stop_that_no_check_has_pressed_is_not_reset_and_lets_no_pulse_begin(opened: Callable[..., Any]):
    bench, bridge, _ = opened()
    with bench:
        bench.execute("stop")
        for causes in ((), ("the bridge stood still", "driver")):
            with pytest.raises(GraphError, match="emergency stop"):
                bench.recover(causes)
        with pytest.raises(GraphError, match="emergency stop"):
            bench.pulse(LEAST, 0.1)
        assert bridge.system.latch.emergency


def test_a_bench_is_blind_while_the_tracker_is_inactive_and_sees_again(opened: Callable[..., Any]):
    bench, bridge, tracker = opened()
    with bench:
        with bench.blind():
            assert not tracker.is_active
            bench.wait(1.1)
            with pytest.raises(InvalidInputError, match="no needle pose for 1 s"):
                bridge.system.bridge.pulse(LEAST, 0.1, *bridge._times(), bridge.system.driver_state)
        assert tracker.is_active
        assert np.ptp(bench.pulse(LEAST, 0.1).poses[:, 0]) > 0.0


def test_an_interrupt_amid_a_pulse_leaves_zero_currents_and_a_bridge_that_is_disarmed(opened: Callable[..., Any]):
    pressed: list[bool] = []

    def check() -> None:
        if pressed and tracker.current:
            raise KeyboardInterrupt

    bench, bridge, tracker = opened(6.5e-3, check)
    assert bridge.settings.needle_length == tracker.settings.needle_length == 6.5e-3
    pressed.append(True)
    with pytest.raises(KeyboardInterrupt), bench:
        deque((bench.pulse(LEAST, 0.5) for _ in range(20)), maxlen=0)  # a busy machine may not look amid the first
    assert not bridge.system.latch.armed
    assert not bridge.system.output.allocation.currents.any()
    assert bridge.settings.needle_length == tracker.settings.needle_length == 7e-3  # as they were
    assert bridge.settings.commissioning


def test_without_poses_it_says_what_the_tracker_says(opened: Callable[..., Any], monkeypatch: pytest.MonkeyPatch):
    bench, _, _ = opened()
    with bench, bench.blind():
        bench.wait(0.5)
        monkeypatch.setattr(live_bench, "PATIENCE", 0.3)
        with pytest.raises(InvalidInputError, match=r"no pose for 0\.3 s: inactive"):
            bench.pulse(LEAST, 0.1)


def test_a_square_is_steered_by_commands_and_the_bridge_is_as_it_was(
    opened: Callable[..., Any], setup: Setup, monkeypatch: pytest.MonkeyPatch
):
    """This needle goes to the right alone, so the bridge finds out that it does not follow."""
    bench, bridge, _ = opened()
    with bench:
        apart, problem = bench.follow_square(setup.coils)
        assert apart == np.inf
        assert "needle does not follow" in problem
    assert bridge.settings.commissioning
    assert bridge.settings.without_prediction == "stop"


def test_the_command_refuses_by_name_where_nothing_runs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(clients, "TIMEOUT", 0.5)
    options = ["--live", "--namespace", "/nowhere", "--output", str(tmp_path / "rig")]
    assert main(["commission", "petri_35mm_polyamide", *options]) == 1
    assert "no coil_bridge state received on this ROS domain" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["commission", "petri_35mm_polyamide", "--rig", "random:1", *options])


class FirstStretch(TipPath):
    """A path that is done after some poses, at each of which the needle rests."""

    poses = 0

    @property
    def done(self) -> bool:
        """Whether so many have come."""
        return self.poses >= 40

    def command(self, stamp: float, pose: np.ndarray, age: float) -> np.ndarray:
        """Count the pose."""
        self.poses += 1
        return 0.0 * super().command(stamp, pose, age)


class SlowClock(ManagedNode[VisionTrackerSettings]):
    """A clock that goes at half the speed of the computer's, from 1 s on."""

    def __init__(self, **options: Any) -> None:
        super().__init__("slow_clock", VisionTrackerSettings, **options)
        began, published = time.time(), topics.CLOCK.publisher(self)

        def publish() -> None:
            now = Time(seconds=1.0 + 0.5 * (time.time() - began))
            published.publish(Clock(clock=now.to_msg()))

        self.create_timer(0.01, publish)  # by the computer's clock, which this node has


@pytest.mark.parametrize("simulated", [False, True])
def test_a_path_is_followed_with_the_values_of_a_setup_and_recorded_on_the_rig_s_clock(
    graph: Any, setup: Setup, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, simulated: bool
):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(graph.domain))
    monkeypatch.setattr(live_bench, "PATIENCE", 30.0)  # s; of a busy machine
    alone = {"commissioning": False, "without_prediction": "slow", "speed_without_prediction": 2e-3}
    if simulated:
        graph.add(SlowClock)
    bridge = graph.add(CoilBridgeNode, use_sim_time=simulated, **{**BRIDGE, **alone})
    graph.add(FakeTracker, use_sim_time=simulated)
    before = bridge.configured_settings.max_pull
    other = replace(setup, coils=replace(setup.coils, max_pull=3.0 * setup.coils.max_pull)).with_scene(setup.scene)
    path = FirstStretch(7e-3, np.array([[6e-3, 0.0], [8e-3, 0.0]]))
    with LiveThreadBench(setup, lambda: None) as bench:
        bench.follow(path, other, tmp_path / "bag")
        assert path.done
        assert bridge.configured_settings.max_pull == other.coils.max_pull
        assert not bridge.system.latch.armed
    assert bridge.configured_settings.max_pull == before
    bag = Bag(tmp_path / "bag")
    counts = bag.counts
    assert counts[interface.NEEDLE_POSE.recorded] >= 40
    assert counts[interface.CURRENTS.recorded] > 10
    assert counts[interface.SCENE.recorded] == 1
    for record in bag.records({interface.NEEDLE_POSE.recorded}):  # a minute of the slow clock, or years of the other
        assert (stamp_of(record) < 6e10) is simulated
        assert (record.time < 6e10) is simulated
    with pytest.raises(ConfigurationError, match=r"scene of the rig: got .* the setup's dish without shapes"):
        LiveThreadBench(setup.with_scene(Scene(Dish(0.05))), lambda: None)
