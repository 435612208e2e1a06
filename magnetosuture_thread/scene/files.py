"""Scene files: a dish and named shapes in YAML, or GeoJSON, parsed with limits on size and depth; and their editing.

dish: {diameter: 0.05, depth: 0.004}     # [m]
shapes:
  ring: {annulus: {center: [0.0, 0.005], inner_radius: 0.0045, outer_radius: 0.006}, kind: tissue}
"""

from __future__ import annotations

import json
import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import yaml

from magnetosuture_thread.configuration import Configuration, autostart_parameter, use_ros_numbers
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.files import read_regular
from magnetosuture_thread.outputs import output_problem
from magnetosuture_thread.resources import find_scene_file
from magnetosuture_thread.scene.geojson import scene_from_geojson, scene_to_geojson
from magnetosuture_thread.scene.scene import MAX_NAME_CHARS, Scene, SceneShape, scene_error
from magnetosuture_thread.scene.shapes import scene_from_mapping, scene_to_mapping, shape_from_mapping
from magnetosuture_thread.shared_parameters import shared_parameter
from magnetosuture_thread.untrusted import MAX_TEXT_BYTES, MAX_YAML_DEPTH, BudgetError, check_yaml

GEOJSON_ENDINGS = (".json", ".geojson")
MAX_SCALAR_CHARS = 1000
_PLAIN_YAML = f"plain YAML, at most {MAX_YAML_DEPTH} deep"


class _SceneLoader(yaml.CSafeLoader):  # the loader without libyaml takes ten times as long
    """Reads YAML as setup files are read: 1e-5 is a number, nothing is a date, keys are unique."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return a mapping whose keys are text, each of them once."""
        keys = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.tag != "tag:yaml.org,2002:str":
                name = f"the name {key.value}" if isinstance(key, yaml.ScalarNode) else "a name"
                raise yaml.constructor.ConstructorError(None, None, f"{name} that is no text", key.start_mark)
            if key.value in keys:
                raise yaml.constructor.ConstructorError(None, None, f"{key.value} is given twice", key.start_mark)
            keys.add(key.value)
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        return mapping


use_ros_numbers(_SceneLoader, decimal_integers=True)


def read_text(path: Path) -> str:
    """Return the text of a regular file of at most `MAX_TEXT_BYTES`.

    Raises:
        ConfigurationError: it cannot be read, is a device or a pipe, is too large, or is no text.
    """
    expectation = f"a regular file of at most {MAX_TEXT_BYTES // 1000} kB of text"
    try:
        return read_regular(path, MAX_TEXT_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise scene_error("scene file", "bytes that are no UTF-8 text", expectation, str(path)) from None
    except (OSError, ValueError) as error:
        problem = getattr(error, "strerror", None) or str(error)
        raise scene_error("scene file", problem, expectation, str(path)) from None


def parse_yaml(text: str, source: str = "", what: str = "scene file") -> Any:
    """Return the content of a YAML text: mappings with text for keys, lists, numbers, text, true, false and null.

    Raises:
        ConfigurationError: it is no YAML, or uses aliases or tags, or is too deep.
    """
    try:
        check_yaml(text)
        for event in yaml.parse(text, Loader=yaml.CSafeLoader):
            problem = ""
            if isinstance(event, yaml.ScalarEvent) and len(event.value) > MAX_SCALAR_CHARS:
                problem = f"a word of {len(event.value)} characters"
            elif isinstance(event, yaml.NodeEvent) and getattr(event, "tag", None) not in (None, "!"):
                problem = "a tag (!)"
            if problem:
                where = f" in line {event.start_mark.line + 1}" if event.start_mark else ""
                raise scene_error(what, problem + where, _PLAIN_YAML, source)
        return yaml.load(text, _SceneLoader)
    except BudgetError as error:
        raise scene_error(what, str(error), _PLAIN_YAML, source) from None
    except yaml.YAMLError as error:
        problem = " ".join(str(getattr(error, "problem", None) or error).split())
        mark = getattr(error, "problem_mark", None)
        raise scene_error(what, problem + (f" in line {mark.line + 1}" if mark else ""), "valid YAML", source) from None
    except (ValueError, UnicodeError):
        raise scene_error(what, "a character that YAML does not allow", "valid YAML", source) from None


def parse_json(text: str, source: str = "", what: str = "scene file") -> Any:
    """Return the content of a JSON text; duplicate names, NaN and Infinity are refused.

    Raises:
        ConfigurationError: it is no JSON, or is too deep.
    """

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        mapping = dict(pairs)
        if len(mapping) < len(pairs):
            twice, _ = Counter(name for name, _ in pairs).most_common(1)[0]
            raise scene_error(what, f"{twice} is given twice", "each name once", source)
        return mapping

    def whole(digits: str) -> int:
        if len(digits) > MAX_SCALAR_CHARS:
            raise scene_error(what, digits, "a number that can be written", source)
        return int(digits)

    def constant(name: str) -> float:
        raise scene_error(what, name, "finite numbers", source)

    try:
        # Its own depth is bounded by that of Python's stack: the error for it is caught below.
        found = json.loads(text, object_pairs_hook=once, parse_int=whole, parse_constant=constant)
    except json.JSONDecodeError as error:
        raise scene_error(what, f"{error.msg} in line {error.lineno}", "valid JSON", source) from None
    except RecursionError:
        raise scene_error(what, "lists too deep", f"JSON at most {MAX_YAML_DEPTH} deep", source) from None
    return found


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
    if problem := output_problem(path):
        raise scene_error("scene file", problem, "a file that can be written", str(path))
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise scene_error("scene file", error.strerror or str(error), "a file that can be written", str(path)) from None


@dataclass(frozen=True)
class SceneServerSettings(Configuration):
    """The scene that is published first."""

    GROUP: ClassVar[str] = "scene_server"

    autostart: str = autostart_parameter()
    scene: str = shared_parameter("scene")


MAX_SHAPE_CHARS = 300_000  # 10,000 vertices in full precision


class SceneEditor:
    """Holds the active scene and edits it; an invalid edit leaves it unchanged.

    Args:
        scene: the initial scene; None until one is loaded.

    Attributes:
        scene: the active scene.

    Each edit raises `ConfigurationError` where it is invalid, whatever the text.
    """

    def __init__(self, scene: Scene | None = None) -> None:
        self.scene = scene

    def load(self, file: str) -> None:
        """Load the scene of a file, given as a path or as the name of one that ships with the package."""
        _require_length("file", file, 4096)
        self.scene = read_scene(file)

    def add(self, name: str, shape: str) -> None:
        """Append a shape; the text is its description as in a scene file."""
        self.scene = self._require_scene().add(_parse_shape(name, shape))

    def replace(self, name: str, shape: str) -> None:
        """Replace the shape of the same name."""
        self.scene = self._require_scene().replace(_parse_shape(name, shape))

    def remove(self, name: str) -> None:
        """Remove a shape."""
        self.scene = self._require_scene().remove(name)

    def _require_scene(self) -> Scene:
        if self.scene is None:
            expectation = "a scene that is loaded first, of which the dish is known"
            raise scene_error("scene", "a change of a shape", expectation)
        return self.scene


def _parse_shape(name: str, text: str) -> SceneShape:
    _require_length("name", name, MAX_NAME_CHARS)
    _require_length("shape", text, MAX_SHAPE_CHARS)
    description: Any = parse_yaml(text, what="shape")
    return shape_from_mapping(name, description)


def _require_length(field: str, text: str, max_chars: int) -> None:
    if len(text) > max_chars:
        raise scene_error(field, f"{len(text)} characters", f"at most {max_chars}")
