"""Playing messages into a graph: the time, what gets lost, and who has to be there."""

from __future__ import annotations

import pytest
from nav_msgs.msg import Path
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock

from magnetosuture_thread.bags.reader import RecordedMessage
from magnetosuture_thread.nodes import player, topics
from magnetosuture_thread.nodes.executor import Timeline
from magnetosuture_thread.nodes.player import LiveReplay
from magnetosuture_thread.settings.errors import GraphError
from magnetosuture_thread.settings.interface import NEEDLE_POSE


def test_a_silence_of_54_years_is_left_out_and_named(graph, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(player, "QUIET", 1.5)
    clocks = list[int]()
    graph.probe.create_subscription(Clock, "/clock", lambda at: clocks.append(at.clock.sec), 1000)
    played, logged, line = [topics.MEASURED_THREAD], list[str](), Timeline(0, 5.0)
    live = LiveReplay(
        graph.domain,
        line,
        bag_start=-(10**9),
        played=played,
        nodes=1,
        receive=lambda *_: None,
        watch=lambda: None,
        log=logged.append,
    )
    data = serialize_message(Path())
    # The last silence, of 5.2 s, is shorter than what the replay waits for answers at this rate.
    times = [0, 10**8, 1_700_000_000_200_000_000, 1_700_000_000_300_000_000, 1_700_000_005_500_000_000]
    try:
        live.play([RecordedMessage("/thread/measured", "nav_msgs/msg/Path", at, data) for at in times], lambda at: None)
    finally:
        live.close()
    assert live.losses.played["thread/measured"] == 5
    assert line.now() >= times[-1]
    (first, *_) = logged
    assert first.startswith("no message for 1700000000.1 s from 1.100 s on")
    assert first.endswith("--start 1700000001.200 begins after it")
    assert clocks == sorted(clocks)


def test_a_graph_in_which_nobody_hears_an_input_is_not_complete(graph, monkeypatch: pytest.MonkeyPatch):
    """Here the graph is a probe with all outputs, which hears poses but not the thread."""
    monkeypatch.setattr(player, "SETTLE", 0.1)
    for topic in topics.OUTPUTS:
        if topic.channel is not NEEDLE_POSE:
            topic.publisher(graph.probe)
    for topic in (topics.NEEDLE_POSE, topics.CLOCK):
        graph.probe.create_subscription(topic.message, topic.name, lambda message: None, 100)
    live = LiveReplay(
        graph.domain,
        Timeline(10**9, 5.0),
        bag_start=10**9,
        played=[topics.NEEDLE_POSE, topics.MEASURED_THREAD],
        nodes=1,
        receive=lambda topic, time, data: None,
        watch=lambda: None,
    )
    try:
        monkeypatch.setattr(player, "START_TIMEOUT", 0.5)
        with pytest.raises(GraphError, match=r"nobody at .*/thread/measured"):
            live.wait_for_graph()
        monkeypatch.setattr(player, "START_TIMEOUT", 60.0)
        heard = topics.MEASURED_THREAD
        graph.probe.create_subscription(heard.message, heard.name, lambda message: None, 100)
        live.wait_for_graph()
    finally:
        live.close()
