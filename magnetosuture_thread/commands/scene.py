"""The command `magnetosuture scene`."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.table import Table

from magnetosuture_thread import ConfigurationError, Disc, SceneShape, read_scene
from magnetosuture_thread.commands import command
from magnetosuture_thread.geometry.scene import scene_warnings
from magnetosuture_thread.settings.files import whole_file


def add(parser: argparse.ArgumentParser) -> None:
    """Check a scene file, or draw it.

    FILE is a YAML or GeoJSON file, or the name of a scene that ships with the
    package, for example dish_35mm or hernia_ring. Its format is in
    docs/how_to/scenes.md.
    """
    check, draw = command.add_actions(parser, "what to do", "ACTION", check=run_check, draw=run_draw)
    for action in (check, draw):
        action.add_argument("file", metavar="FILE", help="a scene's file or name")
    width = "gaps narrower than this are reported [m] (default: %(default)s)"
    check.add_argument("--needle-width", type=command.number_argument(0.0, 0.1), default=4e-4, metavar="W", help=width)
    check.add_argument("--json", type=command.output_file, metavar="FILE", help="write what was found to a file")
    output = draw.add_argument
    output(
        "--output", type=command.output_file, required=True, metavar="FILE", help="the picture to write, .png or .svg"
    )


def run_check(options: argparse.Namespace, terminal: command.Terminal) -> None:
    """Show what a scene holds, with warnings.

    A scene file is read, and its dish, its version and its shapes are shown. What is allowed and yet is often a slip is
    shown as a warning: shapes that overlap, gaps and holes narrower than the needle, shapes across the wall.
    A file that is no scene is refused with exit code 2; warnings do not change the exit code.

    --json writes file, version, dish (diameter, depth [m]), shapes (name, kind, type, definition, bounds_m,
    area_m2, vertices) and warnings (what: overlap, gap, hole or wall; shapes; value [m], of an overlap [m^2];
    place [m]; text).
    """
    scene = read_scene(options.file)
    warnings = scene_warnings(scene, options.needle_width)
    report = {
        "file": options.file,
        "version": scene.version,
        "dish": asdict(scene.dish),
        "shapes": [_shape(shape) for shape in scene.shapes],
        "warnings": [asdict(warning) for warning in warnings],
    }
    terminal.print(_table(report))
    for warning in warnings:
        terminal.print("warning:", style="bold yellow", end=" ")
        terminal.log(warning.text)
    command.write_json(options.json, report)


def run_draw(options: argparse.Namespace, terminal: command.Terminal) -> None:
    """Draw a scene file from above, with names and scale, as PNG or SVG."""
    if options.output.suffix not in (".png", ".svg"):
        raise ConfigurationError("--output", str(options.output), "a file that ends in .png or .svg")

    from magnetosuture_thread.evaluation.plots import plot_scene  # late, as it imports matplotlib

    scene = read_scene(options.file)
    with whole_file(options.output) as partial:
        plot_scene(partial, scene, Path(options.file).stem)
    terminal.log(f"{options.output}: {len(scene.shapes)} shapes, version {scene.version}")


def _table(report: dict[str, Any]) -> Table:
    """Return a row for each shape."""
    dish, rows = report["dish"], []
    for index, shape in enumerate(report["shapes"]):
        left, bottom, right, top = (1e3 * value for value in shape["bounds_m"])
        places = (f"{left:.2f}, {bottom:.2f}", f"{right:.2f}, {top:.2f}", f"{1e6 * shape['area_m2']:.2f}")
        rows.append((shape["name"], str(index), shape["kind"], shape["type"], *places))
    title = f"dish of {1e3 * dish['diameter']:g} mm, {1e3 * dish['depth']:g} mm deep"
    caption = f"version {report['version']}; minimum and maximum x, y in mm, area in mm^2"
    return command.make_table(title, ("name", "", "kind", "shape", "from", "to", "area"), rows, caption)


def _shape(shape: SceneShape) -> dict[str, Any]:
    """Return what is reported of a shape."""
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
        "area_m2": geometry.area,
        "vertices": vertices,
    }
