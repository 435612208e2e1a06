"""The path follower in a graph."""

from __future__ import annotations

import time

import numpy as np
from builtin_interfaces.msg import Time

from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.path_follower import PathFollowerNode
from test.nodes import wire

EAST = np.array([1.0, 0.0])
BEGIN = int(time.time()) + 3600  # s; late poses are refused, however slowly a test runs


def pose(seconds: float, x: float):
    """Return a needle that points east."""
    stamp = Time(sec=BEGIN + int(seconds), nanosec=round((seconds % 1.0) * 1e9))
    return wire.pose_message(stamp, np.array([x, 0.0]), EAST)


def test_a_pose_that_was_long_on_its_way_gives_no_command(graph):
    """The command would be stamped as of now, and a bridge on another host would follow it."""
    graph.add(PathFollowerNode, settle=0.0, waypoints=[0.02, 0.0])
    commands, diagnostics = graph.listen(topics.NEEDLE_COMMAND), graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.NEEDLE_POSE, pose(time.time() - BEGIN - 2.0, 0.0))
    graph.wait(lambda: any("s old, expected at most 0.5 s" in d.status[0].message for d in diagnostics), "a refusal")
    graph.publish(topics.NEEDLE_POSE, pose(5.0, np.nan))
    graph.wait(lambda: {v.key: v.value for v in diagnostics[-1].status[0].values}["refused"] == "2", "another")
    assert commands == []
    graph.publish(topics.NEEDLE_POSE, pose(5.0, 0.0))
    graph.wait(lambda: bool(commands), "a command")


def test_a_path_that_another_scene_blocks_is_not_followed_until_it_is_free_again(graph):
    graph.add(PathFollowerNode, settle=0.0, waypoints=[0.012, 0.0], scene="dish_35mm")
    commands, diagnostics = graph.listen(topics.NEEDLE_COMMAND), graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.NEEDLE_POSE, pose(5.0, 0.0))
    graph.wait(lambda: len(commands) == 1, "a command")
    post = SceneShape("post", "wall", Disc((0.0123, 0.0), 0.001))
    graph.publish(topics.SCENE, wire.scene_message(0, Scene(Dish(0.035), (post,))))
    seconds = 5.0

    def says(words: str) -> bool:
        nonlocal seconds
        seconds += 1 / 60
        graph.publish(topics.NEEDLE_POSE, pose(seconds, 0.0))
        return any(words in report.status[0].message for report in diagnostics[-1:])

    graph.wait(lambda: says("waypoints: got [0.012, 0.0], expected a point outside of post"), "the reason")
    before = len(commands)
    graph.publish(topics.NEEDLE_POSE, pose(seconds + 0.01, 0.0))
    graph.publish(topics.SCENE, wire.scene_message(0, Scene(Dish(0.035))))
    graph.wait(lambda: says("following"), "the path to be followed again")
    assert len(commands) > before
