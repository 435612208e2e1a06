"""The command `magnetosuture calibrate`."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from magnetosuture_thread.cli.arguments import add_source, output_file, whole_number
from magnetosuture_thread.cli.command import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console, make_log, progress

INTERRUPTED = 130  # as shells have it

DESCRIPTION = """\
Fit what recorded runs tell of a thread: its bending stiffness over the liquid's drag, the drag's anisotropy, the
curvature that it keeps, how and where it is fixed to the needle; with --formulation paper, kappa and W_stiff. Each
comes with a 95 % interval. What the bags cannot tell is said, with the reason, and left as the set-up has it.
Several bags are one fit, and each is predicted by a fit to the others besides.

Bags with camera frames are tracked once; --source poses takes needle poses and seen threads as recorded. Only the
ratio of stiffness and drag moves a thread, so elastic_modulus is written as the one that has the fitted ratio at the
set-up's viscosity.

FILE gets the section thread_model, with what it rests on as comments. Put its lines into the set-up's own section,
or give a node both files. Beside it a picture shows fit, residuals and intervals.

Ctrl-C ends it at any moment: the best so far is written, marked as such and without intervals, and the exit code is
130. Before there is any, nothing is written, and it is 1.
"""


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = command(subparsers, "calibrate", "fit the thread's parameters to recorded bags", DESCRIPTION, run)
    parser.add_argument("bags", type=Path, nargs="+", metavar="BAG", help="an mcap file, or the folder of a bag")
    parser.add_argument("--output", type=output_file, required=True, metavar="FILE", help="parameters to write (YAML)")
    parser.add_argument(
        "--material", default="", metavar="NAME", help="where to start: silk, polyamide (default: the set-up's)"
    )
    parser.add_argument(
        "--setup", default="", metavar="NAME", help="a set-up's name or YAML file (default: the one the bags name)"
    )
    parser.add_argument(
        "--picture", type=output_file, metavar="FILE", help="picture to draw (.png; default: beside the output)"
    )
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write all figures to a file")
    parser.add_argument("--formulation", choices=("rod", "paper"), default="", help="(default: the set-up's)")
    parser.add_argument(
        "--against",
        choices=("seen", "truth"),
        default="seen",
        help="what to fit to: the seen thread, or the truth, which only simulated bags hold (default: %(default)s)",
    )
    parser.add_argument(
        "--parameters",
        type=lambda text: tuple(name.strip() for name in text.split(",") if name.strip()),
        default=(),
        metavar="A,B",
        help="settings of thread_model to fit (default: all that can be)",
    )
    parser.add_argument(
        "--workers",
        type=whole_number,
        default=len(os.sched_getaffinity(0)),
        metavar="N",
        help="processes (default: one for each processor, %(default)s); the result does not depend on it",
    )
    add_source(parser)


def run(options: argparse.Namespace) -> int:
    """Fit the thread's parameters to recorded bags."""
    from magnetosuture_thread.calibration.output import bag_table, calibration_lines, parameter_table
    from magnetosuture_thread.jobs.calibrate import Request, calibrate_bags

    console = make_console()
    log = make_log(console)
    request = Request(
        setup=options.setup,
        material=options.material,
        formulation=options.formulation,
        against=options.against,
        parameters=options.parameters,
        workers=options.workers,
        source=options.source,
        remap=options.remap,
        frame=options.frame,
    )
    with progress(console, "calibrate") as advance:
        found = calibrate_bags(
            options.bags,
            options.output,
            request,
            picture=options.picture,
            json_file=options.json,
            log=log,
            progress=advance,
        )
    values = found.to_json()
    console.print(parameter_table(values))
    console.print(bag_table(values))
    for line in calibration_lines(values):
        log(line)
    log(f"parameters: {options.output}")
    return DONE if found.finished else INTERRUPTED
