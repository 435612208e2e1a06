"""Topics: what a subscriber with ROS's defaults gets, and what a replay changes."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from magnetosuture_thread import interface
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.thread_model import ThreadModelNode


def test_ros2_bag_gets_the_quality_of_service_of_topics_whose_last_message_is_kept():
    file = Path(__file__).parents[2] / "config" / "ros2_bag" / "qos.yaml"
    channels = [each for each in vars(interface).values() if isinstance(each, interface.Channel)]
    every = {channel.recorded: topics.topic_of(channel) for channel in channels}
    assert yaml.safe_load(file.read_text()) == {
        name: {
            "history": topic.qos.history.short_key,
            "depth": topic.qos.depth,
            "reliability": topic.qos.reliability.short_key,
            "durability": topic.qos.durability.short_key,
        }
        for name, topic in every.items()
        if topic.qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
    }


@pytest.mark.parametrize("depth", [5, 300])
def test_a_replay_makes_every_queue_reliable_and_deep(depth: int):
    overrides = topics.lossless(depth)["/**"]["ros__parameters"]["qos_overrides"]
    for topic in (*topics.INPUTS, *topics.OUTPUTS):
        if topic.channel.quality is interface.Quality.LATCHED:
            assert topic.channel.recorded not in overrides
        else:
            for role in ("publisher", "subscription"):
                assert overrides[topic.channel.recorded][role] == {"reliability": "reliable", "depth": depth}


def test_the_overrides_take_effect(graph):
    overrides = topics.lossless(123)["/**"]["ros__parameters"]["qos_overrides"]
    parameters = {
        f"qos_overrides.{name}.{role}.{policy}": value
        for name, roles in overrides.items()
        for role, policies in roles.items()
        for policy, value in policies.items()
    }
    shared = [(topic.qos.reliability, topic.qos.depth) for topic in (*topics.INPUTS, *topics.OUTPUTS)]
    node = graph.add(ThreadModelNode, **parameters)
    # Of this node only: rclpy writes overrides into the profile it is given, which all nodes of a process share.
    assert [(topic.qos.reliability, topic.qos.depth) for topic in (*topics.INPUTS, *topics.OUTPUTS)] == shared
    infos = node.get_subscriptions_info_by_topic("/needle/measured_cp")
    assert infos[0].qos_profile.reliability == ReliabilityPolicy.RELIABLE
    assert QoSProfile(depth=1).durability == DurabilityPolicy.VOLATILE
    own = next(s for s in node.subscriptions if s.topic_name == "/needle/measured_cp")
    assert own.qos_profile.depth == 123
