"""Converts ROS messages to the operator page's state: pure functions, plain types."""

from __future__ import annotations

from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, Vector3
from magnetosuture_msgs import msg
from nav_msgs.msg import Path

from magnetosuture_thread import Disc, InvalidInputError, Scene, SceneShape
from magnetosuture_thread.bags.markers import forecast_events
from magnetosuture_thread.bags.reading import constant_name, heading_known, margins_of, needle_pose
from magnetosuture_thread.bags.scene_message import parse_scene_message
from magnetosuture_thread.estimator.disturbance import disturbance_text
from magnetosuture_thread.geometry.needle_arc import heading_angle
from magnetosuture_thread.settings.errors import shortened
from magnetosuture_thread.thread.margins import node_clearance

MAX_THREAD_NODES = 2001  # with the most segments that thread_model accepts
MAX_LISTED = 24  # entries of a list of texts or figures that are sent to the page


def needle(message: PoseWithCovarianceStamped) -> dict[str, Any]:
    """Return the needle's tail [m], the angle of its heading there [rad], and whether that is not the opposite one.

    Raises:
        InvalidInputError: the pose is none in the dish plane.
    """
    pose = needle_pose(message, directed=False)
    return {"tail": pose.tail.tolist(), "heading": heading_angle(pose.heading), "directed": heading_known(message)}


def tracker(message: msg.TrackerState) -> dict[str, Any]:
    """Return the tracker's state, and the dish's place in the image if known."""
    view, scale = None, message.metres_per_pixel
    if len(message.dish_centre) == 2 and scale > 0.0:
        view = {"centre": list(message.dish_centre), "scale": scale, "rotation": message.camera_rotation}
    return {
        "state": constant_name(message, message.state, "STATE_", "searching"),
        **_plain(message, "reason", "confidence"),
        "view": view,
    }


def measured_thread(message: Path) -> list[list[float]]:
    """Return the vertices of the measured centreline [m]."""
    return _points(placed.pose.position for placed in message.poses)


def predicted(message: msg.PredictedThread) -> dict[str, Any]:
    """Return the predicted vertices [m], how they were found, and the forces [N]: tensions, pull on the needle.

    Raises:
        InvalidInputError: the tensions are not those of the segments between the vertices.
    """
    tension = list(message.tension)
    if tension and len(tension) + 1 != len(message.positions):
        found = f"{len(message.positions)} positions and {len(tension)} tensions"
        raise InvalidInputError("thread/predicted", found, "a tension for each segment, or none")
    return {
        "tension": tension,
        "needle_force": [message.needle_force.x, message.needle_force.y] if tension else None,
        "vertices": _points(message.positions),
        **_plain(message, "residual", "step_time"),
        "status": shortened(message.solver_status),
    }


def estimated(message: msg.EstimatedThread) -> dict[str, Any]:
    """Return the estimated vertices with their deviations [m], how they were found, and the forces that were found.

    Raises:
        InvalidInputError: the deviations are not those of the vertices.
    """
    if len(message.deviation) != len(message.positions):
        found = f"{len(message.positions)} positions and {len(message.deviation)} deviations"
        raise InvalidInputError("thread/estimated", found, "a deviation for each position")
    return {
        "vertices": _points(message.positions),
        "deviation": list(message.deviation),
        **_plain(message, "prediction_only", "unmeasured_for", "hidden"),
        "disturbances": [_disturbance(found) for found in message.disturbances[:MAX_LISTED]],
    }


def _disturbance(message: msg.ThreadDisturbance) -> dict[str, Any]:
    way = message.direction
    text = disturbance_text(message.arc_length, message.force, (way.x, way.y))
    position = [message.position.x, message.position.y]
    return {"position": position, "direction": [way.x, way.y], "force": message.force, "text": text}


def forecast(message: msg.ThreadForecast) -> dict[str, Any]:
    """Return where the thread will be at some instants, the last that of the horizon, and what happens when.

    Raises:
        InvalidInputError: the positions are not those of equally many nodes at each instant.
    """
    instants, count = len(message.time), len(message.positions)
    if not instants or count % instants or count // instants > MAX_THREAD_NODES:
        found = f"{count} positions and {instants} instants"
        raise InvalidInputError("thread/forecast", found, "as many positions at each instant")
    nodes = count // instants
    shown = sorted({round(index) for index in np.linspace(0, instants - 1, 4)[1:]})
    ghosts = [
        {"time": message.time[at], "vertices": _points(message.positions[at * nodes : (at + 1) * nodes])}
        for at in shown
    ]
    shape = shortened(message.contact_shape)
    events = forecast_events(message.contact_time, shape, message.friction_time, message.rest_time)
    return {"horizon": message.horizon, "ghosts": ghosts, "events": events, "problem": shortened(message.problem)}


def margins(message: msg.SafetyMargins) -> dict[str, Any]:
    """Return the margins by node and by kind, as distances [m]; no number of a message that is not valid."""
    bounds = [each.clearance_bound for each in message.minimum if np.isfinite(each.clearance_bound)]
    return {
        "valid": message.valid,
        "of": constant_name(message, message.source, "OF_", "nothing"),
        "reason": shortened(message.reason),
        "clearance": clearances(message) if message.valid else [],
        "least": {shortened(each.barrier): each.clearance for each in message.minimum[:MAX_LISTED]},
        "bound": min(bounds, default=None),
        "contact": list(message.contact_nodes),
        "friction": {
            "state": constant_name(message, message.friction_state, "FRICTION_"),
            "nodes": list(message.friction_nodes),
            "slowdown": message.slowdown,
        },
    }


def clearances(message: msg.SafetyMargins) -> list[float | None]:
    """Return each node's minimum clearance of the wall and any shape [m]; None where none is near.

    Raises:
        InvalidInputError: a node that no thread has.
    """
    count = max(message.node, default=-1) + 1
    if count > MAX_THREAD_NODES:
        raise InvalidInputError("thread/margins.node", count - 1, f"less than {MAX_THREAD_NODES}")
    return [value if value < np.inf else None for value in node_clearance(margins_of(message), count).tolist()]


def scene(message: msg.Scene) -> dict[str, Any]:
    """Return the scene of a message as the page draws it.

    Raises:
        InvalidInputError: the message is damaged.
    """
    return shown_scene(parse_scene_message(message))


def shown_scene(known: Scene) -> dict[str, Any]:
    """Return a scene as the page draws it: discs as x, y and radius, others as outline and holes [m]."""
    tolerance = 2e-4 * known.dish.diameter  # a fifth of a pixel
    return {
        "version": known.version,
        "dish_diameter": known.dish.diameter,
        "dish_depth": known.dish.depth,
        "shapes": [_shown_shape(shape, tolerance) for shape in known.shapes],
    }


def _shown_shape(shape: SceneShape, tolerance: float) -> dict[str, Any]:
    shown: dict[str, Any] = {"name": shape.name, "kind": shape.kind, "label": list(shape.label_point)}
    if isinstance(shape.geometry, Disc):
        return {**shown, "disc": [*shape.geometry.centre, shape.geometry.radius]}
    # 30 times a second, for every page: no digit too many.
    outline, *holes = [np.round(ring, 7).tolist() for ring in shape.outlines(tolerance)]
    return {**shown, "outline": outline, "holes": holes}


def filter_state(message: msg.FilterState) -> dict[str, Any]:
    """Return what the bridge made of the last velocity command [m/s]."""
    velocities = ("commanded", "filtered", "applied")
    return _plain(message, "source", *velocities, "slowdown", "active", "overridden", "reason")


def bridge(message: msg.CoilBridgeState) -> dict[str, Any]:
    """Return what the coil bridge does and why: velocities [m/s], currents [A]."""
    shown = (
        *("armed", "emergency_stopped", "reasons", "commanded", "filtered", "applied", "saturated", "driver"),
        *("driver_ready", "driver_warnings", "current", "measured_current", "refused"),
    )
    return {"state": constant_name(message, message.state, "STATE_", "fault"), **_plain(message, *shown)}


def procedure(message: msg.ProcedureState) -> dict[str, Any]:
    """Return what the needle planner does."""
    return {
        "state": constant_name(message, message.state, "STATE_", "failed"),
        "name": shortened(message.procedure),
        **_plain(message, "goals", "goal", "goals_met", "progress", "resumes", "hold_to_run"),
        "reason": shortened(message.reason, 400),
        "clearance": message.clearance if np.isfinite(message.clearance) else None,
    }


def plan(message: Path) -> list[list[float]]:
    """Return where the middle of the needle is to go [m]; of a long way every second place, or fewer."""
    points = measured_thread(message)
    return points[:: 1 + len(points) // 400]


def node_state(status: DiagnosticStatus) -> dict[str, Any]:
    """Return a node's diagnostic status."""
    levels = {DiagnosticStatus.OK: "ok", DiagnosticStatus.WARN: "warn", DiagnosticStatus.STALE: "silent"}
    return {
        "level": levels.get(status.level, "error"),
        "message": shortened(status.message),
        "values": {shortened(value.key): shortened(value.value) for value in status.values[:MAX_LISTED]},
    }


def _plain(message: Any, *names: str) -> dict[str, Any]:
    """Return fields of a message as plain values: texts and lists shortened, vectors in the plane."""

    def plain(value: Any) -> Any:
        if isinstance(value, str):
            return shortened(value)
        if isinstance(value, Vector3):
            return [value.x, value.y]
        return value if isinstance(value, (bool, int, float)) else [plain(entry) for entry in value[:MAX_LISTED]]

    return {name: plain(getattr(message, name)) for name in names}


def _points(positions: Any) -> list[list[float]]:
    return [[place.x, place.y] for place in positions]
