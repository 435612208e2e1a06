"""Playing messages into a graph: the time, and what gets lost."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.serialization import serialize_message

from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.interface import MARGINS, NEEDLE_POSE
from magnetosuture_thread.nodes import player, timeline, topics
from magnetosuture_thread.nodes.player import LiveReplay, Losses
from magnetosuture_thread.nodes.timeline import Timeline
from test.nodes import wire


def test_time_stands_still_before_it_begins_and_while_it_is_paused(monkeypatch: pytest.MonkeyPatch):
    now = [50.0]  # s
    monkeypatch.setattr(timeline, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    line = Timeline(3 * 10**9, 2.0)
    now[0] += 1.0
    assert line.now() == 3 * 10**9
    line.begin()
    now[0] += 1.0
    assert line.now() == 5 * 10**9
    assert line.left(6 * 10**9) == pytest.approx(0.5)
    line.pause(True)
    now[0] += 7.0
    assert line.paused
    assert line.now() == 5 * 10**9
    assert math.isinf(line.left(6 * 10**9))
    line.pause(False)
    now[0] += 0.25
    assert line.now() == round(5.5e9)
    line.begin()
    assert line.now() == 3 * 10**9


def diagnostics(node: str, **values: int) -> bytes:
    """Return what a node says of itself."""
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return serialize_message(DiagnosticArray(status=[DiagnosticStatus(name=f"{node}: state", values=pairs)]))


def test_losses_are_counted_by_the_way_on_which():
    losses = Losses()
    losses.played = Counter({"camera/image_raw/compressed": 10, "needle/servo_cv": 7})
    losses.count_diagnostics(diagnostics("vision_tracker", frames=8, refused=1))
    losses.count_diagnostics(diagnostics("thread_model", refused=1))
    assert losses.frames_waiting
    for stamp in range(8):
        losses.heard("needle/measured_cp", stamp, stamp + 1)
    for stamp in range(5):
        losses.heard("thread/margins", stamp, stamp + 1)
        if stamp != 2:
            losses.heard("thread/predicted", stamp, stamp + 1)
    assert losses.poses_waiting
    assert losses.dropped() == {
        "frames not taken by vision_tracker": 2,
        "poses without an answer": 2,  # of three, one was refused
        "outputs lost by the recording": 1,
    }


@dataclass
class Recorded:
    """A recorded pose."""

    time: int
    topic: str = NEEDLE_POSE.recorded

    @property
    def data(self) -> bytes:
        """Return its bytes."""
        stamp = Time(sec=self.time // 10**9, nanosec=self.time % 10**9)
        return serialize_message(wire.pose_message(stamp, np.zeros(2), np.array([1.0, 0.0])))


def test_poses_that_a_graph_does_not_answer_are_counted(graph, monkeypatch: pytest.MonkeyPatch):
    """Here the graph is a probe that answers every other pose."""
    monkeypatch.setattr(player, "SETTLE", 0.5)
    monkeypatch.setattr(player, "STUCK", 3.0)
    for topic in topics.OUTPUTS:
        if topic.channel is not MARGINS and topic.channel is not NEEDLE_POSE:
            topic.publisher(graph.probe)
    margins = topics.MARGINS.publisher(graph.probe)
    asked: list[Any] = []

    def answer(message: Any) -> None:
        asked.append(message)
        if len(asked) % 2:
            margins.publish(wire.no_margins(message.header.stamp, "for a test"))

    graph.probe.create_subscription(topics.NEEDLE_POSE.message, topics.NEEDLE_POSE.name, answer, 100)
    graph.probe.create_subscription(topics.CLOCK.message, topics.CLOCK.name, lambda message: None, 100)
    heard: list[tuple[str, int]] = []
    live = LiveReplay(
        graph.domain,
        Timeline(10**9, 5.0),
        played=[topics.NEEDLE_POSE, topics.MEASURED_THREAD],
        nodes=1,
        receive=lambda topic, time, data: heard.append((topic, time)),
        watch=lambda: None,
    )
    try:
        # Nobody is there for the seen thread.
        monkeypatch.setattr(player, "START_TIMEOUT", 0.5)
        with pytest.raises(GraphError, match=r"nobody at .*/thread/measured"):
            live.wait_for_graph()
        monkeypatch.setattr(player, "START_TIMEOUT", 60.0)
        graph.probe.create_subscription(
            topics.MEASURED_THREAD.message, topics.MEASURED_THREAD.name, lambda message: None, 100
        )
        live.wait_for_graph()
        times: list[float] = []
        live.play([Recorded(10**9 + k * 50_000_000) for k in range(8)], times.append)
    finally:
        live.close()
    assert times == pytest.approx([0.05 * k for k in range(8)])
    assert len(asked) == 8
    assert live.losses.played == {NEEDLE_POSE.name: 8}
    assert live.losses.dropped() == {"poses without an answer": 4, "outputs lost by the recording": 0}
    # What is played in place of a node's output is passed on with the outputs.
    assert [time for topic, time in heard if topic == NEEDLE_POSE.recorded] == [
        10**9 + k * 50_000_000 for k in range(8)
    ]
    assert sum(topic == MARGINS.recorded for topic, _ in heard) == 4
