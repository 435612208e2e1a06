"""Packs the markers of the thread as CDR bytes, for RViz and Foxglove."""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from magnetosuture_thread.barrier import COMPRESSION, CONNECTIVITY, ENHANCED_CONNECTIVITY, STIFFNESS
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.messages.building import ADD, LINE_STRIP, TRIANGLE_LIST
from magnetosuture_thread.messages.cdr import (
    BEGIN,
    DISH,
    EMPTY,
    HEADER,
    KEPT,
    Text,
    Time,
    array_codes,
    form,
    points_of,
    text,
    text_codes,
)
from magnetosuture_thread.model.estimator import ThreadEstimate
from magnetosuture_thread.model.estimator.estimate import ONE_SIDED_99
from magnetosuture_thread.model.margins import UNKNOWN, Margins, friction_colour
from magnetosuture_thread.model.prediction import Prediction

ARROW, SPHERE_LIST, TEXT_VIEW_FACING = 0, 7, 9  # as in Marker.msg
ARROW_LENGTH = 2.5e-3  # m; of a disturbance's arrow, whose head is where it acts
TEXT_HEIGHT, LINE_HEIGHT = 8e-4, 1e-3  # m
LIFETIME = 500_000_000  # ns of a text or arrow; poses come far more often
SEGMENT_BARRIERS = (CONNECTIVITY, ENHANCED_CONNECTIVITY, COMPRESSION, STIFFNESS)
_THREAD, _MARGINS, _PREDICTED, _DEVIATION, _DISTURBANCES = map(
    text, ("thread", "margins", "predicted", "deviation", "disturbances")
)
_INK, _RED = (0.1, 0.13, 0.16, 1.0), (0.78, 0.06, 0.18, 1.0)
_TEAL, _MAGENTA = (0.0, 0.6, 0.65, 0.35), (0.71, 0.09, 0.62, 0.9)


def packed_markers(
    time: Time,
    prediction: Prediction | None,
    margins: Margins | None,
    diameter: float,
    estimate: ThreadEstimate | None = None,
) -> bytes:
    """Return a MarkerArray: the thread, its nodes under friction, the minimum of each barrier; and what is estimated.

    The thread, in the namespace `thread`, is the one that the margins are of: the estimated one if there is one. The
    line has the colour of the friction, and the nodes under friction are spheres. A barrier's least clearance is
    written beside the node that has it, in the namespace `margins`, also for barriers that users added; those of
    single segments are not shown. The text disappears by its lifetime when its barrier has no row any more.

    Beside an estimate stand the predicted thread (`predicted`), the band in which the estimated one lies with a
    probability of 98 % (`deviation`), and an arrow and a text for each force that the model does not know of
    (`disturbances`).

    Source: [Forghani2025], algorithm "Real-Time Thread Sim with Visual Feedback": green where free, orange, darker
    with every node, where sliding under friction, blue where stuck. Deviation: grey where unknown.

    Args:
        time: of the pose, seconds and nanoseconds.
        prediction: the thread; None where there is none.
        margins: of the thread; None where there are none.
        diameter: of the thread [m].
        estimate: the thread; None where there is none.
    """
    thread = prediction if estimate is None else estimate
    assert thread is not None
    width = max(4.0 * diameter, 2e-4)  # wider than it is, so that it can be seen
    friction = UNKNOWN if margins is None else margins.friction
    colour = (*friction_colour(friction), 1.0)
    nodes = thread.positions
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
    if estimate is not None:
        markers += _estimate_markers(prediction, estimate, 0.4 * width)
    values = [value for marker in markers for value in marker.values(time)]
    codes = tuple((len(marker.points), len(marker.namespace[1]), len(marker.caption[1])) for marker in markers)
    return BEGIN + _markers_form(codes).pack(len(markers), *values)


def _estimate_markers(prediction: Prediction | None, estimate: ThreadEstimate, width: float) -> list[_Marker]:
    markers = [
        _Marker(_DEVIATION, 0, TRIANGLE_LIST, (1.0, 1.0, 1.0), _TEAL, points=deviation_band(estimate)),
    ]
    if prediction is not None:
        line = prediction.positions
        markers.append(_Marker(_PREDICTED, 0, LINE_STRIP, (width, 0.0, 0.0), _MAGENTA, points=line))
    for number, found in enumerate(estimate.disturbances):
        tip = np.array([found.position - ARROW_LENGTH * found.direction, found.position])
        sizes = (width, 4.0 * width, 4.0 * width)
        markers.append(_Marker(_DISTURBANCES, 2 * number, ARROW, sizes, _RED, points=tip))
        x, y = found.position - 1.3 * ARROW_LENGTH * found.direction
        size = (0.0, 0.0, TEXT_HEIGHT)
        markers.append(
            _Marker(_DISTURBANCES, 2 * number + 1, TEXT_VIEW_FACING, size, _RED, (x, y, 0.0), caption=text(str(found)))
        )
    return markers


def deviation_band(estimate: ThreadEstimate) -> Points:
    """Return the triangles of the band within 2.33 standard deviations of the estimated thread, shape (6 n, 2) [m]."""
    nodes = estimate.positions
    along = np.gradient(nodes, axis=0)
    across = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.hypot(*along.T), 1e-12)[:, None]
    off = ONE_SIDED_99 * estimate.deviation[:, None] * across
    left, right = nodes + off, nodes - off
    corners = (left[:-1], right[:-1], left[1:], left[1:], right[:-1], right[1:])
    return np.stack(corners, axis=1).reshape(-1, 2)


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
        upright, lifetime = (0.0, 0.0, 0.0, 1.0), (0, LIFETIME if self.kind in (TEXT_VIEW_FACING, ARROW) else 0)
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
