"""Packs markers for RViz and Foxglove: the thread, its forecast, the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.bags.packing import Stamp, forecast_instants, pack, time_or_nan
from magnetosuture_thread.geometry.barrier import COMPRESSION, CONNECTIVITY, ENHANCED_CONNECTIVITY, STIFFNESS
from magnetosuture_thread.geometry.obstacles import Disc, triangulate
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.thread.margins import UNKNOWN, Margins, friction_colour
from magnetosuture_thread.thread.prediction import Prediction

if TYPE_CHECKING:
    from magnetosuture_thread.estimator import ThreadEstimate
    from magnetosuture_thread.forecast import Forecast

LIFETIME = 500_000_000  # ns of a text, an arrow or a forecast; poses come far more often

Colour = tuple[float, ...]
Place = Sequence[float] | NDArray[np.float64]
COLOURS: dict[str, Colour] = {
    "ink": (0.1, 0.13, 0.16),
    "alarm": (0.78, 0.06, 0.18),
    "deviation": (0.0, 0.6, 0.65),
    "predicted": (0.71, 0.09, 0.62),
    "forecast": (0.45, 0.3, 0.75),
    "rim": (0.45, 0.5, 0.55),
    "tissue": (0.85, 0.65, 0.6),
    "instrument": (0.55, 0.6, 0.66),
    "wall": (0.45, 0.42, 0.38),
}


class MarkerType(IntEnum):
    """Types of markers, as in Marker.msg."""

    ARROW = 0
    CYLINDER = 3
    LINE_STRIP = 4
    SPHERE_LIST = 7
    TEXT_VIEW_FACING = 9
    TRIANGLE_LIST = 11


class Marker(NamedTuple):
    """A marker of visualization_msgs, as far as ours differ."""

    namespace: str
    number: int
    kind: int
    scale: tuple[float, float, float]
    colour: Colour
    opacity: float = 1.0
    place: Place = (0.0, 0.0, 0.0)
    points: Points = np.empty((0, 2))
    caption: str = ""
    lifetime: int = 0  # ns; 0 for ever
    action: int = 0  # as in Marker.msg: add


def _line(name: str, number: int, width: float, colour: Colour, points: Points, opacity: float = 1.0) -> Marker:
    return Marker(name, number, MarkerType.LINE_STRIP, (width, 0.0, 0.0), colour, opacity, points=points)


def _triangles(name: str, number: int, colour: Colour, corners: Points, opacity: float) -> Marker:
    return Marker(name, number, MarkerType.TRIANGLE_LIST, (1.0, 1.0, 1.0), colour, opacity, points=corners)


def _text(name: str, number: int, colour: str, place: Place, caption: str, size: float = 8e-4) -> Marker:
    kind, scale = MarkerType.TEXT_VIEW_FACING, (0.0, 0.0, size)
    return Marker(name, number, kind, scale, COLOURS[colour], place=place, caption=caption, lifetime=LIFETIME)


# Header to points; then colours, a texture and its coordinates, the text, and a mesh, all empty but the text.
_MARKER = (
    "header text int32 int32 int32 float64[7] float64[3] float32[4] int32 uint32 bool points "
    "uint32 text time text text uint32 uint32 text text text uint32 bool "
)


def packed_markers(stamp: Stamp, markers: Sequence[Marker]) -> bytes:
    """Return a MarkerArray."""
    values: list[object] = []
    for marker in markers:
        pose = (*(*marker.place, 0.0)[:3], 0.0, 0.0, 0.0, 1.0)
        values += [stamp, marker.namespace, marker.number, marker.kind, marker.action, pose, marker.scale]
        values += [(*marker.colour, marker.opacity), *divmod(marker.lifetime, 10**9), False, marker.points]
        values += [0, "", 0, "", "", 0, 0, marker.caption, "", "", 0, False]
    return pack("uint32 " + _MARKER * len(markers), len(markers), *values)


def packed_thread_markers(
    stamp: Stamp,
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
        stamp: of the pose.
        prediction: the thread; None where there is none.
        margins: of the thread; None where there are none.
        diameter: of the thread [m].
        estimate: the thread; None where there is none.
    """
    thread = prediction if estimate is None else estimate
    assert thread is not None
    width = max(4.0 * diameter, 2e-4)  # wider than it is, so that it can be seen
    friction = UNKNOWN if margins is None else margins.friction
    colour, nodes = friction_colour(friction), thread.positions
    spheres, squeezed = (2.0 * width,) * 3, nodes[list(friction.nodes)]
    markers = [_line("thread", 0, width, colour, nodes)]
    markers.append(Marker("thread", 1, MarkerType.SPHERE_LIST, spheres, colour, points=squeezed))
    of_segments = (CONNECTIVITY, ENHANCED_CONNECTIVITY, COMPRESSION, STIFFNESS)
    minima = [] if margins is None else [minimum for minimum in margins.minima if minimum.barrier not in of_segments]
    for number, minimum in enumerate(minima):
        clearance = minimum.minimum_clearance
        x, y = nodes[minimum.node[0]]
        place = (x, y + (number + 1) * 1e-3)  # several may be closest at the same node
        caption = f"{minimum.barrier} {1e3 * clearance:.2f} mm"
        markers.append(_text("margins", number, "alarm" if clearance <= 0.0 else "ink", place, caption))
    if estimate is not None:
        markers.append(_triangles("deviation", 0, COLOURS["deviation"], deviation_band(estimate), 0.35))
        if prediction is not None:
            markers.append(_line("predicted", 0, 0.4 * width, COLOURS["predicted"], prediction.positions, 0.9))
        for number, force in enumerate(estimate.disturbances):  # an arrow of 2.5 mm whose head is where the force acts
            arrow = np.array([force.position - 2.5e-3 * force.direction, force.position])
            scale, place = (0.4 * width, 1.6 * width, 1.6 * width), force.position - 3.25e-3 * force.direction
            name, colour = "disturbances", COLOURS["alarm"]
            head = Marker(name, 2 * number, MarkerType.ARROW, scale, colour, points=arrow, lifetime=LIFETIME)
            markers += [head, _text(name, 2 * number + 1, "alarm", place, str(force))]
    return packed_markers(stamp, markers)


def deviation_band(estimate: ThreadEstimate) -> Points:
    """Return the triangles of the band within 2.33 standard deviations of the estimated thread, shape (6 n, 2) [m]."""
    # Only here: a scene server packs markers too, and needs no estimator.
    from magnetosuture_thread.estimator.estimator import ONE_SIDED_99

    nodes = estimate.positions
    along = np.gradient(nodes, axis=0)
    across = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.hypot(*along.T), 1e-12)[:, None]
    off = ONE_SIDED_99 * estimate.deviation[:, None] * across
    left, right = nodes + off, nodes - off
    corners = (left[:-1], right[:-1], left[1:], left[1:], right[:-1], right[1:])
    return np.stack(corners, axis=1).reshape(-1, 2)


def packed_forecast_markers(stamp: Stamp, forecast: Forecast) -> bytes:
    """Return a MarkerArray in the namespace `forecast`: the thread at three instants, and what happens when.

    The line is fainter the later the instant. The text stands beside the node of the first contact, else beside the
    needle's tail at the end. All disappear by themselves half a second after the last forecast.
    """
    markers = []
    for number, instant in enumerate(forecast_instants(forecast, 4)[1:]):
        ghost = _line("forecast", number, 1.5e-4, COLOURS["forecast"], forecast.vertices[instant], 0.8 - 0.2 * number)
        markers.append(ghost._replace(lifetime=LIFETIME))
    contact, caption = forecast.first_contact, forecast_text(forecast)
    if caption:
        place = forecast.tails[-1]
        if contact is not None:
            place = forecast.vertices[int(np.searchsorted(forecast.times, contact.time)), contact.node]
        markers.append(_text("forecast", 3, "alarm", place, caption))
    return packed_markers(stamp, markers)


def forecast_text(forecast: Forecast) -> str:
    """Return what will happen and when, for a person; empty where nothing does. See `forecast_events`."""
    contact = forecast.first_contact
    time, shape = (math.nan, "") if contact is None else (contact.time, contact.shape)
    friction, rest = time_or_nan(forecast.first_friction), time_or_nan(forecast.rest_time)
    return ", ".join(forecast_events(time, shape, friction, rest))


def forecast_events(contact: float, shape: str, friction: float, rest: float) -> list[str]:
    """Return what will happen and when, for a person, the first event first. What holds already is not announced.

    Args:
        contact: when the thread first touches something [s]; NaN for never, as for the other times.
        shape: that it touches, or "wall".
        friction: when its first node is under friction [s].
        rest: when the needle comes to rest although it is commanded to move [s].
    """
    events = []
    if contact > 0.0:
        events.append((contact, f"touches the {shape.replace('_', ' ')} in {contact:.1f} s"))
    if friction > 0.0:
        events.append((friction, f"friction in {friction:.1f} s"))
    if rest >= 0.0:
        events.append((rest, f"needle rests in {rest:.1f} s" if rest > 0.0 else "needle rests"))
    return [text for _, text in sorted(events)]


def packed_scene_markers(stamp: Stamp, scene: Scene) -> bytes:
    """Return a MarkerArray of a scene in place of the one before: the rim, each shape in its kind's colour, its name.

    A disc is a flat cylinder, a polygon the triangles that it is cut into.
    """
    diameter, thickness = scene.dish.diameter, 1e-3  # m; the latter of a disc's cylinder
    angles = np.linspace(0.0, 2.0 * math.pi, 181)
    rim = scene.dish.radius * np.column_stack([np.cos(angles), np.sin(angles)])
    delete_all = Marker("", 0, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, action=3)
    markers = [delete_all, _line("dish", 0, 0.005 * diameter, COLOURS["rim"], rim, 0.8)]
    for index, shape in enumerate(scene.shapes):
        geometry, colour = shape.geometry, COLOURS[shape.kind]
        if isinstance(geometry, Disc):
            scale = (2.0 * geometry.radius, 2.0 * geometry.radius, thickness)
            markers.append(Marker("shapes", index, MarkerType.CYLINDER, scale, colour, 0.8, geometry.centre))
        else:
            markers.append(_triangles("shapes", index, colour, triangulate(geometry).reshape(-1, 2), 0.8))
        name = _text("names", index, "ink", (*shape.label_point, thickness), shape.name, 0.025 * diameter)
        markers.append(name._replace(lifetime=0))
    return packed_markers(stamp, markers)
