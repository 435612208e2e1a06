"""Settings as the parameters of a node."""

from __future__ import annotations

import pytest
from rcl_interfaces.srv import DescribeParameters
from rclpy.parameter import Parameter

from magnetosuture_thread.configuration import described
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.model.settings import ThreadModelSettings
from magnetosuture_thread.nodes.thread_model import ThreadModelNode


def test_every_setting_is_a_described_read_only_parameter(graph):
    node = graph.add(ThreadModelNode, segments=30, length=0.02)
    for about in described(ThreadModelSettings):
        descriptor = node.describe_parameter(about.name)
        assert descriptor.read_only
        assert about.quantity.description in descriptor.description
        if about.quantity.unit:
            assert about.quantity.unit in descriptor.description
    assert node.get_parameter("segments").value == 30
    assert node.get_parameter("length").value == 0.02
    assert node.get_parameter("material").value == "polyamide_7_0"
    assert node.describe_parameter("length").floating_point_range[0].to_value == 2.0
    assert node.describe_parameter("segments").integer_range[0].from_value == 3
    refused = node.set_parameters([Parameter("segments", value=40)])[0]
    assert not refused.successful


def test_other_nodes_can_ask_for_the_description(graph):
    graph.add(ThreadModelNode)
    client = graph.probe.create_client(DescribeParameters, "/thread_model/describe_parameters")
    assert client.wait_for_service(10.0)
    future = client.call_async(DescribeParameters.Request(names=["viscosity"]))
    graph.wait(future.done, "the description")
    assert "Pa s" in future.result().descriptors[0].description


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"lenght": 0.02}, "thread_model.lenght: got 0.02, expected one of .*did you mean length"),
        ({"length": 19.0}, r"thread_model\.length: got 19\.0, expected a number from 0\.001 to 2 m"),
        ({"length": "19 mm"}, "thread_model.length: got '19 mm'"),
        ({"disc_obstacles": [0.0, 0.1]}, "a multiple of 3 numbers"),
        ({"material": "steel"}, "expected one of polyamide_7_0, silk_6_0"),
    ],
)
def test_a_node_does_not_start_with_a_bad_parameter(graph, parameters, words):
    with pytest.raises(ConfigurationError, match=words):
        graph.add(ThreadModelNode, **parameters)


def test_whole_numbers_are_taken_for_real_ones(graph):
    node = graph.add(ThreadModelNode, viscosity=2, disc_obstacles=[1, 0, 1])
    assert node.get_parameter("viscosity").value == 2.0
    assert list(node.get_parameter("disc_obstacles").value) == [1.0, 0.0, 1.0]
