"""Messages of a graph put side by side: the figures of a replay and of a closed loop."""

from __future__ import annotations

import math
from types import SimpleNamespace as Message
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.evaluation.frames import CurrentSeries, GraphCollector
from magnetosuture_thread.evaluation.metrics import RunMetrics, stage_latencies
from magnetosuture_thread.evaluation.tables import LoopCollector
from magnetosuture_thread.settings.errors import GraphError
from test.shared import known

STRAIGHT = np.column_stack([-0.25 * np.arange(5), np.zeros(5)])
UP = np.array([0.0, 0.01])
LENGTH = 0.007  # m; of the needle


def header(nanoseconds: int) -> Message:
    """Return a header."""
    return Message(stamp=Message(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9))


def path(second: int, points: np.ndarray) -> Message:
    """Return a path."""
    poses = [Message(pose=Message(position=Message(x=x, y=y))) for x, y in points]
    return Message(header=header(second * 10**9), poses=poses)


def prediction(second: int, points: np.ndarray, **more: Any) -> Message:
    """Return a predicted thread."""
    positions, strain = [Message(x=x, y=y) for x, y in points], [0.0, -0.002, 0.001, 0.0]
    header_ = header(second * 10**9)
    return Message(header=header_, positions=positions, strain=strain, residual=1e-8, step_time=0.004, **more)


def margins(second: int, clearance: float, valid: bool = True) -> Message:
    """Return margins of one obstacle row for node 3 and one connectivity row for node 1."""
    return Message(
        header=header(second * 10**9),
        valid=valid,
        scene_version="",
        barrier_names=["connectivity", "obstacle"],
        barrier=[0, 1],
        node=[1, 3],
        obstacle=[-1, 0],
        value=[1e-9, clearance],
        clearance=[1e-9, clearance],
        contact_nodes=[3] if clearance <= 0.0 else [],
        friction_state=1,
        friction_nodes=[],
        slowdown=1.0,
    )


def test_messages_of_one_stamp_are_put_together():
    collector = GraphCollector()
    for k, clearance in ((1, 0.5), (2, -0.1), (3, 0.2)):
        force = Message(x=3.0 - k, y=0.0)
        collector.add("/thread/predicted", prediction(k, STRAIGHT, tension=[0.5, 1.0], needle_force=force))
        wrench = Message(force=Message(x=4.0 * k, y=0.0))
        collector.add("/ground_truth/thread_pull", Message(header=header(k * 10**9), wrench=wrench))
        collector.add("/thread/measured", path(k, STRAIGHT + UP))
        collector.add("/thread/margins", margins(k, clearance))
    collector.add("/ground_truth/thread", path(2, STRAIGHT + 2.0 * UP))
    collector.add("/thread/measured", path(9, STRAIGHT))  # without a prediction
    collector.add("/thread/margins", margins(9, -7.0, valid=False))
    instants = collector.frames()
    metrics = RunMetrics.of(1.0, instants, 10**9)
    assert [instant.stamp for instant in instants] == [10**9, 2 * 10**9, 3 * 10**9]
    assert [instant.errors["seen"] for instant in instants] == pytest.approx([1.0] * 3)
    assert [instant.errors["truth"] for instant in instants] == pytest.approx([math.nan, 2.0, math.nan], nan_ok=True)
    assert instants[0].strain == pytest.approx(0.002)
    assert instants[0].clearance.tolist() == [np.inf, np.inf, np.inf, 0.5, np.inf]
    assert metrics.contact_frames == 1
    assert (metrics.maximum("tension"), metrics.maximum("pull")) == (1.0, 2.0)
    squared = np.array([2.0, 7.0, 12.0]) ** 2  # differences over the greatest pull
    assert metrics.pull_error_percent == pytest.approx(100.0 * math.sqrt(squared.mean()) / 12.0)
    assert [(m.kind, m.clearance, m.node, m.obstacle, m.time) for m in metrics.minimum_margins.values()] == [
        ("connectivity", 1e-9, 1, -1, 0.0),
        ("obstacle", -0.1, 3, 0, 1.0),
    ]


def test_latencies_pair_stamps():
    published = {"camera/image_raw/compressed": {1: 0.0, 2: 1.0}, "needle/servo_cv": {1: 0.5}}
    arrived = {"needle/measured_cp": {1: 0.01, 2: 1.03}, "thread/predicted": {2: 1.04}, "coils/currents": {7: 0.1}}
    found = stage_latencies(published, arrived, applied={1})
    pose, step = known(found["frame to needle pose"]), known(found["pose to prediction"])
    assert (pose.median, pose.maximum, step.median) == pytest.approx((0.02, 0.03, 0.01))
    assert found["command to currents"] is None


def series(*currents: tuple[float, list[float], str]) -> CurrentSeries:
    """Return a series of currents by time [s], with why they are a stop."""
    made = CurrentSeries()
    for time, current, stop in currents:
        made.add(Message(header=header(round(time * 1e9)), current=current, stop=stop))
    return made


def test_currents_are_compared_with_those_in_force():
    recorded = series((1.0, [1.0, 0.0], ""), (1.01, [2.0, 0.0], ""), (1.02, [3.0, 0.0], "no command"))
    replayed = series((1.013, [2.5, 0.0], ""), (1.0199, [2.0, 0.0], ""), (1.03, [3.0, 0.0], ""))
    found = known(replayed.against(recorded))
    assert (found.compared, found.greatest, found.difference) == (3, 0.5, 0.0)
    assert found.recorded == pytest.approx((17.0 / 6.0) ** 0.5)
    assert found.stopped_apart == pytest.approx(1.0 / 3.0)
    for other in (series((0.9, [1.0, 0.0], ""), (1.08, [1.0, 0.0], "")), series((1.0, [1.0], "")), series()):
        assert other.against(recorded) is None  # nothing in force, another number of coils, nothing
    assert replayed.against(series()) is None


def planar(x: float, y: float, angle: float) -> Message:
    """Return a pose in the plane."""
    turned = Message(x=0.0, y=0.0, z=math.sin(0.5 * angle), w=math.cos(0.5 * angle))
    return Message(position=Message(x=x, y=y, z=0.0), orientation=turned)


class Loop:
    """A collector that is told of frames, 10 ms apart from a second on."""

    def __init__(self) -> None:
        self.collector = LoopCollector(0.019, LENGTH, 0.0, 100.0)

    def add(self, topic: str, k: int, after: int = 0, **fields: Any) -> None:
        """Add a message about a frame that arrives so much after it [ns]."""
        stamp = 10**9 + k * 10**7
        self.collector.add(topic, stamp + after, Message(header=header(stamp), **fields))

    def truth(self, k: int, x: float = 0.0, angle: float = 0.0) -> None:
        """Add where the needle really was."""
        self.add("/ground_truth/needle", k, pose=planar(x, 0.0, angle))

    def pose(self, k: int, x: float = 0.0, y: float = 0.0, angle: float = 0.0, variance: float = 1e-4) -> None:
        """Add where it was tracked, after 5 ms, with a variance of its heading [rad^2]."""
        pose = Message(pose=planar(x, y, angle), covariance=[0.0] * 35 + [variance])
        self.add("/needle/measured_cp", k, 5_000_000, pose=pose)
        self.add("/needle/tracker_state", k, state=1, processing_time=0.004)

    def setpoint(self, k: int, x: float = LENGTH, y: float = 0.0) -> None:
        """Add where the path wanted the tip."""
        self.add("/needle/setpoint_cp", k, pose=planar(x, y, 0.0))

    def health(self, name: str, text: str) -> None:
        """Add what a node says of itself."""
        self.add("/diagnostics", 0, status=[Message(name=f"{name}: state", message=text)])


def test_errors_are_against_the_truth_of_the_same_frame():
    loop = Loop()
    for k in range(4):
        loop.truth(k, x=1e-3 * k, angle=0.1)
        loop.pose(k, x=1e-3 * k + 3e-5, y=4e-5, angle=0.11)
        loop.setpoint(k, 1e-3 * k + LENGTH * math.cos(0.1) + 2e-4, LENGTH * math.sin(0.1))
    summary = loop.collector.summary("x")
    assert summary.tail_error == pytest.approx(5e-5)
    assert summary.heading_error == pytest.approx(0.01)
    assert (summary.path_error, summary.path_error_greatest) == pytest.approx((2e-4, 2e-4))
    assert (summary.frames, summary.tracked, summary.lost, summary.wrong) == (4, 4, 0, 0)
    assert summary.duration == pytest.approx(0.03)
    assert known(summary.latency["needle/measured_cp"]).median == pytest.approx(0.005)


@pytest.mark.parametrize(
    ("x", "angle", "wrong"), [(2.9e-4, 0.0, 0), (3.1e-4, 0.0, 1), (0.0, 0.08, 0), (0.0, math.pi, 1)]
)
def test_a_pose_far_from_the_truth_is_counted_as_wrong(x: float, angle: float, wrong: int):
    loop = Loop()
    loop.truth(0)
    loop.setpoint(0)
    loop.pose(0, x=x, angle=angle)
    assert loop.collector.summary("x").wrong == wrong


def test_an_axis_whose_direction_is_unknown_is_no_wrong_pose():
    loop = Loop()
    for k in range(2):
        loop.truth(k)
        loop.setpoint(k)
    loop.pose(0)
    loop.pose(1, x=LENGTH, angle=math.pi, variance=math.pi**2)
    summary = loop.collector.summary("x")
    assert (summary.tracked, summary.wrong, summary.heading_error) == (1, 0, 0.0)


def test_only_the_time_of_steering_counts():
    loop = Loop()
    for k in range(10):
        loop.truth(k)
        if 3 <= k <= 6:
            loop.setpoint(k)
        if k != 5:
            loop.pose(k)
        else:
            loop.add("/needle/tracker_state", k, state=2, processing_time=0.004)
    loop.health("path_follower", "done")
    summary = loop.collector.summary("x")
    assert (summary.frames, summary.tracked, summary.lost, summary.skipped) == (4, 3, 1, 0)


def test_a_run_without_a_pose_says_what_the_nodes_said():
    loop = Loop()
    loop.truth(0)
    loop.health("vision_tracker", "searching: no dish in the image")
    with pytest.raises(GraphError, match="no dish in the image"):
        loop.collector.summary("x")
