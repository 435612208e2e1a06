"""Settings as the parameters of a node."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter

from magnetosuture_thread.configuration import Configuration, configuration_fields, quantity, to_mapping
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.nodes.parameters import Changeable, declare
from magnetosuture_thread.nodes.thread_model import ThreadModelNode
from magnetosuture_thread.nodes.vision_tracker import VisionTrackerNode
from magnetosuture_thread.thread_model.settings import FIXED, ThreadModelSettings


def test_every_setting_is_a_described_parameter(graph):
    node = graph.add(ThreadModelNode, segments=30, thread_length=0.02)
    for about in configuration_fields(ThreadModelSettings):
        descriptor = node.describe_parameter(about.name)
        assert (FIXED.get(about.name, "?") in descriptor.additional_constraints) == (about.name in FIXED)
        assert not descriptor.read_only
        assert about.quantity.description in descriptor.description
        if about.quantity.unit:
            assert about.quantity.unit in descriptor.description
    assert node.get_parameter("segments").value == 30
    assert node.get_parameter("thread_length").value == 0.02
    assert node.get_parameter("material").value == "polyamide_7_0"
    assert node.describe_parameter("thread_length").floating_point_range[0].to_value == 2.0
    assert node.describe_parameter("segments").integer_range[0].from_value == 3
    # An empty list knows of what it is one.
    assert node.describe_parameter("gravity").type == node.get_parameter("gravity").type_.value == 8
    assert node.describe_parameter("fixed_nodes").type == node.get_parameter("fixed_nodes").type_.value == 7


@dataclass(frozen=True)
class Oven(Configuration):
    """Settings for the tests."""

    GROUP: ClassVar[str] = "oven"

    lit: bool = quantity(False, "whether it burns")
    temperature: float = quantity(293.0, "of the inside", unit="K", minimum=0.0, maximum=1000.0)
    trays: int = quantity(2, "how many", minimum=0, maximum=10)
    dishes: tuple[float, ...] = quantity((), "weight of each", unit="kg", minimum=0.0, maximum=9.0)
    owners: tuple[str, ...] = quantity((), "names")

    def check(self) -> None:
        """Refuse a cold fire."""
        if self.lit and self.temperature < 300.0:
            raise ConfigurationError("oven.temperature", self.temperature, "at least 300 K when lit")


class Kitchen:
    """Oven settings that a node's parameters change, and what came of it."""

    def __init__(self, node: Node) -> None:
        self.node, self.in_force, self.refusal = node, Oven(), ""
        declare(node, Oven, read_only=False)
        self.changeable = Changeable(node, self.in_force, self._prepare)

    def _prepare(self, settings: Oven) -> Callable[[], None]:
        if self.refusal:
            raise ConfigurationError("oven.dishes", list(settings.dishes), self.refusal)
        return lambda: setattr(self, "in_force", settings)

    def set(self, **values: Any) -> str:
        """Set parameters at once; return why they were refused."""
        given = [Parameter(name, value=value) for name, value in values.items()]
        result = self.node.set_parameters_atomically(given)
        assert self.changeable.settings == self.in_force
        told = {about.name: self.node.get_parameter(about.name).value for about in configuration_fields(Oven)}
        assert {name: list(v) if hasattr(v, "typecode") else v for name, v in told.items()} == to_mapping(self.in_force)
        assert result.successful == (not result.reason)
        return str(result.reason)


@pytest.fixture
def kitchen(graph):
    """An oven in a graph."""
    made = Kitchen(graph.probe)
    yield made
    graph.probe._on_set_parameters_callbacks.clear()


def test_a_change_is_in_force_at_once(kitchen):
    assert not kitchen.set(temperature=350.0, dishes=[1.0, 2.0])
    assert kitchen.in_force == Oven(temperature=350.0, dishes=(1.0, 2.0))
    assert not kitchen.set(lit=True)
    assert kitchen.in_force == Oven(lit=True, temperature=350.0, dishes=(1.0, 2.0))


def test_whole_numbers_and_empty_lists_are_taken_as_in_a_file(kitchen):
    assert not kitchen.set(temperature=350, dishes=[1, 2])
    assert kitchen.in_force == Oven(temperature=350.0, dishes=(1.0, 2.0))
    assert not kitchen.set(dishes=[])
    empty = Parameter("dishes", Parameter.Type.BOOL_ARRAY, [])  # as the command line has it
    assert kitchen.node.set_parameters([empty])[0].successful
    assert kitchen.in_force == Oven(temperature=350.0)
    assert not kitchen.set(owners=["a", "b"])
    assert not kitchen.set(owners=[])


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"temperature": 1e300}, "out of range"),
        ({"temperature": math.nan}, "out of range"),
        ({"temperature": math.inf}, "out of range"),
        ({"temperature": "hot"}, "Wrong parameter type"),
        ({"temperature": None}, "cannot be undeclared"),
        ({"dishes": [1.0, math.nan]}, "oven.dishes: got .*nan.*, expected a list from 0 to 9 kg"),
        ({"dishes": [10**30]}, ""),
        ({"dishes": [1.0] * 5000}, "oven.dishes: got '5000 entries', expected at most 1000"),
        ({"lit": True}, "at least 300 K when lit; what belongs together is set at once"),
        ({"lit": True, "temperature": 299.0}, "at least 300 K when lit$"),
        ({"dishes": [99.0] * 1000}, r"^oven.dishes: got \[99.0.*…, expected a list from 0 to 9 kg$"),
    ],
)
def test_what_is_refused_changes_nothing_and_is_said_in_a_line(kitchen, values, words):
    try:
        reason = kitchen.set(**values)
    except OverflowError:  # rclpy's own word for what no parameter can hold
        return
    assert re.search(words, reason)
    assert "\n" not in reason
    assert len(reason) < 600
    assert kitchen.in_force == Oven()


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"thread_lenght": 0.02}, "thread_model.thread_lenght: got 0.02, expected one of .*did you mean thread_length"),
        ({"thread_length": 19.0}, r"thread_model\.thread_length: got 19\.0, expected a number from 0\.001 to 2 m"),
        ({"thread_length": "19 mm"}, "thread_model.thread_length: got '19 mm'"),
        ({"gravity": [0.0, 0.1, 0.2]}, "a multiple of 2 numbers"),
        ({"material": "steel"}, "expected one of polyamide_7_0, silk_6_0"),
    ],
)
def test_a_node_does_not_start_with_a_bad_parameter(graph, parameters, words):
    with pytest.raises(ConfigurationError, match=words):
        graph.add(ThreadModelNode, **parameters)


def test_what_nodes_share_and_this_one_does_not_know_is_left_aside(graph):
    node = graph.add(VisionTrackerNode, viscosity=0.3, driver_timeout=0.5, needle_length=0.004)
    assert node.get_parameter("needle_length").value == 0.004
    assert not node.has_parameter("viscosity")
    assert not node.has_parameter("driver_timeout")
    with pytest.raises(ConfigurationError, match=r"vision_tracker\.viscositee: got 0\.3"):
        graph.add(VisionTrackerNode, viscositee=0.3)
