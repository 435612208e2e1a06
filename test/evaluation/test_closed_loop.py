"""What a closed loop showed."""

from __future__ import annotations

import math
from types import SimpleNamespace as Fake

import pytest

from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.evaluation.graph_outputs import LoopCollector

LENGTH = 0.007


def header(stamp: int) -> Fake:
    """Return a header with a stamp [ns]."""
    return Fake(stamp=Fake(sec=stamp // 10**9, nanosec=stamp % 10**9))


def planar(x: float, y: float, angle: float) -> Fake:
    """Return a pose in the plane."""
    turned = Fake(x=0.0, y=0.0, z=math.sin(0.5 * angle), w=math.cos(0.5 * angle))
    return Fake(position=Fake(x=x, y=y, z=0.0), orientation=turned)


class Loop:
    """A collector that is told of frames."""

    def __init__(self, curvature: float = 0.0) -> None:
        self.collector = LoopCollector(0.019, LENGTH, curvature, 100.0)

    def truth(self, stamp: int, x: float = 0.0, y: float = 0.0, angle: float = 0.0) -> None:
        """Say where the needle really was."""
        message = Fake(header=header(stamp), pose=planar(x, y, angle))
        self.collector.add("/ground_truth/needle", stamp, message)

    def pose(self, stamp: int, x: float = 0.0, y: float = 0.0, angle: float = 0.0, after: int = 0) -> None:
        """Say where it was tracked, and what the tracker said of the frame."""
        message = Fake(header=header(stamp), pose=Fake(pose=planar(x, y, angle)))
        self.collector.add("/needle/measured_cp", stamp + after, message)
        self.state(stamp, 1)

    def state(self, stamp: int, state: int) -> None:
        """Say what the tracker said of a frame."""
        message = Fake(header=header(stamp), state=state, processing_time=0.004)
        self.collector.add("/needle/tracker_state", stamp, message)

    def wish(self, stamp: int, x: float, y: float = 0.0) -> None:
        """Say where the path wanted the tip."""
        self.collector.add("/needle/setpoint_cp", stamp, Fake(header=header(stamp), pose=planar(x, y, 0.0)))


def test_errors_are_against_the_truth_of_the_same_frame():
    loop = Loop()
    for index in range(4):
        stamp = 10**9 + index * 10**7
        loop.truth(stamp, x=1e-3 * index, angle=0.1)
        loop.pose(stamp, x=1e-3 * index + 3e-5, y=4e-5, angle=0.11, after=5_000_000)
        tip = 1e-3 * index + LENGTH * math.cos(0.1), LENGTH * math.sin(0.1)
        loop.wish(stamp, tip[0] + 2e-4, tip[1])
    summary = loop.collector.summary("x")
    assert summary.tail_error == pytest.approx(5e-5)
    assert summary.heading_error == pytest.approx(0.01)
    assert summary.path_error == pytest.approx(2e-4)
    assert summary.path_error_greatest == pytest.approx(2e-4)
    assert (summary.frames, summary.tracked, summary.lost, summary.wrong) == (4, 4, 0, 0)
    assert summary.duration == pytest.approx(0.03)
    latency = summary.latency["needle/measured_cp"]
    assert latency is not None
    assert latency.median == pytest.approx(0.005)


@pytest.mark.parametrize(
    ("x", "angle", "wrong"), [(2.9e-4, 0.0, 0), (3.1e-4, 0.0, 1), (0.0, 0.08, 0), (0.0, 0.09, 1), (0.0, math.pi, 1)]
)
def test_a_pose_far_from_the_truth_is_counted_as_wrong(x: float, angle: float, wrong: int):
    loop = Loop()
    loop.truth(10**9)
    loop.wish(10**9, LENGTH)
    loop.pose(10**9, x=x, angle=angle)
    assert loop.collector.summary("x").wrong == wrong


def test_only_the_time_of_steering_counts():
    loop = Loop()
    for index in range(10):
        stamp = 10**9 + index * 10**7
        loop.truth(stamp)
        if 3 <= index <= 6:
            loop.wish(stamp, LENGTH)
        if index != 5:
            loop.pose(stamp)
        else:
            loop.state(stamp, 2)
    done = Fake(name="path_follower: state", message="done")
    loop.collector.add("/diagnostics", 10**9, Fake(header=header(10**9), status=[done]))
    summary = loop.collector.summary("x")
    assert (summary.frames, summary.tracked, summary.lost, summary.skipped) == (4, 3, 1, 0)


def test_a_run_without_a_pose_says_what_the_nodes_said():
    loop = Loop()
    loop.truth(10**9)
    status = Fake(name="vision_tracker: state", message="searching: no dish in the image")
    loop.collector.add("/diagnostics", 10**9, Fake(header=header(10**9), status=[status]))
    with pytest.raises(GraphError, match="no dish in the image"):
        loop.collector.summary("x")
