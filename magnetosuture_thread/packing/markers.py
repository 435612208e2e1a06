"""Packs what viewers draw of a thread as CDR bytes."""

from __future__ import annotations

import struct
from functools import lru_cache

from magnetosuture_thread.model.friction import Friction, friction_colour
from magnetosuture_thread.model.predictor import Prediction
from magnetosuture_thread.packing.layout import (
    BEGIN,
    DISH,
    EMPTY,
    HEADER,
    KEPT,
    Time,
    array_codes,
    form,
    points_of,
    text,
    text_codes,
)

_LINE_STRIP, _SPHERE_LIST, _ADD = 4, 7, 0  # as in Marker.msg
_NAMESPACE = text("thread")
_UPRIGHT = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def packed_markers(time: Time, prediction: Prediction, friction: Friction, diameter: float) -> bytes:
    """Return the predicted thread as a line in the colour of its friction, and the nodes under friction as balls.

    A MarkerArray.

    Source: [Forghani2025], algorithm "Real-Time Thread Sim with Visual Feedback": green where free, orange, darker
    with every node, where pulled under friction, blue where it rests. Deviation: grey where nobody knows.

    Args:
        time: of the pose, seconds and nanoseconds.
        prediction: the thread.
        friction: of it.
        diameter: of the thread [m].
    """
    width = max(4.0 * diameter, 2e-4)  # wider than it is, so that it can be seen
    colour = (*friction_colour(friction), 1.0)
    balls = prediction.vertices[list(friction.nodes)]
    line = _marker(time, 0, _LINE_STRIP, (width, 0.0, 0.0), colour, len(prediction.vertices))
    spheres = _marker(time, 1, _SPHERE_LIST, (2.0 * width,) * 3, colour, len(balls))
    packed = _form(len(prediction.vertices), len(balls)).pack(
        2, *line, points_of(prediction.vertices), *_REST, *spheres, points_of(balls), *_REST
    )
    return BEGIN + packed


def _marker(
    time: Time, number: int, kind: int, scale: tuple[float, ...], colour: tuple[float, ...], points: int
) -> tuple[object, ...]:
    return (*time, *DISH, *_NAMESPACE, number, kind, _ADD, *_UPRIGHT, *scale, *colour, 0, 0, False, points)


# Colours of single points, a texture with its header and picture, its coordinates, a text, a mesh and its file.
_REST = (0, *EMPTY, 0, 0, *EMPTY, *EMPTY, 0, 0, *EMPTY, *EMPTY, *EMPTY, 0, False)
_EMPTY = text_codes(EMPTY[0])
_REST_CODES = ("I", *_EMPTY, "i", "I", *_EMPTY, *_EMPTY, "I", "I", *_EMPTY, *_EMPTY, *_EMPTY, "I", "?")


@lru_cache(KEPT)
def _form(line: int, balls: int) -> struct.Struct:
    codes = ["I"]
    for points in (line, balls):
        codes += [*HEADER, *text_codes(_NAMESPACE[0]), "i", "i", "i", *"d" * 7, *"d" * 3, *"f" * 4, "i", "I", "?"]
        codes += [*array_codes(points, "d", 3), *_REST_CODES]
    return form(*codes)
