"""The command `magnetosuture calibrate-camera`."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from magnetosuture_thread.commands.command import (
    DONE,
    Terminal,
    add_frames,
    number_argument,
    output_file,
    runs,
)
from magnetosuture_thread.commands.output import whole_file
from magnetosuture_thread.commands.track import FrameSource
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.texts import one_line
from magnetosuture_thread.vision.calibration import (
    Calibration,
    calibrate_by_dish,
    calibrate_by_markers,
    measure_needle_length,
)
from magnetosuture_thread.vision.lens import read_lens

MAX_FRAMES = 50  # evenly over a long bag


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    runs(parser, run_calibrate_camera)
    option = parser.add_argument
    add_frames(parser)
    diameter = "inner diameter of the dish [m]"
    option("--dish-diameter", type=number_argument(0.005, 0.5), required=True, metavar="D", help=diameter)
    markers = "of the ArUco markers around the dish [m] (default: by the dish's rim)"
    option("--markers", type=number_argument(1e-3, 2.0), nargs=2, metavar=("SPACING", "SIDE"), help=markers)
    needle = "measure the needle's length too: its length, known within 10 %%, and the width of its body [m]"
    option("--needle", type=number_argument(5e-5, 0.05), nargs=2, metavar=("LENGTH", "WIDTH"), help=needle)
    option("--output", type=output_file, required=True, metavar="FILE", help="parameter file to write")


def run_calibrate_camera(options: argparse.Namespace, terminal: Terminal) -> int:
    """Find where the dish is in the camera's image.

    The result is its centre, the scale and, by markers, the rotation. FILE gets a section vision_tracker of a ROS 2
    parameter file.

    Without --markers the dish's rim is used: a mean over all frames. With --markers, ArUco markers 4x4_50 lie
    around the dish, their centres SPACING apart on a square around its centre: 0 at the top left, then
    clockwise, all upright.

    With --needle the needle's length is measured over eight frames that show both of its ends, and written for every
    node.
    """
    markers = tuple(options.markers) if options.markers else None
    given = {
        "needle": options.needle,
        "remap": dict(options.remap),
        "camera_info": options.camera_info,
        "log": terminal.log,
    }
    found = calibrate_camera(options.frames, options.dish_diameter, options.output, markers, **given)
    u, v = found.view.centre_px
    scale, turned = found.view.metres_per_pixel * 1e3, found.view.rotation
    terminal.log(f"centre {u:.2f}, {v:.2f} px; {scale:.5f} mm a pixel; turned by {turned:.4f} rad")
    by = f"markers, residual {found.residual_px:.2f} px" if markers else "the dish's rim"
    terminal.log(f"by {by}; {found.frames} frames, scatter {found.scatter_px:.2f} px")
    if found.needle_length is not None:
        terminal.log(f"the needle is {1e3 * found.needle_length:.3f} mm long")
    terminal.log(f"parameters: {options.output}")
    return DONE


def calibrate_camera(
    paths: Sequence[Path],
    dish_diameter: float,
    output: Path,
    markers: tuple[float, float] | None = None,
    *,
    needle: Sequence[float] | None = None,
    remap: Mapping[str, str] | None = None,
    camera_info: Path | None = None,
    log: Callable[[str], None] = lambda text: None,
) -> Calibration:
    """Calibrate from frames and write a section `vision_tracker` of a ROS 2 parameter file.

    Args:
        paths: picture files, one folder of pictures, or one bag.
        dish_diameter: inner diameter of the dish [m].
        output: the file to write.
        markers: spacing and side of the ArUco markers [m]; None to calibrate by the dish's rim.
        needle: length, known within 10 %, and width of a needle whose length is measured too [m]; None: it is not.
        remap: new name of a bag's topic by its recorded name.
        camera_info: file with the lens, whose distortion is undone first; None: a bag's own.
        log: called with a line for a person on what of a bag is damaged or not checked.

    Raises:
        BagError: there are no frames that can be read, or the file cannot be written.
        InvalidInputError: the frames don't show what they must, or the lens is not that of a frame.
    """
    given = read_lens(camera_info) if camera_info is not None else None
    source = FrameSource(paths, remap, log)
    every = -(-source.count // MAX_FRAMES)
    images = []
    for index, frame in enumerate(source):
        if index % every or frame.image is None:
            continue
        lens = given or frame.lens
        problem = lens.problem_with(frame.image.shape) if lens is not None else None
        if problem is not None and given is not None:
            raise problem
        images.append(frame.image if lens is None or problem is not None else lens.undistorted(frame.image))
    source.log_refused(log)
    if not images:
        raise BagError(paths[0], "holds no frame that can be read")
    images = [np.asarray(image) for image in images]
    if markers is None:
        calibration = calibrate_by_dish(images, dish_diameter)
    else:
        calibration = calibrate_by_markers(images, dish_diameter, *markers)
    if needle is not None:
        calibration = replace(calibration, needle_length=measure_needle_length(images, calibration, *needle))
    with whole_file(output) as partial:
        head = f"# UNVERIFIED: {one_line(source.unverified)}\n" if source.unverified else ""
        partial.write_text(head + calibration.to_yaml(), encoding="utf-8")
    return calibration
