"""Settings as the parameters of a node."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest
from rclpy.parameter import Parameter

from magnetosuture_thread.estimator.settings import FIXED, ThreadModelSettings
from magnetosuture_thread.nodes.node import ManagedNode
from magnetosuture_thread.nodes.parameters import plain_value
from magnetosuture_thread.nodes.thread_model import ThreadModelNode
from magnetosuture_thread.nodes.vision_tracker import VisionTrackerNode
from magnetosuture_thread.settings.configuration import Configuration, configuration_fields, quantity, to_mapping
from magnetosuture_thread.settings.errors import ConfigurationError


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
    autostart: str = quantity("active", "state that it enters by itself")

    def check(self) -> None:
        """Refuse a cold fire."""
        if self.lit and self.temperature < 300.0:
            raise ConfigurationError("oven.temperature", self.temperature, "at least 300 K when lit")


class OvenNode(ManagedNode[Oven]):
    """A node whose oven can be changed while it is configured, but for the trays."""

    def __init__(self, **options: Any) -> None:
        super().__init__("oven", Oven, fixed={"trays": "they are counted once"}, **options)
        self.in_force = Oven()
        self.start()

    def allocate(self, settings: Oven) -> None:
        """Take the settings."""
        self.in_force = settings

    def prepare(self, settings: Oven) -> Callable[[], None]:
        """Return what changes the oven; eight kilogrammes do not fit."""
        if sum(settings.dishes) > 8.0:
            raise ConfigurationError("oven.dishes", list(settings.dishes), "at most 8 kg together")
        return lambda: setattr(self, "in_force", settings)


class Kitchen:
    """An oven that is changed as by its parameter services."""

    def __init__(self, graph: Any) -> None:
        self.node = graph.add(OvenNode)

    @property
    def in_force(self) -> Oven:
        """The settings in force, which the parameters are."""
        told = {about.name: plain_value(self.node.get_parameter(about.name)) for about in configuration_fields(Oven)}
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
        ({"temperature": math.nan}, "out of range"),
        ({"temperature": "hot"}, "Wrong parameter type"),
        ({"temperature": None}, "cannot be undeclared"),
        ({"dishes": [1.0, math.nan]}, "oven.dishes: got .*nan.*, expected a list from 0 to 9 kg"),
        ({"dishes": [10**30]}, ""),
        ({"dishes": [1.0] * 5000}, "oven.dishes: got '5000 entries', expected at most 1000"),
        ({"lit": True}, "at least 300 K when lit; what belongs together is set at once"),
        ({"lit": True, "temperature": 299.0}, "at least 300 K when lit$"),
        ({"dishes": [4.5, 4.5]}, "oven.dishes: got .4.5, 4.5., expected at most 8 kg together"),
        ({"trays": 3}, "oven.trays: got 3, expected its value in force, until the node is cleaned up"),
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


def test_what_nodes_share_and_this_one_does_not_know_is_left_aside(graph):
    node = graph.add(VisionTrackerNode, viscosity=0.3, driver_timeout=0.5, needle_length=0.004)
    assert node.get_parameter("needle_length").value == 0.004
    assert not node.has_parameter("viscosity")
    assert not node.has_parameter("driver_timeout")
    with pytest.raises(ConfigurationError, match=r"vision_tracker\.viscositee: got 0\.3"):
        graph.add(VisionTrackerNode, viscositee=0.3)
