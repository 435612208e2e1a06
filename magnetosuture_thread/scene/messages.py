"""Between a scene and its message: one codec for nodes and bags, whose messages have the same fields."""

from __future__ import annotations

from typing import Any

from magnetosuture_thread.errors import ConfigurationError, InvalidInputError
from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.scene.scene import Dish, Scene, SceneShape


def scene_fields(scene: Scene) -> dict[str, Any]:
    """Return the fields of a message Scene but its header, as plain values; messages in it as dictionaries."""
    return {
        "version": scene.version,
        "dish_diameter": scene.dish.diameter,
        "dish_depth": scene.dish.depth,
        "shapes": [_shape_fields(shape) for shape in scene.shapes],
    }


def scene_of(message: Any) -> Scene:
    """Return the scene of a message, whoever decoded it: rclpy's and the bags' have the same fields.

    Raises:
        InvalidInputError: the content has another hash than the message says.
        ConfigurationError: the content is no scene.
    """
    shapes = tuple(SceneShape(shape.name, shape.kind, _geometry(shape)) for shape in message.shapes)
    scene = Scene(Dish(float(message.dish_diameter), float(message.dish_depth)), shapes)
    if scene.version != message.version:
        expected = f"{scene.version}, the hash of its content"
        raise InvalidInputError("scene.version", message.version[:100], expected)
    return scene


def _shape_fields(shape: SceneShape) -> dict[str, Any]:
    geometry, fields = shape.geometry, {"name": shape.name, "kind": shape.kind, "disc": [], "polygon": []}
    if isinstance(geometry, Disc):
        fields["disc"] = [{"x": geometry.centre[0], "y": geometry.centre[1], "radius": geometry.radius}]
    else:
        outline, *holes = [{"corners": [{"x": x, "y": y, "z": 0.0} for x, y in ring]} for ring in geometry.rings]
        fields["polygon"] = [{"outline": outline, "holes": holes}]
    return fields


def _geometry(shape: Any) -> Disc | Polygon:
    if len(shape.disc) + len(shape.polygon) != 1:
        raise ConfigurationError(f"scene.{shape.name}", "not one geometry", "one disc or one polygon")
    if len(shape.disc):
        disc = shape.disc[0]
        return Disc((float(disc.x), float(disc.y)), float(disc.radius))
    polygon = shape.polygon[0]
    rings = [tuple((float(c.x), float(c.y)) for c in ring.corners) for ring in (polygon.outline, *polygon.holes)]
    return Polygon(rings[0], tuple(rings[1:]))
