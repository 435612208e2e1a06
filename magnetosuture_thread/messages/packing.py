"""Packs the messages of every pose as CDR bytes: pose, path, prediction, estimate, margins, markers."""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.orientation import heading_angle, yaw_quaternion
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.messages.building import IN_PLANE
from magnetosuture_thread.messages.cdr import (
    BEGIN,
    DISH,
    EMPTY,
    HEADER,
    KEPT,
    REAL,
    Time,
    array_codes,
    form,
    numbers,
    points_of,
    text,
    text_codes,
    time_of,
)
from magnetosuture_thread.model.margins import FrictionState, Margins
from magnetosuture_thread.model.prediction import Prediction
from magnetosuture_thread.thread_observation import ThreadObservation

if TYPE_CHECKING:
    from magnetosuture_thread.model.estimator import ThreadEstimate

_UNKNOWN, _FREE, _IN_CONTACT = 0, 1, 2  # as in SafetyMargins.msg
_OF_NOTHING, _OF_PREDICTION, _OF_ESTIMATE = 0, 1, 2
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
MAX_PROBLEMS = 8  # of a frame that are published


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
    vertices, forces = prediction.positions, prediction.forces
    tension, contact, pull, moment, states, use = np.empty(0), np.empty((0, 2)), (0.0, 0.0), 0.0, b"", np.empty(0)
    if forces is not None:
        tension, contact = forces.tension, forces.contact
        pull, moment = forces.needle_force.tolist(), forces.needle_moment
        if forces.friction_use.any():
            states, use = bytes(forces.friction_states), forces.friction_use
    nodes = np.flatnonzero(contact.any(axis=1))
    words = (prediction.formulation, prediction.scene_version, material, prediction.solver, prediction.status)
    formulation, scene, thread, solver, status = map(text, words)
    sizes = (formulation[0], scene[0], thread[0], len(vertices), len(prediction.strain), solver[0], status[0])
    return BEGIN + _prediction_form(*sizes, len(tension), len(nodes), len(use)).pack(
        *time,
        *DISH,
        *formulation,
        *scene,
        *thread,
        len(vertices),
        points_of(vertices),
        len(prediction.strain),
        numbers(prediction.strain, REAL),
        len(tension),
        numbers(tension, REAL),
        len(nodes),
        numbers(nodes, _NODE),
        len(nodes),
        points_of(contact[nodes]),
        *pull,
        0.0,
        moment,
        len(states),
        states,
        len(use),
        numbers(use, REAL),
        *solver,
        *status,
        prediction.residual,
        prediction.interval,
        prediction.substeps,
        step_time,
    )


def packed_estimate(time: Time, estimate: ThreadEstimate) -> bytes:
    """Return an EstimatedThread.

    Args:
        time: of the frame, seconds and nanoseconds.
        estimate: of the thread at the same time.
    """
    positions, disturbances = estimate.positions, estimate.disturbances
    scene, problems = text(estimate.prediction.scene_version), [text(why) for why in estimate.problems[:MAX_PROBLEMS]]
    square, degrees = (0.0, 0) if estimate.innovations is None else estimate.innovations.total
    sizes = tuple(size for size, _ in problems)
    return BEGIN + _estimate_form(scene[0], len(positions), len(disturbances), sizes).pack(
        *time,
        *DISH,
        *scene,
        len(positions),
        points_of(positions),
        len(positions),
        numbers(estimate.deviation, REAL),
        4 * len(positions),
        numbers(estimate.covariance, REAL),
        not estimate.corrected,
        estimate.unmeasured_for,
        estimate.hidden,
        estimate.points,
        square,
        degrees,
        len(disturbances),
        *[
            part
            for found in disturbances
            for part in (
                found.arc_length,
                found.extent,
                *found.position,
                0.0,
                *found.direction,
                0.0,
                found.force,
                found.significance,
                *time_of(round(found.since * 1e9)),
            )
        ],
        len(problems),
        *[part for problem in problems for part in problem],
        estimate.converged,
        estimate.residual,
    )


def packed_margins(
    time: Time, margins: Margins | None, reason: str = "", scene_version: str = "", *, of_estimate: bool = False
) -> bytes:
    """Return a SafetyMargins: every barrier, the minimum of each, and what is in contact; or why there are none.

    Args:
        time: of the pose, seconds and nanoseconds.
        margins: of the thread; None where there are none.
        reason: why there are none.
        scene_version: of the scene in force where there are none.
        of_estimate: whether they are of the estimated thread; else of the predicted one.
    """
    scene = text(scene_version if margins is None else margins.scene_version)
    if margins is None:
        words = text(reason)
        return BEGIN + _no_margins_form(scene[0], words[0]).pack(
            *time, *DISH, *scene, False, *words, _OF_NOTHING, *[0] * 8, _UNKNOWN, 0, FrictionState.UNKNOWN, 0, 1.0
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
    real = [(name, REAL) for name in ("value", "clearance", "bound")]
    for attribute, kind in (("node", _NODE), ("obstacle", _OBSTACLE), *real):
        columns.append(b"".join(numbers(getattr(barrier, attribute), kind) for barrier in margins.barriers))
    return BEGIN + layout.pack(
        *time,
        *DISH,
        *scene,
        True,
        *EMPTY,
        _OF_ESTIMATE if of_estimate else _OF_PREDICTION,
        len(names),
        *[part for name in names for part in name],
        *[part for column in columns for part in (count, column)],
        len(minima),
        *[
            part
            for name, row in minima
            for part in (*name, row.node[0], row.obstacle[0], row.value[0], row.clearance[0], row.bound[0])
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
    formulation: int,
    scene: int,
    material: int,
    vertices: int,
    segments: int,
    solver: int,
    status: int,
    tensions: int,
    contacts: int,
    rubbed: int,
) -> struct.Struct:
    """Return the format of a PredictedThread with texts of these lengths, and so many vertices, segments and forces."""
    begin = (*HEADER, *text_codes(formulation), *text_codes(scene), *text_codes(material))
    arrays = (*array_codes(vertices, "d", 3), *array_codes(segments, "d"), *array_codes(tensions, "d"))
    pushes = (*array_codes(contacts, "I"), *array_codes(contacts, "d", 3), *"dddd")
    friction = (*array_codes(rubbed, "B"), *array_codes(rubbed, "d"))
    return form(*begin, *arrays, *pushes, *friction, *text_codes(solver), *text_codes(status), "d", "d", "I", "d")


@lru_cache(KEPT)
def _estimate_form(scene: int, nodes: int, disturbances: int, problems: tuple[int, ...]) -> struct.Struct:
    """Return the format of an EstimatedThread of so many nodes and disturbances, and problems of these lengths."""
    return form(
        *HEADER,
        *text_codes(scene),
        *array_codes(nodes, "d", 3),
        *array_codes(nodes, "d"),
        *array_codes(4 * nodes, "d"),
        *("?", "d", "d", "I", "d", "I"),
        "I",
        *[*"d" * 10, "i", "I"] * disturbances,
        "I",
        *[code for size in problems for code in text_codes(size)],
        *("?", "d"),
    )


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
        "B",
        "I",
        *[code for size in names for code in text_codes(size)],
        *[code for kind in "BIiddd" for code in array_codes(rows, kind)],
        "I",
        *[code for size in minima for code in (*text_codes(size), "I", "i", "d", "d", "d")],
        *_nodes(touching),
        *_nodes(squeezed),
        "d",
    )


@lru_cache(KEPT)
def _no_margins_form(scene: int, reason: int) -> struct.Struct:
    """Return the format of a SafetyMargins without any, but a reason of this length."""
    return form(*HEADER, *text_codes(scene), "?", *text_codes(reason), "B", *"IIIIIIII", *_nodes(0), *_nodes(0), "d")


def _nodes(count: int) -> tuple[str, ...]:
    """Return the codes of a state and the nodes that it is about."""
    return "B", "I", *"I" * count
