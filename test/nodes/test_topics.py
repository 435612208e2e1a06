"""Topics: what a subscriber with ROS's defaults gets, and what a replay changes."""

from __future__ import annotations

from pathlib import Path

import yaml
from rclpy.qos import DurabilityPolicy

from magnetosuture_thread import interface
from magnetosuture_thread.nodes import topics


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
