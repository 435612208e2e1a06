"""What the operator's page is told of each message."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
import shapely
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Vector3
from magnetosuture_msgs.msg import (
    BarrierMargin,
    CoilBridgeState,
    EstimatedThread,
    FilterState,
    PredictedThread,
    SafetyMargins,
    ThreadDisturbance,
    ThreadForecast,
    TrackerState,
)

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.nodes.console import messages
from magnetosuture_thread.scene import read_scene
from test.nodes import wire
from test.nodes.margins import no_margins
from test.scene.scenes import every_shape

STAMP = Time(sec=12)


def plain(told: Any) -> Any:
    """Return what a page gets; a value that JSON does not know is an error."""
    return json.loads(json.dumps(told, allow_nan=False))


def test_the_needle():
    message = wire.pose_message(STAMP, np.array([0.003, -0.004]), np.array([0.6, 0.8]))
    told = plain(messages.needle(message))
    assert told["tail"] == [0.003, -0.004]
    assert told["heading"] == pytest.approx(np.arctan2(0.8, 0.6))
    message.header.frame_id = "map"
    with pytest.raises(InvalidInputError, match="'dish'"):
        messages.needle(message)


def test_the_tracker_with_and_without_the_dish():
    message = TrackerState(state=TrackerState.STATE_LOST, reason="glare", dish_centre=[320.0, 240.0])
    assert plain(messages.tracker(message)) == {
        "state": "lost",
        "reason": "glare",
        "confidence": 0.0,
        "view": None,
    }
    message.metres_per_pixel, message.camera_rotation = 8e-5, 0.1
    view = {"centre": [320.0, 240.0], "scale": 8e-5, "rotation": 0.1}
    assert plain(messages.tracker(message))["view"] == view
    assert messages.tracker(TrackerState())["state"] == "searching"
    assert messages.tracker(TrackerState(state=TrackerState.STATE_TRACKED))["state"] == "tracked"


def test_the_threads():
    path = wire.path_message(STAMP, np.array([[0.0, 0.001], [0.002, 0.003]]))
    assert plain(messages.measured_thread(path)) == [[0.0, 0.001], [0.002, 0.003]]
    message = PredictedThread(positions=[Point(x=0.1, y=0.2)], residual=1e-9, step_time=1e-4, solver_status="solved")
    assert plain(messages.predicted(message)) == {
        "tension": [],
        "needle_force": None,
        "vertices": [[0.1, 0.2]],
        "residual": 1e-9,
        "step_time": 1e-4,
        "status": "solved",
    }


def test_the_forces_of_the_predicted_thread():
    message = PredictedThread(positions=[Point(x=0.1), Point(x=0.2)], tension=[3e-6])
    message.needle_force = Vector3(x=-1e-6, y=2e-6)
    shown = plain(messages.predicted(message))
    assert (shown["tension"], shown["needle_force"]) == ([3e-6], [-1e-6, 2e-6])
    message.tension = [3e-6, 4e-6]
    with pytest.raises(InvalidInputError, match="a tension for each segment"):
        messages.predicted(message)


def test_the_estimated_thread():
    found = ThreadDisturbance(arc_length=0.031, force=2e-4, position=Point(x=0.3), direction=Vector3(x=-1.0))
    message = EstimatedThread(
        positions=[Point(x=0.1, y=0.2)], deviation=[1e-5], unmeasured_for=0.5, prediction_only=True, hidden=1.0
    )
    message.disturbances = [found]
    assert plain(messages.estimated(message)) == {
        "vertices": [[0.1, 0.2]],
        "deviation": [1e-5],
        "prediction_only": True,
        "unmeasured_for": 0.5,
        "hidden": 1.0,
        "disturbances": [
            {
                "position": [0.3, 0.0],
                "direction": [-1.0, 0.0],
                "force": 2e-4,
                "text": "held at 31 mm of the thread: 0.2 mN to the left",
            }
        ],
    }
    message.deviation = []
    with pytest.raises(InvalidInputError, match="a deviation for each position"):
        messages.estimated(message)


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


def test_the_page_receives_the_source_and_the_minimum_bound_of_the_margins():
    message = SafetyMargins(valid=True, source=SafetyMargins.OF_ESTIMATE)
    message.minimum = [BarrierMargin(barrier="wall", clearance_bound=b) for b in (3e-4, -math.inf, 2e-4)]
    told = plain(messages.margins(message))
    assert (told["of"], told["bound"]) == ("estimate", 2e-4)
    message = SafetyMargins(valid=True, source=SafetyMargins.OF_PREDICTION)
    message.minimum = [BarrierMargin(barrier="wall", clearance_bound=-math.inf)]
    told = plain(messages.margins(message))
    assert (told["of"], told["bound"]) == ("prediction", None)


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


@pytest.mark.parametrize("node", [2001, 4294967295])
def test_margins_of_a_node_that_no_thread_has_are_refused(node: int):
    with pytest.raises(InvalidInputError, match="less than 2001"):
        messages.margins(SafetyMargins(valid=True, node=[node], barrier=[0], clearance=[0.0]))


def test_margins_that_are_not_valid_have_no_number():
    told = plain(messages.margins(no_margins(STAMP, "no pose")))
    assert (told["valid"], told["reason"], told["clearance"], told["least"]) == (False, "no pose", [], {})
    assert told["friction"]["state"] == "unknown"


def test_scene_outlines_are_simplified_to_the_resolution_of_the_screen():
    scene = every_shape()
    told = plain(messages.scene(wire.scene_message(STAMP, scene)))
    assert (told["version"], told["dish_diameter"], told["dish_depth"]) == (scene.version, 0.05, 0.004)
    assert [(shape["name"], shape["kind"]) for shape in told["shapes"]] == [(s.name, s.kind) for s in scene.shapes]
    post, *others = told["shapes"]
    assert (post["disc"], post["label"]) == ([0.0077, 0.0039, 0.0015], [0.0077, 0.0039])
    for shape, known in zip(others, scene.shapes[1:], strict=True):
        drawn = shapely.Polygon(shape["outline"], shape["holes"])
        assert drawn.symmetric_difference(known.solid).area < 1e-5 * known.solid.length  # 10 um, a fifth of a pixel
        assert len(shape["outline"]) <= 100
        assert known.solid.contains(shapely.Point(shape["label"]))
    assert len(others[0]["holes"]) == 1


def test_a_damaged_scene_is_not_shown():
    message = wire.scene_message(STAMP, every_shape())
    message.shapes[0].disc[0].x += 1e-9
    with pytest.raises(InvalidInputError, match=r"scene\.version"):
        messages.scene(message)


def test_a_scene_that_was_read_is_shown_as_one_that_was_heard():
    scene = read_scene("hernia_ring")
    heard = messages.scene(wire.scene_message(STAMP, scene))
    assert messages.shown_scene(scene) == heard
    assert len(json.dumps(heard)) < 10_000  # 30 times a second, for every page


def test_the_filter_state():
    message = FilterState(source="operator", slowdown=0.9, active=["friction", "ring"], overridden="needle", reason="")
    message.commanded.x, message.filtered.y, message.applied.y = 0.005, 0.004, 0.003
    assert plain(messages.filter_state(message)) == {
        "source": "operator",
        "commanded": [0.005, 0.0],
        "filtered": [0.0, 0.004],
        "applied": [0.0, 0.003],
        "slowdown": 0.9,
        "active": ["friction", "ring"],
        "overridden": "needle",
        "reason": "",
    }


def test_the_bridge():
    message = CoilBridgeState(
        state=CoilBridgeState.STATE_FAULT,
        emergency_stopped=True,
        reasons=["fault: emergency stop"],
        driver="roboclaw",
        driver_warnings=["hot"],
        current=[1.0, 2.0],
        measured_current=[0.9],
        refused=3,
    )
    told = plain(messages.bridge(message))
    assert told["state"] == "fault"
    assert told["emergency_stopped"]
    assert not told["armed"]
    assert told["reasons"] == ["fault: emergency stop"]
    assert (told["current"], told["measured_current"], told["refused"]) == ([1.0, 2.0], [0.9], 3)
    assert told["driver_warnings"] == ["hot"]


def test_what_a_node_says():
    status = DiagnosticStatus(
        level=DiagnosticStatus.WARN, message="no pose", values=[KeyValue(key="refused", value="2")]
    )
    assert plain(messages.node_state(status)) == {
        "level": "warn",
        "message": "no pose",
        "values": {"refused": "2"},
    }
