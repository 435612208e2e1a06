"""Moments of a run as vector pictures: dish, shapes, thread, needle, and where it was to go."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.campaign.extremes import RunInstant
from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.scene import Scene

CLOSE_UP = 4.0  # lengths of the needle: side of a close-up
MIN_CLOSE_UP = 8e-3  # m
BORDER = 0.02  # of the dish's radius, around it
MIN_COMMAND = 1e-6  # m/s; a smaller command has no arrow


@dataclass(frozen=True)
class ShapeOutline:
    """A shape as the path of an SVG.

    Attributes:
        kind: of the shape.
        path: of its outline and holes [mm].
    """

    kind: str
    path: str


@dataclass(frozen=True)
class InstantPicture:
    """A instant as an SVG shows it: lengths in mm, y upwards.

    Attributes:
        instant: what is shown.
        box: left, lower end, width and height of what is shown.
        thread: vertices, as an SVG's list of points.
        needle: its axis, likewise.
        path: planned way of its middle, likewise; empty without one.
        command: ends of an arrow from the tip, x1, y1, x2, y2; empty where nothing is commanded.
        is_overview: whether the whole dish is shown.
    """

    instant: RunInstant
    box: tuple[float, float, float, float]
    thread: str
    needle: str
    path: str
    command: tuple[float, ...]
    is_overview: bool


def outline_shapes(scene: Scene) -> list[ShapeOutline]:
    """Return the shapes of a scene."""
    return [ShapeOutline(shape.kind, _outline(shape.geometry)) for shape in scene.shapes]


def picture_instant(instant: RunInstant, scene: Scene, speed: float, *, overview: bool = False) -> InstantPicture:
    """Return the picture of a instant, the whole dish or the surroundings of the needle.

    Args:
        instant: to show.
        scene: around it.
        speed: at which the arrow of the command has the needle's length [m/s].
        overview: whether the whole dish is shown.
    """
    axis, frame = instant.axis, instant.frame
    length = float(np.linalg.norm(axis[-1] - axis[0]))
    if overview:
        half = (1.0 + BORDER) * scene.dish.radius
        centre = np.zeros(2)
    else:
        half = 0.5 * max(CLOSE_UP * length, MIN_CLOSE_UP)
        centre = 0.5 * (axis[0] + axis[-1])
    low = 1e3 * (centre - half)
    command: tuple[float, ...] = ()
    if math.hypot(*frame.commanded) > MIN_COMMAND:
        ends = np.concatenate([axis[-1], axis[-1] + length / speed * frame.commanded])
        command = tuple(round(1e3 * value, 3) for value in ends.tolist())
    return InstantPicture(
        instant,
        (round(float(low[0]), 3), round(float(low[1]), 3), round(2e3 * half, 3), round(2e3 * half, 3)),
        _points(frame.thread),
        _points(axis),
        "" if instant.path is None else _points(instant.path),
        command,
        overview,
    )


def _points(vertices: Points) -> str:
    return " ".join(f"{1e3 * x:.3f},{1e3 * y:.3f}" for x, y in vertices.tolist())


def _outline(geometry: Disc | Polygon) -> str:
    if isinstance(geometry, Disc):
        x, y, r = (1e3 * value for value in (*geometry.centre, geometry.radius))
        return f"M{x - r:.3f},{y:.3f}a{r:.3f},{r:.3f} 0 1 0 {2 * r:.3f},0a{r:.3f},{r:.3f} 0 1 0 {-2 * r:.3f},0z"
    return "".join(f"M{_points(ring).replace(' ', 'L')}z" for ring in geometry.rings)
