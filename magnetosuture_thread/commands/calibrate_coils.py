"""The command `magnetosuture calibrate-coils`."""

from __future__ import annotations

import argparse
import datetime
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.table import Table

from magnetosuture_thread import InvalidInputError
from magnetosuture_thread.coils.calibration_fit import CalibrationFit, fit_calibration, read_measurements
from magnetosuture_thread.commands.command import DONE, Terminal, output_file, runs
from magnetosuture_thread.commands.output import whole_file
from magnetosuture_thread.errors import BagError

MAX_BACKGROUND = 1e-3  # T; that of the earth is a twentieth of it


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    runs(parser, run_calibrate_coils)
    option = parser.add_argument
    option("measurements", type=Path, metavar="MEASUREMENTS", help="CSV file")
    option("--output", type=output_file, required=True, metavar="FILE", help="calibration to write (YAML)")
    option("--name", default="", metavar="RIG", help="the rig's name (default: the file's)")


def run_calibrate_coils(options: argparse.Namespace, terminal: Terminal) -> int:
    """Find the coils' properties from probe measurements.

    The model of the coils is fitted to what a probe measured in the dish, and written as a calibration, which the
    parameter `calibration` of coil_bridge names. MEASUREMENTS is a CSV file with the header

      coil,current,x,y,bx,by

    in A, m and T, in the dish frame: one coil on at a time, by its index or name, the probe all over the dish,
    ten places or more for each coil. Some lines with a current of 0 tell the background of earth and probe
    apart, and so do both directions of current.
    """
    found = calibrate_coils(options.measurements, options.output, options.name).to_json()
    terminal.print(_coil_table(found))
    x, y = (1e6 * value for value in found["background"])
    line, worst = found["worst"]
    residual = f"{found['readings']} readings, residual {1e6 * found['residual']:.1f} uT"
    terminal.log(f"{residual}, background {x:.1f}, {y:.1f} uT")
    terminal.log(f"the largest difference, {1e6 * worst:.1f} uT, is in line {line}")
    for coil in found["coils"]:
        if coil["poor"]:
            terminal.log(f"{coil['name']}: poorly determined {', '.join(coil['poor'])}; measure all over the dish")
    terminal.log(f"calibration: {options.output}")
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
    if output.exists() and output.samefile(measurements):
        raise BagError(output, "holds the measurements; write the calibration to another file")
    fit = fit_calibration(read_measurements(measurements))
    x, y = fit.background
    if math.hypot(x, y) > MAX_BACKGROUND:
        text = f"a background of {1e3 * math.hypot(x, y):.3g} mT"
        raise InvalidInputError(str(measurements), text, f"at most {1e3 * MAX_BACKGROUND:g} mT; are all fields in T?")
    source = f"from {fit.readings} readings in {measurements.name}"
    notes = f"{source}, residual {fit.residual:.2e} T, background {x:.2e}, {y:.2e} T"
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
    columns = (("angle", math.degrees(1.0), 2), ("distance", 1e3, 2), ("radius", 1e3, 2), ("field_per_current", 1e3, 4))
    for coil in fit["coils"]:
        values = (_value(coil, *column) for column in columns)
        table.add_row(coil["name"], *values, f"{1e6 * coil['residual']:.1f}")
    return table


def _value(coil: dict[str, Any], key: str, scale: float, digits: int) -> str:
    deviation = coil["deviations"][key]
    if math.isnan(deviation):
        return "-"
    mark = " ?" if key in coil["poor"] else ""
    return f"{scale * coil[key]:.{digits}f} ± {scale * deviation:.{digits}f}{mark}"
