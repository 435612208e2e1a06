"""Conversion between scenes and the content of scene files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Disc, Polygon, triangulate
from magnetosuture_thread.scene.scene import (
    KINDS,
    MAX_NAME_CHARS,
    MAX_SHAPES,
    Dish,
    Scene,
    SceneShape,
    is_name,
    is_number,
    scene_error,
)
from magnetosuture_thread.scene.shapes import ROUNDABLE, SHAPES, ShapeFields

DISH_FIELDS = ("diameter", "depth", "wall_friction", "self_contact")
MAX_CORNER_RADIUS = 0.1  # m


def shape_from_mapping(name: str, description: Any, source: str = "") -> SceneShape:
    """Return a shape from its description: its fields under the name of a shape, its kind, corner radius and friction.

    Args:
        name: of the shape.
        description: for example `{"disc": {"center": [0.0, 0.0], "radius": 0.001}, "kind": "instrument"}`. SI units
            and radians throughout.
        source: the file that it comes from, for errors.

    Raises:
        ConfigurationError: a field is missing, unknown or out of its bounds, or the shape bounds no area.
    """
    if not isinstance(name, str) or not is_name(name):
        raise scene_error("shapes", name, f"names of 1 to {MAX_NAME_CHARS} printable characters", source)
    if not isinstance(description, Mapping):
        raise scene_error(name, description, f"a shape, one of {', '.join(SHAPES)}", source)
    types = [key for key in description if key in SHAPES]
    unknown = [key for key in description if key not in (*SHAPES, "kind", "corner_radius", "friction")]
    if unknown or len(types) != 1:
        value = unknown[0] if unknown else types or "no shape"
        raise scene_error(name, value, f"kind, corner_radius, friction and one of {', '.join(SHAPES)}", source)
    type_name = types[0]
    radius = description.get("corner_radius", 0.0)
    if not is_number(radius) or not 0.0 <= radius <= MAX_CORNER_RADIUS:
        raise scene_error(f"{name}.corner_radius", radius, f"a number from 0 to {MAX_CORNER_RADIUS:g} m", source)
    if radius > 0.0 and type_name not in ROUNDABLE:
        raise scene_error(f"{name}.corner_radius", radius, f"0 m: a {type_name} has no corners", source)
    fields = ShapeFields(name, type_name, description[type_name], source)
    kind = description.get("kind", "tissue")
    if kind not in KINDS:
        raise scene_error(f"{name}.kind", kind, f"one of {', '.join(KINDS)}", source)
    try:
        geometry = SHAPES[type_name](fields, float(radius))
        fields.require_all_used()
        if isinstance(geometry, Polygon):
            triangulate(geometry)
        apart = ("kind", "friction")
        definition = {field: value for field, value in _to_builtin(description).items() if field not in apart}
        return SceneShape(name, kind, geometry, definition, _number_or_given(description.get("friction", 0.0)))
    except ConfigurationError as error:
        if error.source or error.name.startswith(f"{name}."):
            raise
        raise scene_error(f"{name}.{error.name}", error.value, error.expectation, source) from None


def _number_or_given(value: Any) -> Any:
    """Return a number as a float; anything else unchanged, to be refused."""
    return float(value) if is_number(value) else value


def _to_builtin(value: Any) -> Any:
    """Return a copy of a description in types that YAML and JSON can write, whatever numbers and lists it has."""
    if isinstance(value, Mapping):
        return {str(name): _to_builtin(entry) for name, entry in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_to_builtin(entry) for entry in value]
    if isinstance(value, float):
        return float(value)
    return value


def dish_from_mapping(values: Any, source: str = "") -> Dish:
    """Return a dish from its fields; all but the diameter may be left out.

    Raises:
        ConfigurationError: a field is missing, unknown or out of its bounds.
    """
    if not isinstance(values, Mapping) or "diameter" not in values:
        raise scene_error("dish", values, "diameter and depth [m]", source)
    for field in values:
        if field not in DISH_FIELDS:
            raise scene_error(f"dish.{field}", values[field], f"one of {', '.join(DISH_FIELDS)}", source)
    numbers = {field: value for field, value in values.items() if field != "self_contact"}
    for field, value in numbers.items():
        if not is_number(value):
            unit = "" if field == "wall_friction" else " [m]"
            raise scene_error(f"dish.{field}", value, f"a number{unit}", source)
    try:
        given = {field: float(value) for field, value in numbers.items()}
        return Dish(**given, self_contact=values.get("self_contact"))
    except ConfigurationError as error:
        raise ConfigurationError(error.name, error.value, error.expectation, source) from None


def dish_to_mapping(dish: Dish) -> dict[str, float | bool]:
    """Return a dish as a scene file describes it."""
    fields: dict[str, float | bool] = {"diameter": dish.diameter, "depth": dish.depth}
    if dish.wall_friction:
        fields["wall_friction"] = dish.wall_friction
    if dish.self_contact is not None:
        fields["self_contact"] = dish.self_contact
    return fields


def make_scene(dish: Dish, shapes: tuple[SceneShape, ...], source: str = "") -> Scene:
    """Return a scene; an error names the file.

    Raises:
        ConfigurationError: the shapes do not fit together, or not into the dish.
    """
    try:
        return Scene(dish, shapes)
    except ConfigurationError as error:
        raise ConfigurationError(error.name, error.value, error.expectation, source) from None


def shape_to_mapping(shape: SceneShape) -> dict[str, Any]:
    """Return a shape as a scene file describes it; one without a definition as disc or polygon."""
    common: dict[str, Any] = {"kind": shape.kind, **({"friction": shape.friction} if shape.friction else {})}
    if shape.definition:
        return {**_to_builtin(shape.definition), **common}
    geometry = shape.geometry
    if isinstance(geometry, Disc):
        return {"disc": {"center": list(geometry.centre), "radius": geometry.radius}, **common}
    fields: dict[str, Any] = {"outline": [list(point) for point in geometry.outline]}
    if geometry.holes:
        fields["holes"] = [[list(point) for point in hole] for hole in geometry.holes]
    return {"polygon": fields, **common}


def scene_from_mapping(content: Any, source: str = "") -> Scene:
    """Return a scene from what a scene file holds.

    Args:
        content: the file's content.
        source: its name, for errors.

    Raises:
        ConfigurationError: anything in it is missing, unknown or out of bounds.
    """
    if not isinstance(content, Mapping) or "dish" not in content:
        raise scene_error("scene", content, "dish, and shapes by name", source)
    for name, value in content.items():
        if name not in ("dish", "shapes"):
            raise scene_error(str(name), value, "dish and shapes, nothing else", source)
    dish, shapes = dish_from_mapping(content["dish"], source), content.get("shapes")
    if shapes is None:
        shapes = {}
    if not isinstance(shapes, Mapping):
        raise scene_error("shapes", shapes, "shapes by name", source)
    if len(shapes) > MAX_SHAPES:
        raise scene_error("shapes", f"{len(shapes)} shapes", f"at most {MAX_SHAPES}", source)
    made = tuple(shape_from_mapping(name, description, source) for name, description in shapes.items())
    return make_scene(dish, made, source)


def scene_to_mapping(scene: Scene) -> dict[str, Any]:
    """Return what a scene file holds for a scene; a shape without a definition as disc or polygon."""
    return {
        "dish": dish_to_mapping(scene.dish),
        "shapes": {shape.name: shape_to_mapping(shape) for shape in scene.shapes},
    }
