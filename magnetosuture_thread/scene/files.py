"""Scene files: a dish and named shapes in YAML.

dish: {diameter: 0.05, depth: 0.004}     # [m]
shapes:
  ring: {annulus: {center: [0.0, 0.005], inner_radius: 0.0045, outer_radius: 0.006}, kind: tissue}
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import yaml

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.resources import find_scene_file
from magnetosuture_thread.scene.errors import scene_error
from magnetosuture_thread.scene.geojson import scene_from_geojson, scene_to_geojson
from magnetosuture_thread.scene.mapping import scene_from_mapping, scene_to_mapping
from magnetosuture_thread.scene.scene import Scene
from magnetosuture_thread.scene.text import parse_json, parse_yaml, read_text

GEOJSON_ENDINGS = (".json", ".geojson")


class _Dumper(yaml.SafeDumper):
    """Writes lists that are the same object twice, as nothing that reads scenes takes aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        """Return True: nothing is written as an alias."""
        return True


def read_scene(name: str) -> Scene:
    """Read a scene, given as a path or as the name of one that ships with the package.

    Raises:
        ConfigurationError: there is no such file, it is no regular file of at most 1 MB, or it holds anything
            invalid.
    """
    try:
        path = find_scene_file(name)
    except ConfigurationError as error:
        raise scene_error(error.name, error.value, error.expectation) from None
    text = read_text(path)
    if path.suffix in GEOJSON_ENDINGS:
        return scene_from_geojson(parse_json(text, str(path)), str(path))
    return scene_from_mapping(parse_yaml(text, str(path)), str(path))


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
        raise scene_error("scene file", error.strerror or str(error), "a file that can be written", str(path)) from None
