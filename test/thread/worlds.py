"""Scenes that the tests of the thread model share."""

from __future__ import annotations

from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.scene import Scene


def scene_with(*geometries: Disc | Polygon, diameter: float = 0.5) -> Scene:
    """Return a scene of some shapes, in a dish so wide that its wall is far unless a diameter is given [m]."""
    return Scene.create(dish_diameter=diameter, shapes={f"shape_{n}": shape for n, shape in enumerate(geometries)})


def polygon(*corners: float) -> Polygon:
    """Return a polygon without holes from x, y of each corner in turn [m]."""
    return Polygon(tuple(zip(corners[::2], corners[1::2], strict=True)))
