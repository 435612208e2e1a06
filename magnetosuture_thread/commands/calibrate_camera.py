"""The command `magnetosuture calibrate-camera`."""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from magnetosuture_thread.commands import command
from magnetosuture_thread.commands.track import FrameSource
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import whole_file
from magnetosuture_thread.settings.texts import one_line
from magnetosuture_thread.vision.calibration import calibrate_by_dish, calibrate_by_markers, measure_needle_length
from magnetosuture_thread.vision.settings import VisionTrackerSettings


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    command.runs(parser, run_calibrate_camera)
    option = parser.add_argument
    command.add_frames(parser)
    command.add_dish(parser)
    diameter = "inner diameter of the dish [m]"
    option("--dish-diameter", type=command.number_argument(0.005, 0.5), required=True, metavar="D", help=diameter)
    markers = "of the ArUco markers around the dish [m] (default: by the dish's rim)"
    option("--markers", type=command.number_argument(1e-3, 2.0), nargs=2, metavar=("SPACING", "SIDE"), help=markers)
    needle = "measure the needle's length too: its length, known within 10 %%, and the width of its body [m]"
    option("--needle", type=command.number_argument(5e-5, 0.05), nargs=2, metavar=("LENGTH", "WIDTH"), help=needle)
    option("--output", type=command.output_file, required=True, metavar="FILE", help="parameter file to write")


def run_calibrate_camera(options: argparse.Namespace, terminal: command.Terminal) -> int:
    """Find where the dish is in the camera's image.

    The result is its centre, the scale and, by markers, the rotation. FILE gets a section vision_tracker of a ROS 2
    parameter file.

    Without --markers the dish is found as by `track`, in the median of all frames. With --markers, ArUco markers
    4x4_50 lie around the dish, their centres SPACING apart on a square around its centre: 0 at the top left, then
    clockwise, all upright.

    With --needle the needle's length is measured over eight frames that show both of its ends, and written for every
    node.
    """
    by_markers = options.markers is not None
    if by_markers and (options.region or options.rim):
        raise BagError(options.frames[0], "is calibrated by --markers, so --region and --rim have no meaning for it")
    source = FrameSource(options, terminal.log)
    every = max(1, -(-source.count // 50))  # evenly over a long bag or video
    images: list[np.ndarray] = []
    unused = ""
    for index, frame in enumerate(source):
        if index % every or frame.image is None:
            continue
        problem = frame.lens.problem_with(frame.image.shape) if frame.lens is not None else None
        if problem is not None and options.camera_info is not None:
            raise problem
        unused = f"{problem}; it is not used" if problem is not None else unused
        if len(images) == 50:  # of a video that does not say how many it has
            break
        images.append(np.asarray(frame.image if frame.lens is None or problem else frame.lens.undistorted(frame.image)))
    source.log_refused(terminal.log)
    if unused:
        terminal.log(unused)
    if not images:
        why = "; ".join(problem for problem, _ in source.problems.most_common(3))
        raise BagError(options.frames[0], f"holds no frame that can be read: {why}")
    if by_markers:
        found = calibrate_by_markers(images, options.dish_diameter, *options.markers)
    else:
        looked = VisionTrackerSettings(region_px=tuple(options.region or ()), rim=options.rim or "")
        found = calibrate_by_dish(images, options.dish_diameter, looked)
    if options.needle is not None:
        found = replace(found, needle_length=measure_needle_length(images, found, *options.needle))
    with whole_file(options.output) as partial:
        head = f"# UNVERIFIED: {one_line(source.unverified)}\n" if source.unverified else ""
        partial.write_text(head + found.to_yaml(), encoding="utf-8")
    u, v = found.view.centre_px
    scale, turned = found.view.metres_per_pixel * 1e3, found.view.rotation
    terminal.log(f"centre {u:.2f}, {v:.2f} px; {scale:.5f} mm a pixel; turned by {turned:.4f} rad")
    by = f"markers, residual {found.residual_px:.2f} px" if by_markers else "the dish's rim"
    by += "" if by_markers else f", scale within {100.0 * found.scale_error:.2g} %"
    terminal.log(f"by {by}; {found.frames} frames, scatter {found.scatter_px:.2f} px")
    if found.remark:
        terminal.log(found.remark)
    if found.needle_length is not None:
        terminal.log(f"the needle is {1e3 * found.needle_length:.3f} mm long")
    terminal.log(f"parameters: {options.output}")
    return command.DONE
