"""Scene files: a dish and named shapes in YAML.

dish: {diameter: 0.05, depth: 0.004}     # [m]
shapes:
  ring: {annulus: {center: [0.0, 0.005], inner_radius: 0.0045, outer_radius: 0.006}, kind: tissue}
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.resources import scene_file
from magnetosuture_thread.scene.definitions import (
    description_of,
    dish_from_mapping,
    scene_of_parts,
    shape_from_mapping,
)
from magnetosuture_thread.scene.geojson import scene_from_geojson, scene_to_geojson
from magnetosuture_thread.scene.refusal import refusal
from magnetosuture_thread.scene.scene import MAX_SHAPES, Scene
from magnetosuture_thread.scene.text import parse_json, parse_yaml, read_text

GEOJSON_ENDINGS = (".json", ".geojson")


class _Dumper(yaml.SafeDumper):
    """Writes lists that are the same object twice, as nothing that reads scenes takes aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        """Say that nothing is written as an alias."""
        return True


def read_scene(name: str) -> Scene:
    """Read a scene, given as a path or as the name of one that ships with the package.

    Raises:
        ConfigurationError: there is no such file, it is no regular file of at most 1 MB, or it holds anything
            invalid.
    """
    try:
        path = scene_file(name)
    except ConfigurationError as error:
        raise refusal(error.name, error.value, error.expectation) from None
    text = read_text(path)
    if path.suffix in GEOJSON_ENDINGS:
        return scene_from_geojson(parse_json(text, str(path)), str(path))
    return scene_from_mapping(parse_yaml(text, str(path)), str(path))


def scene_from_mapping(content: Any, source: str = "") -> Scene:
    """Return a scene from what a scene file holds.

    Args:
        content: the file's content.
        source: its name, for errors.

    Raises:
        ConfigurationError: anything in it is missing, unknown or out of bounds.
    """
    if not isinstance(content, Mapping) or "dish" not in content:
        raise refusal("scene", content, "dish, and shapes by name", source)
    for name, value in content.items():
        if name not in ("dish", "shapes"):
            raise refusal(str(name), value, "dish and shapes, nothing else", source)
    dish, shapes = dish_from_mapping(content["dish"], source), content.get("shapes")
    if shapes is None:
        shapes = {}
    if not isinstance(shapes, Mapping):
        raise refusal("shapes", shapes, "shapes by name", source)
    if len(shapes) > MAX_SHAPES:
        raise refusal("shapes", f"{len(shapes)} shapes", f"at most {MAX_SHAPES}", source)
    made = tuple(shape_from_mapping(name, description, source) for name, description in shapes.items())
    return scene_of_parts(dish, made, source)


def scene_to_mapping(scene: Scene) -> dict[str, Any]:
    """Return what a scene file holds for a scene; a shape without a definition as disc or polygon."""
    return {
        "dish": {"diameter": scene.dish.diameter, "depth": scene.dish.depth},
        "shapes": {shape.name: description_of(shape) for shape in scene.shapes},
    }


def write_scene(scene: Scene, path: Path) -> None:
    """Write a scene file: GeoJSON where its name ends in .json or .geojson, else YAML. It is whole or not there.

    Raises:
        ConfigurationError: it cannot be written.
    """
    if path.suffix in GEOJSON_ENDINGS:
        text = json.dumps(scene_to_geojson(scene), indent=1, allow_nan=False) + "\n"
    else:
        content = scene_to_mapping(scene)
        text = yaml.dump(content, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=120)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise refusal("scene file", error.strerror or str(error), "a file that can be written", str(path)) from None
