"""Topics: what a subscriber with ROS's defaults gets, and what a replay changes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from geometry_msgs.msg import TwistStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message

from magnetosuture_thread.coils.inputs import PublisherCounter
from magnetosuture_thread.interface import CAMERA
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.scene_server import SceneServerNode
from magnetosuture_thread.nodes.thread_model import ThreadModelNode


def test_ros2_bag_gets_the_quality_of_service_of_topics_whose_last_message_is_kept():
    file = Path(__file__).parents[2] / "config" / "ros2_bag" / "qos.yaml"
    every = {topic.channel.recorded: topic for topic in vars(topics).values() if isinstance(topic, topics.Topic)}
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


def test_only_camera_and_pose_are_sensor_data():
    said = (*topics.INPUTS, *topics.OUTPUTS)
    sensors = {topic.channel.name for topic in said if topic.qos.reliability == ReliabilityPolicy.BEST_EFFORT}
    cameras = {channel.name for channel in CAMERA.values()}
    assert sensors == {*cameras, "camera/camera_info", "needle/measured_cp"}


def test_what_is_constant_is_latched(graph):
    graph.add(SceneServerNode, scene="dish_35mm_post")
    late, markers = graph.listen(topics.SCENE), graph.listen(topics.SCENE_MARKERS)
    graph.wait(lambda: bool(late and markers), "the scene, published before anybody listened")


def test_settings_are_latched_and_no_input_of_a_replay():
    assert all(topic.qos is topics.LATCHED for topic in topics.SETTINGS)
    assert not any(topic in (*topics.INPUTS, *topics.OUTPUTS) for topic in topics.SETTINGS)


@pytest.mark.parametrize("depth", [5, 300])
def test_a_replay_makes_every_queue_reliable_and_deep(depth: int):
    overrides = topics.lossless(depth)["/**"]["ros__parameters"]["qos_overrides"]
    for topic in (*topics.INPUTS, *topics.OUTPUTS):
        if topic.qos is topics.LATCHED:
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


@pytest.mark.parametrize("unknown", [None, 2**64 - 1])
@pytest.mark.parametrize(("publishers", "speaking"), [(1, 1), (2, 20)])
def test_where_nobody_numbers_messages_the_publishers_are_counted(graph, monkeypatch, unknown, publishers, speaking):
    taken: list[int] = []
    callbacks: list[Any] = []

    class Counted:
        def get_publisher_count(self) -> int:
            return publishers

    def subscribe(kind: Any, name: str, callback: Any, *_: Any, **__: Any) -> Counted:
        callbacks.append(callback)
        return Counted()

    monkeypatch.setattr(graph.probe, "create_subscription", subscribe)
    topics.NEEDLE_COMMAND.subscribe_numbered(graph.probe, lambda message, number: taken.append(number))
    counter = PublisherCounter()
    for index in range(20):
        callbacks[0](serialize_message(TwistStamped()), {"publication_sequence_number": unknown})
        counter.update(taken[-1], 0.01 * index)
    assert counter.count(0.2) == speaking
