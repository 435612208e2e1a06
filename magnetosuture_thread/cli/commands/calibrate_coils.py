"""The command `magnetosuture calibrate-coils`."""

from __future__ import annotations

import argparse
import datetime
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from magnetosuture_thread.cli.arguments import output_file
from magnetosuture_thread.cli.command import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console, make_log
from magnetosuture_thread.errors import BagError, InvalidInputError

if TYPE_CHECKING:
    from magnetosuture_thread.coils.calibration_fit import CalibrationFit

MAX_BACKGROUND = 1e-3  # T; that of the earth is a twentieth of it

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
    console = make_console()
    log = make_log(console)
    found = calibrate_coils(options.measurements, options.output, options.model, options.name).to_json()
    console.print(_table(found))
    for line in _lines(found):
        log(line)
    log(f"calibration: {options.output}")
    return DONE


def calibrate_coils(measurements: Path, output: Path, model: str = "loops", name: str = "") -> CalibrationFit:
    """Fit the coils' model to measurements and write the calibration, whole or not at all.

    Args:
        measurements: a CSV file; see `read_measurements`.
        output: the YAML file to write.
        model: loops or dipoles.
        name: of the rig; the output's own without its ending if empty.

    Raises:
        InvalidInputError: the measurements cannot be used; the message says which and why.
        BagError: the file cannot be written.
    """
    from magnetosuture_thread.coils.calibration_fit import fit_calibration
    from magnetosuture_thread.coils.measurements import read_measurements
    from magnetosuture_thread.jobs.output import whole_file

    if output.exists() and output.samefile(measurements):
        raise BagError(output, "holds the measurements; write the calibration to another file")
    fit = fit_calibration(read_measurements(measurements), model)
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


def _table(fit: dict[str, Any]) -> Table:
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


def _lines(fit: dict[str, Any]) -> list[str]:
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
