"""The command `magnetosuture calibrate-coils`."""

from __future__ import annotations

import argparse
from pathlib import Path

from magnetosuture_thread.cli.arguments import output_file
from magnetosuture_thread.cli.command import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console, sayer

DESCRIPTION = """\
Fit the model of the coils to what a probe measured in the dish, and write a calibration, which the
parameter `calibration` of coil_bridge names. MEASUREMENTS is a CSV file with the header

  coil,current,x,y,bx,by

in A, m and T, in the dish frame: one coil on at a time, by its index or name, the probe all over the dish,
ten places or more for each coil. Some lines with a current of 0 tell the background of earth and probe
apart, and so do both directions of current.
"""


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = command(
        subparsers, "calibrate-coils", "find the coils' properties from probe measurements", DESCRIPTION, run
    )
    parser.add_argument("measurements", type=Path, metavar="MEASUREMENTS", help="CSV file")
    parser.add_argument("--output", type=output_file, required=True, metavar="FILE", help="calibration to write (YAML)")
    parser.add_argument(
        "--model", choices=("loops", "dipoles"), default="loops", help="field of a coil (default: %(default)s)"
    )
    parser.add_argument("--name", default="", metavar="RIG", help="the rig's name (default: the file's)")


def run(options: argparse.Namespace) -> int:
    """Find the coils' properties from probe measurements."""
    from magnetosuture_thread.cli.tables import coil_lines, coil_table
    from magnetosuture_thread.jobs.calibrate_coils import calibrate_coils

    console = make_console()
    say = sayer(console)
    found = calibrate_coils(options.measurements, options.output, options.model, options.name).to_json()
    console.print(coil_table(found))
    for line in coil_lines(found):
        say(line)
    say(f"calibration: {options.output}")
    return DONE
