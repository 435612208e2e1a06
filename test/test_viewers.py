"""The layouts for RViz and Foxglove name topics that the graph has, of types that their displays show."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest
import yaml
from magnetosuture_msgs.msg import BarrierMargin
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from magnetosuture_thread.nodes import topics
from test.shared import ROOT

VIEWERS = ROOT / "config" / "viewers"
RVIZ = yaml.safe_load((VIEWERS / "magnetosuture.rviz").read_text())["Visualization Manager"]
FOXGLOVE: dict[str, Any] = json.loads((VIEWERS / "foxglove.json").read_text())
KNOWN = {topic.channel.recorded: topic for topic in (*topics.INPUTS, *topics.OUTPUTS, *topics.SETTINGS)}

SHOWN_BY = {
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
    "rviz_default_plugins/Path": "nav_msgs/msg/Path",
    "rviz_default_plugins/PoseWithCovariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "rviz_default_plugins/Image": "sensor_msgs/msg/Image",
}
DISPLAYS = [display for display in RVIZ["Displays"] if "Topic" in display]


@pytest.mark.parametrize("display", DISPLAYS, ids=lambda display: display["Name"])
def test_rviz_shows_what_is_there(display: dict[str, Any]):
    """RViz gets nothing of a publisher that offers less than it asks for."""
    asked = display["Topic"]
    topic = KNOWN[f"/{asked['Value']}"]  # in the namespace of RViz
    assert topic.channel.type_name == SHOWN_BY[display["Class"]]
    if asked["Reliability Policy"] == "Reliable":
        assert topic.qos.reliability == ReliabilityPolicy.RELIABLE
    if asked["Durability Policy"] == "Transient Local":
        assert topic.qos.durability == DurabilityPolicy.TRANSIENT_LOCAL


def fields_of(message: Any, path: str) -> bool:
    """Return whether a message has a field, such as `asked.x` or `least[:]{kind==0}.clearance`."""
    for part in re.sub(r"\[:\]|\{.*?\}", "", path).split("."):
        if isinstance(message, list) or not hasattr(message, part):
            return False
        message = getattr(message, part)
        if isinstance(message, list):  # of another type of ours
            message = BarrierMargin()
    return True


def test_foxglove_shows_what_is_there():
    panel = FOXGLOVE["configById"]
    named = [*panel["3D!dish"]["topics"], panel["Image!camera"]["imageMode"]["imageTopic"]]
    named += [panel["RawMessages!bridge"]["topicPath"], panel["DiagnosticSummary!nodes"]["topicToRender"]]
    assert set(named) <= set(KNOWN)
    paths = [path["value"] for name in panel if name.startswith("Plot!") for path in panel[name]["paths"]]
    assert len(paths) == 8
    for path in paths:
        topic, _, field = path.partition(".")
        assert fields_of(KNOWN[topic].message(), field), path
