"""The command `magnetosuture calibrate`: fits a thread's parameters to recorded runs."""

from __future__ import annotations

import argparse
import os

from magnetosuture_thread import calibrate_bags
from magnetosuture_thread.calibration.result import bag_table, calibration_lines, parameter_table
from magnetosuture_thread.commands import command


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    command.runs(parser, run_calibrate)
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
    given = {**command.given(options, *names), **command.bag_selection(options)}
    with terminal.progress("calibrate") as advance:
        result = calibrate_bags(**given, log=terminal.log, progress=advance)
    values = result.to_json()
    command.write_json(options.json, values)
    terminal.print(parameter_table(values))
    terminal.print(bag_table(values))
    for line in calibration_lines(values):
        terminal.log(line)
    terminal.log(f"parameters: {options.output}")
    return command.DONE if result.finished else 130  # as shells have it
