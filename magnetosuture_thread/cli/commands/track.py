"""The command `magnetosuture track`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from magnetosuture_thread.cli.arguments import add_remap, number, output_file
from magnetosuture_thread.cli.command import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console, progress, sayer, write_json

DESCRIPTION = """\
Find needle and thread in camera frames, without a graph. FRAMES are pictures, a folder of them, or a bag.
Pictures are looked at one by one; a bag's frames are followed over time, as the node vision_tracker does.

--json writes a list with an entry for each frame: file (for a bag, topic and stamp), status (tracked, lost
or searching) and its reason, tail_m, tip_m and heading_rad (the tangent at the tail), curvature_per_m
(positive to the left), thread_m from the tail on, all in the dish frame, confidence from 0 to 1, stamp_s,
and time_s, the processor time to look at the frame, on one core, without reading and decoding it; all is
compiled before. What has no value is null.
"""


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = command(subparsers, "track", "find needle and thread in camera frames", DESCRIPTION, run)
    parser.add_argument("frames", type=Path, nargs="+", metavar="FRAMES", help="pictures, a folder of them, or a bag")
    parser.add_argument(
        "--setup",
        default="petri_35mm_polyamide",
        metavar="NAME",
        help="a set-up's name or YAML file (default: %(default)s)",
    )
    parser.add_argument("--scene", default="", metavar="NAME", help="a scene's name or file (default: the set-up's)")
    parser.add_argument(
        "--metres-per-pixel",
        type=number(1e-7, 1e-2),
        metavar="S",
        help="the scale (default: the set-up's, or from the dish's diameter)",
    )
    parser.add_argument(
        "--centre",
        type=number(0.0, 1e5),
        nargs=2,
        metavar=("U", "V"),
        help="the dish's centre [px] (default: the set-up's, or found)",
    )
    add_remap(parser)
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write what was found to a file")
    parser.add_argument(
        "--overlay", type=Path, metavar="PATH", help="draw it over the frames: a video (.mp4, .avi), or a folder of PNG"
    )


def run(options: argparse.Namespace) -> int:
    """Track the needle in camera frames."""
    from magnetosuture_thread.cli.tables import track_lines, track_table
    from magnetosuture_thread.jobs.track import settings_with, track
    from magnetosuture_thread.scene import read_scene
    from magnetosuture_thread.setups import read_setup

    console = make_console()
    say = sayer(console)
    setup = read_setup(options.setup, read_scene(options.scene) if options.scene else None)
    settings = settings_with(setup.vision, options.metres_per_pixel, options.centre)
    with progress(console, "track") as advance:
        frames = track(
            options.frames,
            settings,
            setup.scene,
            overlay=options.overlay,
            remap=dict(options.remap),
            say=say,
            progress=advance,
        )
    rows = [frame.to_json() for frame in frames]
    console.print(track_table(rows))
    for line in track_lines(rows):
        say(line)
    write_json(options.json, json.dumps(rows, indent=1, allow_nan=False))
    return DONE
