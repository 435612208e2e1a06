"""Settings as the parameters of a node: described, changed together or not at all, dumped and loaded again."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
from rclpy.parameter import Parameter

from magnetosuture_thread.nodes.node import ManagedNode
from magnetosuture_thread.nodes.parameters import plain_value
from magnetosuture_thread.nodes.vision_tracker import VisionTrackerNode
from magnetosuture_thread.settings import shared_parameters as shared
from magnetosuture_thread.settings.configuration import configuration_fields, to_mapping
from magnetosuture_thread.settings.errors import ConfigurationError
from test.test_configuration import Oven


@dataclass(frozen=True)
class NodeOven(shared.LifecycleSettings, Oven):
    """Settings of a node."""


class OvenNode(ManagedNode[NodeOven]):
    """A node whose oven can be changed while it is configured, but for the shelves."""

    def __init__(self, **options: Any) -> None:
        super().__init__("oven", NodeOven, fixed={"shelves": "they are counted once"}, **options)
        self.in_force = NodeOven()
        self.start()

    def allocate(self, settings: NodeOven) -> None:
        """Take the settings."""
        self.in_force = settings

    def prepare(self, settings: NodeOven) -> Callable[[], None]:
        """Return what changes the oven; it is no wider than 1.5 m."""
        if sum(settings.corners) > 1.5:
            raise settings.refused("corners", "at most 1.5 m together")
        return lambda: setattr(self, "in_force", settings)


class Kitchen:
    """An oven that is changed as by its parameter services."""

    def __init__(self, graph: Any) -> None:
        self.node = graph.add(OvenNode)

    @property
    def in_force(self) -> NodeOven:
        """The settings in force, which the parameters are."""
        told = {
            about.name: plain_value(self.node.get_parameter(about.name)) for about in configuration_fields(NodeOven)
        }
        assert told == to_mapping(self.node.in_force) == to_mapping(self.node.settings)
        return self.node.in_force

    def set(self, **values: Any) -> str:
        """Set parameters at once; return why they were refused."""
        result = self.node.set_parameters_atomically([Parameter(name, value=value) for name, value in values.items()])
        assert result.successful == (not result.reason)
        return str(result.reason)


@pytest.fixture
def kitchen(graph) -> Kitchen:
    """An oven in a graph."""
    return Kitchen(graph)


def test_a_change_is_in_force_at_once(kitchen):
    assert not kitchen.set(temperature=350.0, corners=[0.1, 0.2])
    assert not kitchen.set(lit=True)
    assert kitchen.in_force == NodeOven(lit=True, temperature=350.0, corners=(0.1, 0.2))


def test_whole_numbers_and_empty_lists_are_taken_as_in_a_file(kitchen):
    assert not kitchen.set(temperature=350, corners=[1, 0])
    assert kitchen.in_force == NodeOven(temperature=350.0, corners=(1.0, 0.0))
    empty = Parameter("corners", Parameter.Type.BOOL_ARRAY, [])  # as the command line has it
    assert not kitchen.set(names=["a", "b"], temperature="3e2")
    assert kitchen.node.set_parameters([empty])[0].successful
    assert kitchen.in_force == NodeOven(temperature=300.0, names=("a", "b"))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"temperature": math.nan}, "out of range"),
        ({"temperature": "hot"}, "Wrong parameter type"),
        ({"corners": [1.0] * 5000}, "oven.corners: got '5000 entries', expected at most 1000"),
        ({"lit": True}, "at least 300 K when lit; what belongs together is set at once"),
        ({"corners": [0.8, 0.9]}, "oven.corners: got .0.8, 0.9., expected at most 1.5 m together"),
        ({"shelves": 3}, "oven.shelves: got 3, expected its value in force, until the node is cleaned up"),
        ({"corners": [99.0] * 1000}, r"^oven.corners: got \[99.0.*…, expected a list .* given in metres.$"),
    ],
)
def test_what_is_refused_changes_nothing_and_is_said_in_a_line(kitchen, values, words):
    reason = kitchen.set(**values)
    assert re.search(words, reason)
    assert "\n" not in reason
    assert len(reason) < 600
    assert kitchen.in_force == NodeOven()


def test_what_nodes_share_and_this_one_does_not_know_is_left_aside(graph):
    node = graph.add(VisionTrackerNode, viscosity=0.3, driver_timeout=0.5, needle_length=0.004)
    assert node.get_parameter("needle_length").value == 0.004
    assert not node.has_parameter("viscosity")
    with pytest.raises(ConfigurationError, match=r"vision_tracker\.viscositee: got 0\.3"):
        graph.add(VisionTrackerNode, viscositee=0.3)
