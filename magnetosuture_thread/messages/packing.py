"""Packs the messages of every pose as CDR bytes, each with one format: pose, path, prediction, margins, markers."""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.barrier import COMPRESSION, CONNECTIVITY, ENHANCED_CONNECTIVITY, STIFFNESS
from magnetosuture_thread.geometry.orientation import heading_angle, yaw_quaternion
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.messages.building import ADD, IN_PLANE, LINE_STRIP
from magnetosuture_thread.messages.cdr import (
    BEGIN,
    DISH,
    EMPTY,
    HEADER,
    KEPT,
    REAL,
    Text,
    Time,
    array_codes,
    form,
    numbers,
    points_of,
    text,
    text_codes,
)
from magnetosuture_thread.model.margins import UNKNOWN, FrictionState, Margins, friction_colour
from magnetosuture_thread.model.predictor import Prediction
from magnetosuture_thread.thread_observation import ThreadObservation

_UNKNOWN, _FREE, _IN_CONTACT = 0, 1, 2  # as in SafetyMargins.msg
_BARRIER, _NODE, _OBSTACLE = (np.dtype(code) for code in ("u1", "<u4", "<i4"))
_PLACES = [6 * row + column for row in IN_PLANE for column in IN_PLANE]
_POSE = form(*HEADER, *"d" * 7, *"d" * 36)
_PATH = form(*HEADER, "I")
# One PoseStamped of a path begins at a multiple of 8, as the next does.
_STAMPED = np.dtype(
    {
        "names": ["sec", "nanosec", "length", "frame", "x", "y", "w"],
        "formats": ["<i4", "<u4", "<u4", f"S{DISH[0]}", REAL, REAL, REAL],
        "offsets": [0, 4, 8, 12, 24, 32, 72],
        "itemsize": 80,
    }
)
SPHERE_LIST, TEXT_VIEW_FACING = 7, 9  # as in Marker.msg
TEXT_HEIGHT, LINE_HEIGHT = 8e-4, 1e-3  # m
LIFETIME = 500_000_000  # ns of a barrier's text; poses come far more often
SEGMENT_BARRIERS = (CONNECTIVITY, ENHANCED_CONNECTIVITY, COMPRESSION, STIFFNESS)
_THREAD, _MARGINS = text("thread"), text("margins")
_INK, _RED = (0.1, 0.13, 0.16, 1.0), (0.78, 0.06, 0.18, 1.0)


def packed_pose(
    time: Time, tail: NDArray[np.float64], heading: NDArray[np.float64], covariance: NDArray[np.float64] | None = None
) -> bytes:
    """Return the needle's pose, a PoseWithCovarianceStamped: position of the tail, x axis along the needle there.

    Args:
        time: of the frame that it was measured in, seconds and nanoseconds.
        tail: shape (2,) [m].
        heading: unit vector, shape (2,).
        covariance: of x, y [m] and the angle of the heading [rad], shape (3, 3); zeros, which say in ROS
            that it is not known, if None.
    """
    whole = [0.0] * 36
    if covariance is not None:
        for place, value in zip(_PLACES, covariance.ravel().tolist(), strict=True):
            whole[place] = value
    z, w = yaw_quaternion(heading_angle(heading))
    return BEGIN + _POSE.pack(*time, *DISH, tail[0], tail[1], 0.0, 0.0, 0.0, z, w, *whole)


def packed_path(time: Time, points: Points) -> bytes:
    """Return a polyline of shape (m, 2) [m] as a Path.

    Args:
        time: seconds and nanoseconds.
        points: of the polyline.
    """
    poses = np.zeros(len(points), _STAMPED)
    poses["sec"], poses["nanosec"] = time
    poses["length"], poses["frame"] = DISH
    poses["x"], poses["y"], poses["w"] = points[:, 0], points[:, 1], 1.0
    return BEGIN + _PATH.pack(*time, *DISH, len(points)) + poses.tobytes()


def packed_observation(time: Time, observation: ThreadObservation) -> bytes:
    """Return what a frame shows of the thread as a ThreadObservation.

    Args:
        time: of the frame, seconds and nanoseconds.
        observation: of the thread.
    """
    codes, values = [*HEADER, "I"], [*time, *DISH, len(observation.pieces)]
    for piece in observation.pieces:
        count = len(piece.points)
        codes += [*array_codes(count, "d", 3), *array_codes(count, "d"), "B", "B", "d", "d", "?", "d"]
        values += [count, points_of(piece.points), count, numbers(piece.deviation, REAL)]
        values += [int(piece.first_end), int(piece.last_end), *map(float, piece.arc_length)]
        values += [bool(piece.direction_known), float(piece.confidence)]
    codes += ["?", "I"]
    values += [bool(observation.complete), len(observation.hidden)]
    for outline in observation.hidden:
        codes += array_codes(len(outline), "d", 3)
        values += [len(outline), points_of(outline)]
    return BEGIN + form(*codes).pack(*values)


def packed_prediction(time: Time, prediction: Prediction, material: str, *, step_time: float = 0.0) -> bytes:
    """Return a PredictedThread.

    Args:
        time: of the pose, seconds and nanoseconds.
        prediction: the thread.
        material: its name.
        step_time: wall-clock time that it took [s]; offline it is no property of a prediction, and told as 0.
    """
    vertices = prediction.positions
    words = (prediction.formulation, prediction.scene_version, material, prediction.solver, prediction.status)
    formulation, scene, thread, solver, status = map(text, words)
    sizes = (formulation[0], scene[0], thread[0], len(vertices), len(prediction.strain), solver[0], status[0])
    return BEGIN + _prediction_form(*sizes).pack(
        *time,
        *DISH,
        *formulation,
        *scene,
        *thread,
        len(vertices),
        points_of(vertices),
        len(prediction.strain),
        numbers(prediction.strain, REAL),
        *solver,
        *status,
        prediction.residual,
        prediction.interval,
        prediction.substeps,
        step_time,
    )


def packed_margins(time: Time, margins: Margins | None, reason: str = "", scene_version: str = "") -> bytes:
    """Return a SafetyMargins: every barrier, the minimum of each, and what is in contact; or why there are none.

    Args:
        time: of the pose, seconds and nanoseconds.
        margins: of its prediction; None where there are none.
        reason: why there are none.
        scene_version: of the scene in force where there are none.
    """
    scene = text(scene_version if margins is None else margins.scene_version)
    if margins is None:
        words = text(reason)
        return BEGIN + _no_margins_form(scene[0], words[0]).pack(
            *time, *DISH, *scene, False, *words, *[0] * 7, _UNKNOWN, 0, FrictionState.UNKNOWN, 0, 1.0
        )
    names = [text(name) for name in margins]
    minima = [(text(row.barrier), row) for row in margins.minima]
    counts = [len(barrier) for barrier in margins.barriers]
    count, friction = sum(counts), margins.friction
    touching, squeezed = len(margins.in_contact), len(friction.nodes)
    layout = _margins_form(
        scene[0], tuple(size for size, _ in names), count, tuple(name[0] for name, _ in minima), touching, squeezed
    )
    columns = [np.repeat(np.arange(len(names)), counts).astype(_BARRIER).tobytes()]
    for attribute, kind in (("node", _NODE), ("obstacle", _OBSTACLE), ("value", REAL), ("clearance", REAL)):
        columns.append(b"".join(numbers(getattr(barrier, attribute), kind) for barrier in margins.barriers))
    return BEGIN + layout.pack(
        *time,
        *DISH,
        *scene,
        True,
        *EMPTY,
        len(names),
        *[part for name in names for part in name],
        *[part for column in columns for part in (count, column)],
        len(minima),
        *[
            part
            for name, row in minima
            for part in (*name, row.node[0], row.obstacle[0], row.value[0], row.clearance[0])
        ],
        _IN_CONTACT if touching else _FREE,
        touching,
        *margins.in_contact,
        friction.state,
        squeezed,
        *friction.nodes,
        friction.slowdown,
    )


@lru_cache(KEPT)
def _prediction_form(
    formulation: int, scene: int, material: int, vertices: int, stretch: int, solver: int, status: int
) -> struct.Struct:
    """Return the format of a PredictedThread with texts of these lengths, and so many vertices and segments."""
    begin = (*HEADER, *text_codes(formulation), *text_codes(scene), *text_codes(material))
    arrays = (*array_codes(vertices, "d", 3), *array_codes(stretch, "d"))
    return form(*begin, *arrays, *text_codes(solver), *text_codes(status), "d", "d", "I", "d")


@lru_cache(KEPT)
def _margins_form(
    scene: int, names: tuple[int, ...], rows: int, minima: tuple[int, ...], touching: int, squeezed: int
) -> struct.Struct:
    """Return the format of a SafetyMargins.

    Args:
        scene: bytes of the scene's version.
        names: bytes of each barrier's name.
        rows: of all barriers.
        minima: bytes of the name of each barrier that has rows.
        touching: nodes that touch something.
        squeezed: nodes under friction.
    """
    return form(
        *HEADER,
        *text_codes(scene),
        "?",
        *text_codes(EMPTY[0]),
        "I",
        *[code for size in names for code in text_codes(size)],
        *[code for kind in "BIidd" for code in array_codes(rows, kind)],
        "I",
        *[code for size in minima for code in (*text_codes(size), "I", "i", "d", "d")],
        *_nodes(touching),
        *_nodes(squeezed),
        "d",
    )


@lru_cache(KEPT)
def _no_margins_form(scene: int, reason: int) -> struct.Struct:
    """Return the format of a SafetyMargins without any, but a reason of this length."""
    return form(*HEADER, *text_codes(scene), "?", *text_codes(reason), *"IIIIIII", *_nodes(0), *_nodes(0), "d")


def _nodes(count: int) -> tuple[str, ...]:
    """Return the codes of a state and the nodes that it is about."""
    return "B", "I", *"I" * count


def packed_markers(time: Time, prediction: Prediction, margins: Margins | None, diameter: float) -> bytes:
    """Return a MarkerArray: the predicted thread, its nodes under friction, and the minimum of each barrier.

    The line has the colour of the friction, and the nodes under friction are spheres. A barrier's least clearance is
    written beside the node that has it, in the namespace `margins`, also for barriers that users added; those of
    single segments are not shown. The text disappears by its lifetime when its barrier has no row any more.

    Source: [Forghani2025], algorithm "Real-Time Thread Sim with Visual Feedback": green where free, orange, darker
    with every node, where sliding under friction, blue where stuck. Deviation: grey where unknown.

    Args:
        time: of the pose, seconds and nanoseconds.
        prediction: the thread.
        margins: of it; None where there are none.
        diameter: of the thread [m].
    """
    width = max(4.0 * diameter, 2e-4)  # wider than it is, so that it can be seen
    friction = UNKNOWN if margins is None else margins.friction
    colour = (*friction_colour(friction), 1.0)
    nodes = prediction.positions
    markers = [
        _Marker(_THREAD, 0, LINE_STRIP, (width, 0.0, 0.0), colour, points=nodes),
        _Marker(_THREAD, 1, SPHERE_LIST, (2.0 * width,) * 3, colour, points=nodes[list(friction.nodes)]),
    ]
    shown = [each for each in (() if margins is None else margins.minima) if each.barrier not in SEGMENT_BARRIERS]
    for number, minimum in enumerate(shown):
        clearance = minimum.minimum_clearance
        x, y = nodes[minimum.node[0]]
        place = (float(x), float(y) + (number + 1) * LINE_HEIGHT, 0.0)  # several may be closest at the same node
        caption = text(f"{minimum.barrier} {1e3 * clearance:.2f} mm")
        colour = _RED if clearance <= 0.0 else _INK
        marker = _Marker(_MARGINS, number, TEXT_VIEW_FACING, (0.0, 0.0, TEXT_HEIGHT), colour, place, caption=caption)
        markers.append(marker)
    values = [value for marker in markers for value in marker.values(time)]
    codes = tuple((len(marker.points), len(marker.namespace[1]), len(marker.caption[1])) for marker in markers)
    return BEGIN + _markers_form(codes).pack(len(markers), *values)


class _Marker(NamedTuple):
    """A marker of visualization_msgs, as far as ours differ."""

    namespace: Text
    number: int
    kind: int
    scale: tuple[float, ...]
    colour: tuple[float, ...]
    place: tuple[float, ...] = (0.0, 0.0, 0.0)
    points: Points = np.empty((0, 2))
    caption: Text = EMPTY

    def values(self, time: Time) -> tuple[object, ...]:
        """Return the fields in the message's order."""
        upright, lifetime = (0.0, 0.0, 0.0, 1.0), (0, LIFETIME if self.kind == TEXT_VIEW_FACING else 0)
        head = (*time, *DISH, *self.namespace, self.number, self.kind, ADD, *self.place, *upright)
        shape = (*self.scale, *self.colour, *lifetime, False, len(self.points), points_of(self.points))
        # Colours of single points, a texture with its header and picture, its coordinates, then a mesh and its file.
        return (*head, *shape, 0, *EMPTY, 0, 0, *EMPTY, *EMPTY, 0, 0, *self.caption, *EMPTY, *EMPTY, 0, False)


@lru_cache(KEPT)
def _markers_form(sizes: tuple[tuple[int, int, int], ...]) -> struct.Struct:
    codes = ["I"]
    empty = text_codes(EMPTY[0])
    for points, namespace, caption in sizes:
        codes += [*HEADER, *text_codes(namespace), "i", "i", "i", *"d" * 7, *"d" * 3, *"f" * 4, "i", "I", "?"]
        codes += [*array_codes(points, "d", 3), "I", *empty, "i", "I", *empty, *empty, "I", "I"]
        codes += [*text_codes(caption), *empty, *empty, "I", "?"]
    return form(*codes)
