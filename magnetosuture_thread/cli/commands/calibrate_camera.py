"""The command `magnetosuture calibrate-camera`."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from magnetosuture_thread.cli.arguments import add_remap, number_argument, output_file
from magnetosuture_thread.cli.command import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console, make_log

if TYPE_CHECKING:
    from magnetosuture_thread.vision.calibration import Calibration

MAX_FRAMES = 50  # spread over a long bag

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
        "--dish-diameter",
        type=number_argument(0.005, 0.5),
        required=True,
        metavar="D",
        help="inner diameter of the dish [m]",
    )
    parser.add_argument(
        "--markers",
        type=number_argument(1e-3, 2.0),
        nargs=2,
        metavar=("SPACING", "SIDE"),
        help="of the ArUco markers around the dish [m] (default: by the dish's rim)",
    )
    add_remap(parser)
    parser.add_argument("--output", type=output_file, required=True, metavar="FILE", help="parameter file to write")


def calibrate_camera(
    paths: Sequence[Path],
    dish_diameter: float,
    output: Path,
    markers: tuple[float, float] | None = None,
    *,
    remap: Mapping[str, str] | None = None,
    log: Callable[[str], None] = lambda text: None,
) -> Calibration:
    """Calibrate from frames and write a section `vision_tracker` of a ROS 2 parameter file.

    Args:
        paths: picture files, one folder of pictures, or one bag.
        dish_diameter: inner diameter of the dish [m].
        output: the file to write.
        markers: spacing and side of the ArUco markers [m]; None to calibrate by the dish's rim.
        remap: new name of a bag's topic by its recorded name.
        log: called with a line for a person on what of a bag is damaged or not checked.

    Raises:
        BagError: there are no frames that can be read, or the file cannot be written.
        InvalidInputError: the frames don't show what they must.
    """
    import numpy as np

    from magnetosuture_thread.errors import BagError
    from magnetosuture_thread.jobs.frames import FrameSource
    from magnetosuture_thread.vision.calibration import calibrate_by_dish, calibrate_by_markers

    source = FrameSource(paths, remap=remap)
    for doubt in source.doubts:
        log(f"{paths[0]} {doubt}")
    every = -(-source.count // MAX_FRAMES)
    images = [np.asarray(f.image) for i, f in enumerate(source) if i % every == 0 and f.image is not None]
    for line in source.refused:
        log(line)
    if not images:
        raise BagError(paths[0], "holds no frame that can be read")
    if markers is None:
        calibration = calibrate_by_dish(images, dish_diameter)
    else:
        calibration = calibrate_by_markers(images, dish_diameter, *markers)
    try:
        output.write_text(calibration.to_yaml(), encoding="utf-8")
    except OSError as error:
        raise BagError(output, f"cannot be written: {error.strerror}") from None
    return calibration


def run(options: argparse.Namespace) -> int:
    """Find out where the dish is in the camera's image."""
    log = make_log(make_console())
    markers = tuple(options.markers) if options.markers else None
    found = calibrate_camera(
        options.frames, options.dish_diameter, options.output, markers, remap=dict(options.remap), log=log
    )
    u, v = found.view.centre_px
    scale, turned = found.view.metres_per_pixel * 1e3, found.view.rotation
    log(f"centre {u:.2f}, {v:.2f} px; {scale:.5f} mm a pixel; turned by {turned:.4f} rad")
    by = f"markers, residual {found.residual_px:.2f} px" if markers else "the dish's rim"
    log(f"by {by}; {found.frames} frames, scatter {found.scatter_px:.2f} px")
    log(f"parameters: {options.output}")
    return DONE
