"""Scene files: a dish and named shapes in YAML.

dish: {diameter: 0.05, depth: 0.004}     # [m]
shapes:
  ring: {annulus: {center: [0.0, 0.005], inner_radius: 0.0045, outer_radius: 0.006}, kind: tissue}
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from magnetosuture_thread.configuration import read_yaml
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.resources import scene_file
from magnetosuture_thread.scene.definitions import shape_from_mapping
from magnetosuture_thread.scene.scene import Dish, Scene, SceneShape

DISH_FIELDS = ("diameter", "depth")


def read_scene(name: str) -> Scene:
    """Read a scene, given as a path or as the name of one that ships with the package.

    Raises:
        ConfigurationError: there is no such file, or it holds anything invalid.
    """
    path = scene_file(name)
    return scene_from_mapping(read_yaml(path, "scene file"), str(path))


def scene_from_mapping(content: Any, source: str = "") -> Scene:
    """Return a scene from what a scene file holds.

    Args:
        content: the file's content.
        source: its name, for errors.

    Raises:
        ConfigurationError: anything in it is missing, unknown or out of bounds.
    """
    if not isinstance(content, Mapping) or set(content) - {"dish", "shapes"} or "dish" not in content:
        raise ConfigurationError("scene", content, "dish, and shapes by name", source)
    dish, shapes = content["dish"], content.get("shapes") or {}
    if not isinstance(dish, Mapping) or set(dish) - set(DISH_FIELDS) or "diameter" not in dish:
        raise ConfigurationError("dish", dish, f"{' and '.join(DISH_FIELDS)} [m]", source)
    for field, value in dish.items():
        if not isinstance(value, (int, float)) or isinstance(value, bool):
            raise ConfigurationError(f"dish.{field}", value, "a number [m]", source)
    if not isinstance(shapes, Mapping):
        raise ConfigurationError("shapes", shapes, "shapes by name", source)
    made = tuple(shape_from_mapping(str(name), description, source) for name, description in shapes.items())
    try:
        return Scene(Dish(**{field: float(value) for field, value in dish.items()}), made)
    except ConfigurationError as error:
        raise ConfigurationError(error.name, error.value, error.expectation, source) from None


def scene_to_mapping(scene: Scene) -> dict[str, Any]:
    """Return what a scene file holds for a scene; a shape without a definition as disc or polygon."""
    return {
        "dish": {"diameter": scene.dish.diameter, "depth": scene.dish.depth},
        "shapes": {shape.name: _description(shape) for shape in scene.shapes},
    }


def write_scene(scene: Scene, path: Path) -> None:
    """Write a scene file."""
    text = yaml.safe_dump(scene_to_mapping(scene), sort_keys=False, default_flow_style=None, width=120)
    path.write_text(text, encoding="utf-8")


def _description(shape: SceneShape) -> dict[str, Any]:
    if shape.definition:
        return {**shape.definition, "kind": shape.kind}
    geometry = shape.geometry
    if isinstance(geometry, Disc):
        return {"disc": {"center": list(geometry.centre), "radius": geometry.radius}, "kind": shape.kind}
    fields = {"outline": [list(point) for point in geometry.outline]}
    if geometry.holes:
        fields["holes"] = [[list(point) for point in hole] for hole in geometry.holes]  # type: ignore[misc]
    return {"polygon": fields, "kind": shape.kind}
