"""The command `magnetosuture calibrate-camera`."""

from __future__ import annotations

import argparse
from pathlib import Path

from magnetosuture_thread.cli.arguments import add_remap, number, output_file
from magnetosuture_thread.cli.command import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console, sayer

DESCRIPTION = """\
Find where the dish is in the camera's image: its centre, the scale and, by markers, the rotation. FILE
gets a section vision_tracker of a ROS 2 parameter file.

Without --markers the dish's rim is used: a mean over all frames. With --markers, ArUco markers 4x4_50 lie
around the dish, their centres SPACING apart on a square around its centre: 0 at the top left, then
clockwise, all upright.
"""


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = command(subparsers, "calibrate-camera", "find where the dish is in the camera's image", DESCRIPTION, run)
    parser.add_argument("frames", type=Path, nargs="+", metavar="FRAMES", help="pictures, a folder of them, or a bag")
    parser.add_argument(
        "--dish-diameter", type=number(0.005, 0.5), required=True, metavar="D", help="inner diameter of the dish [m]"
    )
    parser.add_argument(
        "--markers",
        type=number(1e-3, 2.0),
        nargs=2,
        metavar=("SPACING", "SIDE"),
        help="of the ArUco markers around the dish [m] (default: by the dish's rim)",
    )
    add_remap(parser)
    parser.add_argument("--output", type=output_file, required=True, metavar="FILE", help="parameter file to write")


def run(options: argparse.Namespace) -> int:
    """Find out where the dish is in the camera's image."""
    from magnetosuture_thread.jobs.calibrate_camera import calibrate_camera

    say = sayer(make_console())
    markers = tuple(options.markers) if options.markers else None
    found = calibrate_camera(
        options.frames, options.dish_diameter, options.output, markers, remap=dict(options.remap), say=say
    )
    u, v = found.view.centre_px
    scale, turned = found.view.metres_per_pixel * 1e3, found.view.rotation
    say(f"centre {u:.2f}, {v:.2f} px; {scale:.5f} mm a pixel; turned by {turned:.4f} rad")
    by = f"markers, residual {found.residual_px:.2f} px" if markers else "the dish's rim"
    say(f"by {by}; {found.frames} frames, scatter {found.scatter_px:.2f} px")
    say(f"parameters: {options.output}")
    return DONE
