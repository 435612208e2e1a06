"""The commands that calibrate thread, camera and coils."""

from __future__ import annotations

import argparse
import datetime
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from magnetosuture_thread import InvalidInputError
from magnetosuture_thread.cli.arguments import (
    DONE,
    Subparsers,
    add_frames,
    add_scheduler,
    add_source,
    bag_location,
    bag_selection,
    command,
    number_argument,
    output_file,
    whole_number,
)
from magnetosuture_thread.cli.terminal import make_console, make_log, progress
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.texts import one_line

if TYPE_CHECKING:
    from magnetosuture_thread.coils.calibration import CalibrationFit
    from magnetosuture_thread.vision.calibration import Calibration

INTERRUPTED = 130  # as shells have it
MAX_FRAMES = 50  # evenly over a long bag
MAX_BACKGROUND = 1e-3  # T; that of the earth is a twentieth of it


def add(subparsers: Subparsers) -> None:
    """Add the commands."""
    parser = command(subparsers, "calibrate", run_calibrate)
    option = parser.add_argument
    option("bags", type=bag_location, nargs="+", metavar="BAG", help="an mcap file, or the folder of a bag, or its URL")
    option("--output", type=output_file, required=True, metavar="FILE", help="parameters to write (YAML)")
    option("--material", default="", metavar="NAME", help="where to start: silk, polyamide (default: the setup's)")
    option("--picture", type=output_file, metavar="FILE", help="picture to draw (.png; default: beside the output)")
    option("--json", type=output_file, metavar="FILE", help="write all figures to a file")
    option("--formulation", choices=("rod", "paper"), default="", help="(default: the setup's)")
    against = "fit to the measured thread (seen), or to ground truth (truth) of simulated bags (default: %(default)s)"
    option("--against", choices=("seen", "truth"), default="seen", help=against)
    option(
        "--parameters",
        type=lambda text: tuple(name.strip() for name in text.split(",") if name.strip()),
        default=(),
        metavar="A,B",
        help="settings of thread_model to fit (default: all that can be)",
    )
    cores = len(os.sched_getaffinity(0))
    workers = "processes (default: one for each processor, %(default)s); the result does not depend on it"
    option("--workers", type=whole_number, default=cores, metavar="N", help=workers)
    add_scheduler(parser)
    add_source(parser, "the bags")

    parser = command(subparsers, "calibrate-camera", run_calibrate_camera)
    option = parser.add_argument
    add_frames(parser)
    diameter = "inner diameter of the dish [m]"
    option("--dish-diameter", type=number_argument(0.005, 0.5), required=True, metavar="D", help=diameter)
    markers = "of the ArUco markers around the dish [m] (default: by the dish's rim)"
    option("--markers", type=number_argument(1e-3, 2.0), nargs=2, metavar=("SPACING", "SIDE"), help=markers)
    needle = "measure the needle's length too: its length, known within 10 %%, and the width of its body [m]"
    option("--needle", type=number_argument(5e-5, 0.05), nargs=2, metavar=("LENGTH", "WIDTH"), help=needle)
    lens = "the lens, as ROS's camera_calibration_parsers writes it (YAML; default: a bag's camera_info)"
    option("--camera-info", type=Path, metavar="FILE", help=lens)
    option("--output", type=output_file, required=True, metavar="FILE", help="parameter file to write")

    option = command(subparsers, "calibrate-coils", run_calibrate_coils).add_argument
    option("measurements", type=Path, metavar="MEASUREMENTS", help="CSV file")
    option("--output", type=output_file, required=True, metavar="FILE", help="calibration to write (YAML)")
    option("--name", default="", metavar="RIG", help="the rig's name (default: the file's)")


def run_calibrate(options: argparse.Namespace) -> int:
    """Fit the thread's parameters to recorded bags.

    The parameters are the thread's bending stiffness over the liquid's drag, the drag's anisotropy, the intrinsic
    curvature, how and where the thread is fixed to the needle; with --formulation paper, kappa and W_stiff. Each
    comes with a 95 % interval. Unidentifiable parameters are reported with the reason, and left as in the setup.
    Several bags are one fit, and each bag is also cross-validated against the rest.

    Bags with camera frames are tracked once; --source poses uses needle poses and measured threads as recorded. Only
    the ratio of stiffness and drag moves a thread, so elastic_modulus is written as the one that has the fitted ratio
    at the setup's viscosity.

    FILE gets the section thread_model, with what it rests on as comments. Put its lines into the setup's own section,
    or give a node both files. Beside it a picture shows residuals and intervals.

    Ctrl-C ends it at any moment: the best so far is written, marked as such and without intervals, and the exit code
    is 130. Before there is any, nothing is written, and it is 1.
    """
    from magnetosuture_thread import calibrate_bags
    from magnetosuture_thread.calibration.output import bag_table, calibration_lines, parameter_table

    console = make_console()
    log = make_log(console)
    names = ("material", "formulation", "against", "parameters", "workers", "scheduler", "picture")
    given = {name: getattr(options, name) for name in names}
    with progress(console, "calibrate") as advance:
        found = calibrate_bags(
            options.bags,
            options.output,
            json_file=options.json,
            log=log,
            progress=advance,
            **given,
            **bag_selection(options),
        )
    values = found.to_json()
    console.print(parameter_table(values))
    console.print(bag_table(values))
    for line in calibration_lines(values):
        log(line)
    log(f"parameters: {options.output}")
    return DONE if found.finished else INTERRUPTED


def run_calibrate_camera(options: argparse.Namespace) -> int:
    """Find where the dish is in the camera's image.

    The result is its centre, the scale and, by markers, the rotation. FILE gets a section vision_tracker of a ROS 2
    parameter file.

    Without --markers the dish's rim is used: a mean over all frames. With --markers, ArUco markers 4x4_50 lie
    around the dish, their centres SPACING apart on a square around its centre: 0 at the top left, then
    clockwise, all upright.

    With --needle the needle's length is measured over eight frames that show both of its ends, and written for every
    node.
    """
    log = make_log(make_console())
    markers = tuple(options.markers) if options.markers else None
    given = {"needle": options.needle, "remap": dict(options.remap), "camera_info": options.camera_info, "log": log}
    found = calibrate_camera(options.frames, options.dish_diameter, options.output, markers, **given)
    u, v = found.view.centre_px
    scale, turned = found.view.metres_per_pixel * 1e3, found.view.rotation
    log(f"centre {u:.2f}, {v:.2f} px; {scale:.5f} mm a pixel; turned by {turned:.4f} rad")
    by = f"markers, residual {found.residual_px:.2f} px" if markers else "the dish's rim"
    log(f"by {by}; {found.frames} frames, scatter {found.scatter_px:.2f} px")
    if found.needle_length is not None:
        log(f"the needle is {1e3 * found.needle_length:.3f} mm long")
    log(f"parameters: {options.output}")
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
    import numpy as np

    from magnetosuture_thread.jobs.output import whole_file
    from magnetosuture_thread.jobs.track import FrameSource
    from magnetosuture_thread.vision.calibration import calibrate_by_dish, calibrate_by_markers, measure_needle_length
    from magnetosuture_thread.vision.lens import read_lens

    given = read_lens(camera_info) if camera_info is not None else None
    source = FrameSource(paths, remap=remap)
    for doubt in source.doubts:
        log(f"{paths[0]} {doubt}")
    every = -(-source.count // MAX_FRAMES)
    images = []
    for index, frame in enumerate(source):
        if index % every or frame.image is None:
            continue
        lens = given or source.lens
        problem = lens.problem_with(frame.image.shape) if lens is not None else None
        if problem is not None:
            if given is not None:
                raise problem
            lens = None
        images.append(np.asarray(frame.image) if lens is None else lens.undistorted(frame.image))
    for line in source.refused:
        log(line)
    if not images:
        raise BagError(paths[0], "holds no frame that can be read")
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


def run_calibrate_coils(options: argparse.Namespace) -> int:
    """Find the coils' properties from probe measurements.

    The model of the coils is fitted to what a probe measured in the dish, and written as a calibration, which the
    parameter `calibration` of coil_bridge names. MEASUREMENTS is a CSV file with the header

      coil,current,x,y,bx,by

    in A, m and T, in the dish frame: one coil on at a time, by its index or name, the probe all over the dish,
    ten places or more for each coil. Some lines with a current of 0 tell the background of earth and probe
    apart, and so do both directions of current.
    """
    console = make_console()
    log = make_log(console)
    found = calibrate_coils(options.measurements, options.output, options.name).to_json()
    console.print(_coil_table(found))
    for line in _coil_lines(found):
        log(line)
    log(f"calibration: {options.output}")
    return DONE


def calibrate_coils(measurements: Path, output: Path, name: str = "") -> CalibrationFit:
    """Fit the coils' model to measurements and write the calibration, whole or not at all.

    Args:
        measurements: a CSV file; see `read_measurements`.
        output: the YAML file to write.
        name: of the rig; the output's own without its ending if empty.

    Raises:
        InvalidInputError: the measurements cannot be used; the message says which and why.
        BagError: the file cannot be written.
    """
    from magnetosuture_thread.coils.calibration import fit_calibration, read_measurements
    from magnetosuture_thread.jobs.output import whole_file

    if output.exists() and output.samefile(measurements):
        raise BagError(output, "holds the measurements; write the calibration to another file")
    fit = fit_calibration(read_measurements(measurements))
    x, y = fit.background
    if math.hypot(x, y) > MAX_BACKGROUND:
        text = f"a background of {1e3 * math.hypot(x, y):.3g} mT"
        raise InvalidInputError(str(measurements), text, f"at most {1e3 * MAX_BACKGROUND:g} mT; are all fields in T?")
    notes = (
        f"from {fit.readings} readings in {measurements.name}, residual {fit.residual:.2e} T, "
        f"background {x:.2e}, {y:.2e} T"
    )
    date = datetime.date.today().isoformat()
    calibration = replace(fit.calibration, name=name or output.stem, date=date, notes=notes)
    with whole_file(output) as partial:
        partial.write_text(calibration.to_yaml(), encoding="utf-8")
    return replace(fit, calibration=calibration)


def _coil_table(fit: dict[str, Any]) -> Table:
    """Return a row for each coil, as `CalibrationFit.to_json` gives them."""
    table = Table(title=f"coils as {fit['model']}")
    table.caption = "with standard deviations; ? is poorly determined"
    for name in ("coil", "angle [deg]", "distance [mm]", "radius [mm]", "field [mT/A]", "residual [uT]"):
        table.add_column(name, justify="left" if name == "coil" else "right", no_wrap=True)
    for coil in fit["coils"]:
        table.add_row(
            coil["name"],
            _value(coil, "angle", 180.0 / math.pi, 2),
            _value(coil, "distance", 1e3, 2),
            _value(coil, "radius", 1e3, 2),
            _value(coil, "field_per_current", 1e3, 4),
            f"{1e6 * coil['residual']:.1f}",
        )
    return table


def _coil_lines(fit: dict[str, Any]) -> list[str]:
    """Return in words what the table does not say."""
    x, y = (1e6 * value for value in fit["background"])
    line, worst = fit["worst"]
    lines = [
        f"{fit['readings']} readings, residual {1e6 * fit['residual']:.1f} uT, background {x:.1f}, {y:.1f} uT",
        f"the largest difference, {1e6 * worst:.1f} uT, is in line {line}",
    ]
    for coil in fit["coils"]:
        if coil["poor"]:
            lines.append(f"{coil['name']}: poorly determined {', '.join(coil['poor'])}; measure all over the dish")
    return lines


def _value(coil: dict[str, Any], key: str, scale: float, digits: int) -> str:
    deviation = coil["deviations"][key]
    if math.isnan(deviation):
        return "-"
    mark = " ?" if key in coil["poor"] else ""
    return f"{scale * coil[key]:.{digits}f} ± {scale * deviation:.{digits}f}{mark}"
