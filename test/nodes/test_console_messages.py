"""What the operator's page is told of each message."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from magnetosuture_msgs.msg import BarrierMargin, SafetyMargins, ThreadForecast

from magnetosuture_thread.nodes import console as messages
from magnetosuture_thread.settings.errors import InvalidInputError

STAMP = Time(sec=12)


def plain(told: Any) -> Any:
    """Return what a page gets; a value that JSON does not know is an error."""
    return json.loads(json.dumps(told, allow_nan=False))


def test_the_forecast_has_ghosts_and_what_happens_first():
    """Eleven instants of two nodes, which move by 1 mm in each."""
    positions = [Point(x=1e-3 * k, y=0.1 * node) for k in range(11) for node in range(2)]
    message = ThreadForecast(time=[0.3 * k for k in range(11)], horizon=3.0, positions=positions)
    message.contact_time, message.contact_shape = 1.44, "left_tissue"
    message.friction_time, message.rest_time = 0.81, math.nan
    shown = plain(messages.forecast(message))
    assert shown["events"] == ["friction in 0.8 s", "touches the left tissue in 1.4 s"]
    assert [ghost["time"] for ghost in shown["ghosts"]] == pytest.approx([0.9, 2.1, 3.0])
    assert shown["ghosts"][-1]["vertices"] == [[0.01, 0.0], [0.01, 0.1]]
    # What holds already is not announced; a needle that rests is.
    message.contact_time, message.friction_time, message.rest_time = 0.0, 0.0, 0.0
    assert plain(messages.forecast(message))["events"] == ["needle rests"]
    message.positions = positions[:-1]
    with pytest.raises(InvalidInputError, match="as many positions at each instant"):
        messages.forecast(message)


def test_of_each_node_the_least_clearance_of_wall_and_shapes():
    message = SafetyMargins(
        valid=True,
        barrier_names=["connectivity", "obstacle", "wall"],
        barrier=[0, 1, 1, 1, 2],
        node=[3, 1, 1, 2, 4],
        obstacle=[-1, 0, 1, 1, -1],
        value=[0.0] * 5,
        clearance=[0.0, 5e-4, 2e-4, 0.0, 3e-4],
        minimum=[
            BarrierMargin(barrier="obstacle", node=2, clearance=0.0),
            BarrierMargin(barrier="connectivity", clearance=1e-6),
        ],
        contact_nodes=[2],
        friction_state=SafetyMargins.FRICTION_SLIDING,
        friction_nodes=[1, 2],
        slowdown=0.81,
    )
    told = plain(messages.margins(message))
    assert told["clearance"] == [None, 2e-4, 0.0, None, 3e-4]
    assert told["least"] == {"obstacle": 0.0, "connectivity": 1e-6}
    assert told["contact"] == [2]
    assert told["friction"] == {"state": "sliding", "nodes": [1, 2], "slowdown": 0.81}
    assert (told["valid"], told["reason"]) == (True, "")


def test_margins_of_a_node_that_no_thread_has_are_refused():
    with pytest.raises(InvalidInputError, match="less than 2001"):
        messages.margins(SafetyMargins(valid=True, node=[4294967295], barrier=[0], clearance=[0.0]))
