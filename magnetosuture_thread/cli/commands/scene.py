"""The command `magnetosuture scene`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from magnetosuture_thread.cli.arguments import number, output_file
from magnetosuture_thread.cli.command import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console, sayer, write_json

NEEDLE_WIDTH = 0.0004  # m

DESCRIPTION = """\
Check a scene file, or draw it. FILE is a YAML or GeoJSON file, or the name of a scene that ships with the
package: dish_35mm, dish_35mm_post, dish_150mm or hernia_ring. Its format is in docs/scenes.md.
"""

CHECK = """\
Read a scene file and show its dish, its version and its shapes. What is allowed and yet is often a slip is
shown as a warning: shapes that overlap, gaps and holes narrower than the needle, shapes across the wall.
A file that is no scene is refused with exit code 2; warnings do not change the exit code.

--json writes file, version, dish (diameter, depth [m]), shapes (name, kind, type, definition, bounds_m,
area_m2, vertices) and warnings (what: overlap, gap, hole or wall; shapes; value [m], of an overlap [m^2];
place [m]; text).
"""

DRAW = """\
Draw a scene file from above, with names and scale, as PNG or SVG.
"""


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = command(subparsers, "scene", "check a scene file, or draw it", DESCRIPTION, run_check)
    actions = parser.add_subparsers(title="what to do", metavar="ACTION", required=True)
    check = command(actions, "check", "show what a scene holds, and what to look at", CHECK, run_check)
    draw = command(actions, "draw", "draw a scene as PNG or SVG", DRAW, run_draw)
    for action in (check, draw):
        action.add_argument("file", metavar="FILE", help="a scene's file or name")
    check.add_argument(
        "--needle-width",
        type=number(0.0, 0.1),
        default=NEEDLE_WIDTH,
        metavar="W",
        help="gaps narrower than this are reported [m] (default: %(default)s)",
    )
    check.add_argument("--json", type=output_file, metavar="FILE", help="write what was found to a file")
    draw.add_argument(
        "--output", type=output_file, required=True, metavar="FILE", help="the picture to write, .png or .svg"
    )


def run_check(options: argparse.Namespace) -> int:
    """Show what a scene holds, and what to look at."""
    from magnetosuture_thread.cli.tables import scene_table
    from magnetosuture_thread.jobs.scene import check_scene

    console = make_console()
    report = check_scene(options.file, options.needle_width)
    console.print(scene_table(report.to_json()))
    for warning in report.warnings:
        console.print("warning:", style="bold yellow", end=" ")
        sayer(console)(warning.text)
    write_json(options.json, json.dumps(report.to_json(), indent=2, allow_nan=False))
    return DONE


def run_draw(options: argparse.Namespace) -> int:
    """Draw a scene."""
    from magnetosuture_thread.jobs.scene import draw_scene

    scene = draw_scene(options.file, Path(options.output))
    sayer(make_console())(f"{options.output}: {len(scene.shapes)} shapes, version {scene.version}")
    return DONE
