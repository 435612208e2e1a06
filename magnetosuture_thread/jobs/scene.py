"""The jobs `magnetosuture scene check` and `draw`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.jobs.output import whole_file
from magnetosuture_thread.scene import Scene, SceneShape, read_scene
from magnetosuture_thread.scene.checks import SceneWarning, scene_warnings

PICTURES = (".png", ".svg")


@dataclass(frozen=True)
class SceneReport:
    """What is in a scene, and what of it is to be looked at.

    Attributes:
        file: as it was given.
        scene: that it holds.
        warnings: what to look at.
    """

    file: str
    scene: Scene
    warnings: tuple[SceneWarning, ...]

    def to_json(self) -> dict[str, Any]:
        """Return all in plain types."""
        return {
            "file": self.file,
            "version": self.scene.version,
            "dish": asdict(self.scene.dish),
            "shapes": [_shape(shape) for shape in self.scene.shapes],
            "warnings": [asdict(warning) for warning in self.warnings],
        }


def check_scene(file: str, needle_width: float) -> SceneReport:
    """Read a scene and look through it.

    Args:
        file: path, or the name of a scene that ships with the package.
        needle_width: gaps narrower than this are reported [m].

    Raises:
        ConfigurationError: there is no such file, or it holds anything invalid.
    """
    scene = read_scene(file)
    return SceneReport(file, scene, tuple(scene_warnings(scene, needle_width)))


def draw_scene(file: str, output: Path) -> Scene:
    """Read a scene and draw it.

    Args:
        file: path, or the name of a scene that ships with the package.
        output: the picture to write, PNG or SVG by its ending.

    Returns:
        The scene.

    Raises:
        ConfigurationError: there is no such file, it holds anything invalid, or the output is no picture.
        BagError: the output cannot be written.
    """
    if output.suffix not in PICTURES:
        raise ConfigurationError("--output", str(output), f"a file that ends in {' or '.join(PICTURES)}")
    scene = read_scene(file)
    from magnetosuture_thread.evaluation.scene_plot import draw_scene as draw

    with whole_file(output) as partial:
        draw(partial, scene, Path(file).stem)
    return scene


def _shape(shape: SceneShape) -> dict[str, Any]:
    geometry, kind = shape.geometry, next(iter(name for name in shape.definition if name != "corner_radius"), None)
    if isinstance(geometry, Disc):
        (x, y), radius = geometry.centre, geometry.radius
        bounds, vertices = [x - radius, y - radius, x + radius, y + radius], 0
    else:
        bounds, vertices = list(shape.solid.bounds), sum(map(len, geometry.rings))
    return {
        "name": shape.name,
        "kind": shape.kind,
        "type": kind or ("disc" if isinstance(geometry, Disc) else "polygon"),
        "definition": dict(shape.definition),
        "bounds_m": bounds,
        "area_m2": shape.area,
        "vertices": vertices,
    }
