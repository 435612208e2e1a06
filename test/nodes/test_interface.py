"""What a node has on the graph is what the reference says of it, and what its SROS2 policies allow, and no more."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest
import yaml
from rclpy.qos import DurabilityPolicy

from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.console import ConsoleGraph
from magnetosuture_thread.nodes.node import GuardedNode
from magnetosuture_thread.settings import interface
from test.nodes.conftest import Graph
from test.nodes.makers import EVERY_NODE
from test.shared import ROOT, load_module

CHANNELS = {name: value for name, value in vars(interface).items() if isinstance(value, interface.Channel)}
SECURITY = ROOT / "config" / "security"
REFERENCE = load_module(ROOT / "docs" / "generated_reference.py")
INCLUDE = "{http://www.w3.org/2001/XInclude}include"
Rights = dict[str, set[str]]  # names by what may be done with them
# What a node has under other parameters only: raw frames, and simulated time.
OTHER_PARAMETERS = {
    ("vision_tracker", "subscribe", "/camera/image_raw"),
    ("console", "subscribe", "/camera/image_raw"),
    ("console", "reply", "/console/get_type_description"),
    ("rig_simulator", "publish", "/clock"),
}


def names_of(profile: ElementTree.Element, node: str) -> Rights:
    """Return the full names that a profile allows, its includes among them, as a graph has them."""
    rights: Rights = defaultdict(set)
    for entry in profile:
        if entry.tag == INCLUDE:
            assert entry.get("xpointer") == "xpointer(/profile/*)"
            included = names_of(ElementTree.parse(SECURITY / str(entry.get("href"))).getroot(), node)
            for right, names in included.items():
                rights[right] |= names
            continue
        for right, value in entry.attrib.items():
            assert value == "ALLOW"
            for item in entry:
                name = str(item.text).replace("~", f"/{node}")
                name = name if name.startswith("/") else f"/{name}"
                if right == "execute":
                    rights["publish"] |= {f"{name}/_action/{topic}" for topic in ("feedback", "status")}
                    rights["reply"] |= {f"{name}/_action/{step}" for step in ("cancel_goal", "get_result", "send_goal")}
                else:
                    rights[right].add(name)
    return rights


def enclaves() -> dict[str, dict[str, Rights]]:
    """Return the rights of each node, by enclave."""
    root = ElementTree.parse(SECURITY / "policies.xml").getroot()
    return {
        str(enclave.get("path")): {
            str(profile.get("node")): names_of(profile, str(profile.get("node"))) for profile in enclave.iter("profile")
        }
        for enclave in root.iter("enclave")
    }


def of_every_node() -> dict[str, Rights]:
    """Return the rights of each node."""
    return {node: rights for profiles in enclaves().values() for node, rights in profiles.items()}


def on_the_graph(graph: Graph, node: str) -> Rights:
    """Return the names that a running node has."""
    probe = graph.probe
    found: dict[str, Callable[[str, str], Any]] = {
        "publish": probe.get_publisher_names_and_types_by_node,
        "subscribe": probe.get_subscriber_names_and_types_by_node,
        "reply": probe.get_service_names_and_types_by_node,
        "request": probe.get_client_names_and_types_by_node,
    }
    return {right: {name for name, _ in names(node, "/")} for right, names in found.items()}


def check(graph: Graph, node: str) -> None:
    """Check that a running node has exactly what its policies allow, but for what other parameters bring."""
    allowed = of_every_node()[node]
    other = {right: {n for which, r, n in OTHER_PARAMETERS if (which, r) == (node, right)} for right in allowed}
    expected = {right: names - other[right] - {"/clock"} for right, names in allowed.items()}

    def actual() -> Rights:
        return {right: names for right, names in on_the_graph(graph, node).items() if names}

    graph.wait(lambda: node in graph.probe.get_node_names(), node)
    with suppress(AssertionError):  # the comparison below says what differs
        graph.wait(lambda: actual() == {r: n for r, n in expected.items() if n}, "what is allowed", timeout=10.0)
    assert actual() == {right: names for right, names in expected.items() if names}


@pytest.mark.parametrize("name", EVERY_NODE)
def test_a_node_has_on_the_graph_what_reference_and_policies_say_and_no_more(graph: Graph, name: str):
    make, parameters = EVERY_NODE[name]
    node = graph.add(make, **parameters)
    check(graph, name)
    published, received = REFERENCE.traffic_of(name)
    ends = {way: {each.topic_name for each in getattr(node, way)} for way in ("publishers", "subscriptions")}
    assert {key for key, channel in CHANNELS.items() if channel.recorded in ends["publishers"]} <= published
    assert {key for key, channel in CHANNELS.items() if channel.recorded in ends["subscriptions"]} <= received | {
        "CLOCK"
    }
    served = {each.srv_name.lstrip("/") for each in node.services} & set(interface.SERVICES)
    assert served == {key for key, each in interface.SERVICES.items() if each.node == name}


def test_all_that_a_node_has_is_in_its_namespace(graph: Graph):
    """So nothing of a rig reaches another one of its ROS domain."""
    of_all_rigs = {"/diagnostics", "/clock", "/parameter_events", "/rosout"}
    for name, (make, parameters) in EVERY_NODE.items():
        node = graph.add(make, namespace="left", **parameters)
        names = {each.topic_name for each in (*node.publishers, *node.subscriptions)}
        names |= {each.srv_name for each in node.services if each.srv_name in interface.SERVICES}
        outside = {each for each in names if not node.resolve_topic_name(each).startswith("/left/")}
        assert outside <= of_all_rigs, name


def test_every_topic_has_an_end_in_the_graph():
    traffic = [REFERENCE.traffic_of(name) for name in (*EVERY_NODE, "console")]
    assert {name for published, received in traffic for name in published | received} == set(CHANNELS)


def test_ros2_bag_gets_the_quality_of_service_of_topics_whose_last_message_is_kept():
    every = {channel.recorded: topics.topic_of(channel).qos for channel in CHANNELS.values()}
    assert yaml.safe_load((ROOT / "config" / "ros2_bag" / "qos.yaml").read_text()) == {
        name: {
            "history": qos.history.short_key,
            "depth": qos.depth,
            "reliability": qos.reliability.short_key,
            "durability": qos.durability.short_key,
        }
        for name, qos in every.items()
        if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
    }


def test_the_page_has_on_the_graph_what_its_policies_allow_and_no_more(graph: Graph):
    node = graph.add(lambda **options: GuardedNode("console", **options), start_type_description_service=False)
    node.health.ok("serving")
    ConsoleGraph(node, ConsoleSettings())
    check(graph, "console")


def test_who_may_move_the_needle_arm_stop_or_change_the_scene():
    may: dict[tuple[str, str], set[str]] = defaultdict(set)
    for node, rights in of_every_node().items():
        for right, names in rights.items():
            for name in names:
                may[right, name].add(node)
    assert may["publish", "/needle/servo_cv"] == {"path_follower", "needle_planner"}
    assert may["publish", "/operator/servo_cv"] == {"console"}
    assert may["publish", "/needle/measured_cp"] == {"vision_tracker"}
    assert may["publish", "/thread/margins"] == {"thread_model"}
    assert may["publish", "/scene"] == {"scene_server"}
    assert may["publish", "/coils/state"] == may["publish", "/rig/currents"] == {"coil_bridge"}
    for service in ("arm", "emergency_stop", "reset"):
        assert may["reply", f"/coils/{service}"] == {"coil_bridge"}
        assert may["request", f"/coils/{service}"] == {"console", "coil_client"}
    requested = {name for (right, name), nodes in may.items() if right == "request" and nodes}
    assert not any("set_parameters" in name for name in requested)
    assert not any(name.startswith("/scene/") for name in requested)
