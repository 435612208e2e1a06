"""A node that follows the scene: from its file, then from the topic, whatever comes on it."""

from __future__ import annotations

from typing import Any

import pytest
from rclpy.serialization import serialize_message

from magnetosuture_thread.bags.reading import parse_scene_message
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.geometry.scene_files import read_scene
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.node import GuardedNode, SceneFollower
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError
from test.geometry.scene.scenes import every_shape
from test.nodes import wire

POST, HERNIA = read_scene("dish_35mm_post"), read_scene("hernia_ring")


class FollowerNode(GuardedNode):
    """A node that only follows, and may refuse a scene."""

    def __init__(self, file: str = "", **options: Any) -> None:
        super().__init__("follower", **options)
        self.changes: list[Scene] = []
        self.refusal: ConfigurationError | None = None
        self.health.ok("following")
        self.follower = SceneFollower(self, self.take, read_scene(file) if file else None)

    def take(self, scene: Scene) -> None:
        """Take a scene, or refuse it."""
        if self.refusal is not None:
            raise self.refusal
        self.changes.append(scene)


@pytest.fixture
def node(graph) -> FollowerNode:
    """A node that has read the scene with a post."""
    return graph.add(lambda **options: FollowerNode("dish_35mm_post", **options))


def publish(graph: Any, scene: Scene) -> None:
    """Publish a scene."""
    graph.publish(topics.SCENE, wire.scene_message(graph.now(), scene))


def values(reports: list[Any]) -> dict[str, str]:
    """Return the values of the last report."""
    return {each.key: each.value for each in reports[-1].status[0].values}


def refused(graph: Any, reports: list[Any], words: str) -> None:
    """Wait until the node's health has a refusal with these words."""
    graph.wait(lambda: any(words in report.status[0].message for report in reports), f"the refusal: {words}")


def test_the_scene_of_the_file_is_in_force_until_another_comes(graph, node):
    assert node.follower.scene == POST
    publish(graph, POST)  # the scene server has read the same file
    publish(graph, HERNIA)
    graph.wait(lambda: node.follower.version == HERNIA.version, "the next scene")
    publish(graph, every_shape())
    graph.wait(lambda: node.follower.version == every_shape().version, "the last scene")
    assert node.changes == [HERNIA, every_shape()]


def test_a_damaged_message_is_reported_and_the_scene_before_stays(graph, node):
    reports = graph.listen(topics.DIAGNOSTICS)
    message = wire.scene_message(graph.now(), HERNIA)
    message.shapes[0].polygon[0].outline.corners[7].y += 1e-9
    graph.publish(topics.SCENE, message)
    refused(graph, reports, "refused: scene.version: got ")
    assert (node.follower.scene, node.changes) == (POST, [])
    assert node.follower.problem.startswith("scene refused: scene.version: got ")
    assert node.follower.load("dish_35mm_post") == POST
    assert node.follower.problem  # a node that is configured again has not heard it any better
    publish(graph, HERNIA)
    graph.wait(lambda: node.follower.scene == HERNIA, "a good one")
    assert node.follower.problem == ""


def test_a_scene_that_the_node_cannot_use_is_reported_and_the_one_before_stays(graph, node):
    reports = graph.listen(topics.DIAGNOSTICS)
    node.refusal = ConfigurationError("coil_bridge.keep_out", 0.02, "at most 0.01 m in this dish")
    publish(graph, HERNIA)
    refused(graph, reports, "refused: coil_bridge.keep_out: got 0.02, expected at most 0.01 m in this dish")
    assert node.follower.scene == POST
    assert node.follower.problem.startswith("scene refused: coil_bridge.keep_out: got 0.02")
    graph.wait(lambda: values(reports).get("scene problem") == node.follower.problem, "the problem beside the state")
    publish(graph, POST)  # which is in force
    graph.wait(lambda: not node.follower.problem, "the scene before, told again")
    node.refusal = None
    publish(graph, HERNIA)  # again, as it is not in force
    graph.wait(lambda: node.follower.scene == HERNIA, "the scene")


def test_bytes_that_are_no_scene_are_refused():
    whole = serialize_message(wire.scene_message(wire.time(0), every_shape()))
    assert parse_scene_message(topics.SCENE.decode(whole)) == every_shape()
    assert len(whole) < topics.SCENE.max_bytes
    for length in (0, 40, len(whole) // 2, len(whole) - 9):
        with pytest.raises(InvalidInputError, match=r"^scene"):
            parse_scene_message(topics.SCENE.decode(whole[:length]))
    with pytest.raises(InvalidInputError, match=r"^scene: got \d+ bytes, expected at most "):
        topics.SCENE.decode(bytes(topics.SCENE.max_bytes + 1))
    with pytest.raises(InvalidInputError, match=r"^scene\.version: got"):  # ROS replaces what is no UTF-8
        parse_scene_message(topics.SCENE.decode(whole.replace(b"gripper", b"grip\xff\xfe\xfd")))
