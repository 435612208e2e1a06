"""Scenes as messages magnetosuture_msgs/Scene: packed as CDR bytes, and parsed from messages of any library."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from magnetosuture_thread.bags.cdr import Stamp, pack
from magnetosuture_thread.geometry.obstacles import Disc, Polygon, triangulate
from magnetosuture_thread.geometry.scene import (
    MAX_NAME_CHARS,
    MAX_OUTLINES,
    MAX_SHAPES,
    MAX_VERTICES,
    VERSION_CHARS,
    Dish,
    Scene,
    SceneShape,
)
from magnetosuture_thread.geometry.shapes import Ring
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError
from magnetosuture_thread.settings.interface import DISH_FRAME, SCENE

SELF_CONTACT = {None: 0, True: 1, False: 2}  # as in Scene.msg


def packed_scene(stamp: Stamp, scene: Scene) -> bytes:
    """Return a scene as the CDR bytes of its message.

    A shape has a sequence of none or one disc, and one of none or one polygon.
    """
    layout, dish = "header text float64 float64 float64 uint8 uint32", scene.dish
    values: list[Any] = [stamp, scene.version, dish.diameter, dish.depth, dish.wall_friction]
    values += [SELF_CONTACT[dish.self_contact], len(scene.shapes)]
    for shape in scene.shapes:
        geometry = shape.geometry
        values += [shape.name, shape.kind]
        if isinstance(geometry, Disc):
            layout += " text text uint32 float64[3] uint32 float64"
            values += [1, (*geometry.centre, geometry.radius), 0]
        else:
            layout += " text text uint32 uint32 points uint32" + " points" * len(geometry.holes) + " float64"
            values += [0, 1, geometry.outline, len(geometry.holes), *geometry.holes]
        values.append(shape.friction)
    return pack(layout, *values)


def parse_scene_message(message: Any) -> Scene:
    """Parse a Scene message and validate it.

    Args:
        message: a magnetosuture_msgs/Scene of any library.

    Raises:
        InvalidInputError: another frame, anything out of bounds, or a content whose hash is not the message's
            version: it is damaged, or was made by other rules.
    """
    frame = message.header.frame_id
    if frame != DISH_FRAME:
        raise InvalidInputError(f"{SCENE.name}.header.frame_id", repr(frame[:MAX_NAME_CHARS]), repr(DISH_FRAME))
    _require_bounds(message.shapes)
    try:
        wall_friction = float(getattr(message, "wall_friction", 0.0))  # not in messages of before
        self_contact = _self_contact(int(getattr(message, "self_contact", 0)))
        dish = Dish(float(message.dish_diameter), float(message.dish_depth), wall_friction, self_contact)
        scene = Scene(dish, tuple(_shape_of(shape) for shape in message.shapes))
    except ConfigurationError as error:
        raise InvalidInputError(f"{SCENE.name}.{error.name}", repr(error.value), error.expectation) from None
    if message.version != scene.version:
        given = repr(message.version[: 2 * VERSION_CHARS])
        raise InvalidInputError(f"{SCENE.name}.version", given, f"{scene.version!r}, the hash of the content")
    return scene


def _self_contact(value: int) -> bool | None:
    if value not in SELF_CONTACT.values():
        raise ConfigurationError("self_contact", value, "0, 1 or 2, see the message's constants")
    return next(setting for setting, number in SELF_CONTACT.items() if number == value)


def parse_shape_message(message: Any) -> SceneShape:
    """Parse a SceneShape message and validate it.

    Raises:
        InvalidInputError: it is too large, or neither a disc nor a polygon.
        ConfigurationError: anything in it is out of bounds.
    """
    _require_bounds([message])
    shape = _shape_of(message)
    if isinstance(shape.geometry, Polygon):
        triangulate(shape.geometry)  # as its markers will be
    return shape


def _require_bounds(shapes: Sequence[Any]) -> None:
    """Refuse oversized shapes before anything is built from them."""

    def require(field: str, count: int, maximum: int) -> None:
        if count > maximum:
            raise InvalidInputError(f"{SCENE.name}.{field}", count, f"at most {maximum}")

    require("shapes", len(shapes), MAX_SHAPES)
    for index, shape in enumerate(shapes):
        field = f"shapes[{index}]"
        require(f"{field}.name", len(shape.name), MAX_NAME_CHARS)
        require(f"{field}.kind", len(shape.kind), MAX_NAME_CHARS)
        if len(shape.disc) + len(shape.polygon) != 1:
            given = f"{len(shape.disc)} discs and {len(shape.polygon)} polygons"
            raise InvalidInputError(f"{SCENE.name}.{field}", given, "one disc or one polygon")
    polygons = [polygon for shape in shapes for polygon in shape.polygon]
    rings = [ring for polygon in polygons for ring in (polygon.outline, *polygon.holes)]
    require("shapes.polygon", len(rings), MAX_OUTLINES)
    require("shapes.polygon.corners", sum(len(ring.corners) for ring in rings), MAX_VERTICES)


def _shape_of(shape: Any) -> SceneShape:
    geometry: Disc | Polygon
    try:
        if len(shape.disc):
            disc = shape.disc[0]
            geometry = Disc((float(disc.x), float(disc.y)), float(disc.radius))
        else:
            polygon = shape.polygon[0]
            geometry = Polygon(_ring(polygon.outline), tuple(_ring(hole) for hole in polygon.holes))
    except ConfigurationError as error:
        raise ConfigurationError(f"{shape.name}.{error.name}", error.value, error.expectation) from None
    return SceneShape(shape.name, shape.kind, geometry, friction=float(getattr(shape, "friction", 0.0)))


def _ring(outline: Any) -> Ring:
    return tuple((float(corner.x), float(corner.y)) for corner in outline.corners)
