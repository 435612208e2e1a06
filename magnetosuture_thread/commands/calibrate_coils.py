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
from magnetosuture_thread.coils.calibration import fit_calibration, read_measurements
from magnetosuture_thread.commands import command
from magnetosuture_thread.settings.files import whole_file


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    command.runs(parser, run_calibrate_coils)
    option = parser.add_argument
    option("measurements", type=Path, metavar="MEASUREMENTS", help="CSV file")
    option("--output", type=command.output_file, required=True, metavar="FILE", help="calibration to write (YAML)")
    option("--name", default="", metavar="RIG", help="the rig's name (default: the file's)")


def run_calibrate_coils(options: argparse.Namespace, terminal: command.Terminal) -> int:
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
    source = f"from {fit.readings} readings in {options.measurements.name}"
    notes = f"{source}, residual {fit.residual:.2e} T, background {x:.2e}, {y:.2e} T"
    date = datetime.date.today().isoformat()
    calibration = replace(fit.calibration, name=options.name or options.output.stem, date=date, notes=notes)
    with whole_file(options.output) as partial:
        partial.write_text(calibration.to_yaml(), encoding="utf-8")
    found = replace(fit, calibration=calibration).to_json()
    terminal.print(_coil_table(found))
    x, y = (1e6 * value for value in found["background"])
    line, worst = found["worst"]
    residual = f"{found['readings']} readings, residual {1e6 * found['residual']:.1f} µT"
    terminal.log(f"{residual}, background {x:.1f}, {y:.1f} µT")
    terminal.log(f"the largest difference, {1e6 * worst:.1f} µT, is in line {line}")
    for coil in found["coils"]:
        if coil["poor"]:
            terminal.log(f"{coil['name']}: poorly determined {', '.join(coil['poor'])}; measure all over the dish")
    terminal.log(f"calibration: {options.output}")
    return command.DONE


def _coil_table(fit: dict[str, Any]) -> Table:
    """Return a row for each coil, as `CalibrationFit.to_json` gives them."""
    names = ("coil", "angle [deg]", "distance [mm]", "radius [mm]", "field [mT/A]", "residual [uT]")
    columns = (("angle", math.degrees(1.0), 2), ("distance", 1e3, 2), ("radius", 1e3, 2), ("field_per_current", 1e3, 4))
    rows = [
        (coil["name"], *(_value(coil, *column) for column in columns), f"{1e6 * coil['residual']:.1f}")
        for coil in fit["coils"]
    ]
    caption = "with standard deviations; ? is poorly determined"
    return command.make_table(f"coils as {fit['model']}", names, rows, caption)


def _value(coil: dict[str, Any], key: str, scale: float, digits: int) -> str:
    deviation = coil["deviations"][key]
    if math.isnan(deviation):
        return "-"
    mark = " ?" if key in coil["poor"] else ""
    return f"{scale * coil[key]:.{digits}f} ± {scale * deviation:.{digits}f}{mark}"
