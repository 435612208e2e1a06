"""The commands `magnetosuture calibrate`, `calibrate-camera` and `calibrate-coils`: fits to measurements."""

from __future__ import annotations

import argparse
import datetime
import math
import os
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

from rich.table import Table

from magnetosuture_thread import InvalidInputError, calibrate_bags
from magnetosuture_thread.coils.calibration import MODEL, PARAMETERS, CalibrationFit, fit_calibration, read_measurements
from magnetosuture_thread.commands import command
from magnetosuture_thread.commands.track import open_frames
from magnetosuture_thread.settings.errors import BagError, one_line
from magnetosuture_thread.settings.files import whole_file
from magnetosuture_thread.vision.calibration import calibrate_by_dish, calibrate_by_markers, measure_needle_length
from magnetosuture_thread.vision.settings import VisionTrackerSettings


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option, file = parser.add_argument, command.output_file
    bags = "an mcap file, or the folder of a bag, or its URL"
    option("bags", type=command.bag_location, nargs="+", metavar="BAG", help=bags)
    option("--output", type=file, required=True, metavar="FILE", help="parameters to write (YAML)")
    option("--material", default="", metavar="NAME", help="where to start: silk, polyamide (default: the setup's)")
    option("--picture", type=file, metavar="FILE", help="picture to draw (.png; default: beside the output)")
    option("--json", type=file, metavar="FILE", help="write all figures to a file")
    option("--formulation", choices=("rod", "paper"), default="", help="(default: the setup's)")
    against = "fit to the measured thread (seen), or to ground truth (truth) of simulated bags (default: %(default)s)"
    option("--against", choices=("seen", "truth"), default="seen", help=against)
    text = "settings of thread_model to fit (default: all that can be)"
    option("--parameters", type=_names, default=(), metavar="A,B", help=text)
    note = ", one for each processor; the result does not depend on it"
    command.add_workers(parser, len(os.sched_getaffinity(0)), note)
    command.add_source(parser, "the bags")


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def run_calibrate(options: argparse.Namespace, terminal: command.Terminal) -> int:
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
    names = ("bags", "output", "picture", "material", "formulation", "against", "parameters", "workers", "scheduler")
    chosen = {**command.given(options, *names), **command.bag_selection(options)}
    with terminal.progress("calibrate") as advance:
        result = calibrate_bags(**chosen, log=terminal.log, progress=advance)
    values = result.to_json()
    command.write_json(options.json, values)
    terminal.print(_parameter_table(values))
    terminal.print(_bag_table(values))
    for warning in values["warnings"]:
        terminal.log(f"warning: {warning}")
    if simulated := [row["name"] for row in values["bags"] if row["simulated"]]:
        terminal.log(f"simulated: {', '.join(simulated)}")
    terminal.log(f"parameters: {options.output}")
    return command.DONE if result.finished else 130  # as shells have it


def _parameter_table(figures: dict[str, Any]) -> Table:
    """Return a row for each number, as `CalibrationResult.to_json` gives them."""
    rows = []
    for row in figures["parameters"]:
        scale, unit = (1e3, "mm") if row["unit"] == "m" else (1.0, row["unit"])
        value = f"{scale * row['value']:.4g}" + (" ?" if row["reason"] else "")
        interval = "-" if row["low"] is None else f"{scale * row['low']:.3g} to {scale * row['high']:.3g}"
        rows.append(
            (f"{row['name']} [{unit}]" if unit else row["name"], value, interval, f"{scale * row['start']:.4g}")
        )
    if (attachment := figures["attachment"]) is not None:
        rows.append(("attachment", attachment["value"] + " ?" * bool(attachment["reason"]), "-", attachment["start"]))
    title = f"{figures['material']}, formulation {figures['formulation']}"
    title += "" if figures["finished"] else ": best so far, not finished"
    columns = ("parameter", "value", "95 % interval", "setup")
    return command.make_table(title, columns, rows, "? cannot be identified in this data")


def _bag_table(figures: dict[str, Any]) -> Table:
    """Return a row for each bag: prediction errors before and after, and by the other bags."""
    bags = figures["bags"]
    silences = [f"{row['name']} is {row['silence']}" for row in bags if row["silence"]]
    caption = "; ".join(["mean over time of the mean distance of the nodes, % of the length", *silences])
    keys = ["before", "after", *(["held_out"] if len(bags) > 1 else [])]
    names = {key: key.replace("_", "\n") for key in keys}
    if figures["against"] == "seen" and any(row["truth_after"] is not None for row in bags):
        # On lines of its own, as eight columns must fit into a terminal's 80.
        names |= {f"truth_{key}": f"ground\ntruth\n{key.replace('_', ' ')}" for key in keys}
    rows = [
        (row["name"], str(row["frames"]), *("-" if row[key] is None else f"{row[key]:.3f}" for key in names))
        for row in bags
    ]
    fitted = "the measured thread" if figures["against"] == "seen" else "ground truth"
    title = f"prediction error, fitted to {fitted}"
    return command.make_table(title, ("bag", "frames", *names.values()), rows, caption)


def add_camera(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
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


def run_calibrate_camera(options: argparse.Namespace, terminal: command.Terminal) -> None:
    """Find where the dish is in the camera's image.

    The result is its centre, the scale and, by markers, the rotation. FILE gets a section vision_tracker of a ROS 2
    parameter file.

    Without --markers the dish is found as by `track`, in the median of all frames. With --markers, ArUco markers
    4x4_50 lie around the dish, their centres SPACING apart on a square around its centre: 0 at the top left, then
    clockwise, all upright.

    With --needle the needle's length is measured over eight frames that show both of its ends, with a thread or
    without, and its size is written for every node.
    """
    by_markers = options.markers is not None
    if by_markers and (options.region or options.rim):
        raise BagError(options.frames[0], "is calibrated by --markers, so --region and --rim have no meaning for it")
    source = open_frames(options, terminal.log)
    max_frames = 50
    every = max(1, -(-source.count // max_frames))  # evenly over a long bag or video
    images, unused = [], ""
    for frame in islice(source.frames, 0, None, every):
        if frame.image is None:
            continue
        if (problem := frame.lens_problem) is not None:
            if options.camera_info is not None:
                raise problem
            unused = f"{problem}; it is not used"
        images.append(frame.undistorted())
        if len(images) == max_frames:  # of a video that does not say how many it has
            break
    source.log_refused(terminal.log)
    if unused:
        terminal.log(unused)
    if not images:
        why = "; ".join(problem for problem, _ in source.refused.most_common(3))
        raise BagError(options.frames[0], f"holds no frame that can be read: {why}")
    if by_markers:
        result = calibrate_by_markers(images, options.dish_diameter, *options.markers)
    else:
        looked = VisionTrackerSettings(region_px=tuple(options.region or ()), rim=options.rim or "")
        result = calibrate_by_dish(images, options.dish_diameter, looked)
    if options.needle is not None:
        length, width = options.needle
        result = replace(result, needle=(measure_needle_length(images, result, length, width), width))
    with whole_file(options.output) as partial:
        head = f"# UNVERIFIED: {one_line(source.unverified)}\n" if source.unverified else ""
        partial.write_text(head + result.to_yaml(), encoding="utf-8")
    u, v = result.view.centre_px
    scale, turned = result.view.metres_per_pixel * 1e3, result.view.rotation
    terminal.log(f"centre {u:.2f}, {v:.2f} px; {scale:.5f} mm a pixel; turned by {turned:.4f} rad")
    by = f"the dish's rim, scale within {100.0 * result.scale_error:.2g} %"
    by = f"markers, residual {result.residual_px:.2f} px" if by_markers else by
    terminal.log(f"by {by}; {result.frames} frames, scatter {result.scatter_px:.2f} px")
    if result.remark:
        terminal.log(result.remark)
    if result.needle is not None:
        terminal.log(f"the needle is {1e3 * result.needle[0]:.3f} mm long")
    terminal.log(f"parameters: {options.output}, for track --setup with --dish-diameter {options.dish_diameter:g}")


def add_coils(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option = parser.add_argument
    option("measurements", type=Path, metavar="MEASUREMENTS", help="CSV file")
    option("--output", type=command.output_file, required=True, metavar="FILE", help="calibration to write (YAML)")
    option("--name", default="", metavar="RIG", help="the rig's name (default: the file's)")


def run_calibrate_coils(options: argparse.Namespace, terminal: command.Terminal) -> None:
    """Find the coils' properties from probe measurements.

    The model of the coils is fitted to what a probe measured in the dish, and written as a calibration, which the
    parameter `calibration` of coil_bridge names. MEASUREMENTS is a CSV file with the header

      coil,current,x,y,bx,by

    in A, m and T, in the dish frame: one coil on at a time, by its index or name, the probe all over the dish,
    ten places or more for each coil. Some lines with a current of 0 tell the background of earth and probe
    apart, and so do both directions of current.
    """
    fit = fit_calibration(read_measurements(options.measurements))
    x, y = fit.background
    if math.hypot(x, y) > 1e-3:  # T; that of the earth is a twentieth of it
        text = f"a background of {1e3 * math.hypot(x, y):.3g} mT"
        raise InvalidInputError(str(options.measurements), text, "at most 1 mT; are all fields in T?")
    notes = f"from {fit.readings} readings in {options.measurements.name}, residual {fit.residual:.2e} T"
    named = {"name": options.name or options.output.stem, "date": datetime.date.today().isoformat()}
    calibration = replace(fit.calibration, notes=f"{notes}, background {x:.2e}, {y:.2e} T", **named)
    with whole_file(options.output) as partial:
        partial.write_text(calibration.to_yaml(), encoding="utf-8")
    terminal.print(_coil_table(fit))
    line, worst = fit.worst
    residual = f"{fit.readings} readings, residual {1e6 * fit.residual:.1f} µT"
    terminal.log(f"{residual}, background {1e6 * x:.1f}, {1e6 * y:.1f} µT")
    terminal.log(f"the largest difference, {1e6 * worst:.1f} µT, is in line {line}")
    for coil, poor in zip(calibration.coils, fit.poor, strict=True):
        if poor:
            terminal.log(f"{coil.name}: poorly determined {', '.join(poor)}; measure all over the dish")
    terminal.log(f"calibration: {options.output}")


def _coil_table(fit: CalibrationFit) -> Table:
    """Return a row for each coil."""
    names = ("coil", "angle [deg]", "distance [mm]", "radius [mm]", "field [mT/A]", "residual [uT]")
    shown = ((math.degrees(1.0), 2), (1e3, 2), (1e3, 2), (1e3, 4))  # factor and digits of each parameter
    rows = []
    for coil, deviations, poor in zip(fit.calibration.coils, fit.deviations.tolist(), fit.poor, strict=True):
        cells = [
            f"{factor * getattr(coil, name):.{digits}f} ± {factor * deviation:.{digits}f}" + " ?" * (name in poor)
            for name, deviation, (factor, digits) in zip(PARAMETERS, deviations, shown, strict=True)
        ]
        rows.append((coil.name, *cells, f"{1e6 * coil.residual:.1f}"))
    return command.make_table(f"coils as {MODEL}", names, rows, "with standard deviations; ? is poorly determined")
