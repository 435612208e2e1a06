"""The job `magnetosuture calibrate-coils`: the coils' properties from probe measurements, written as a calibration."""

from __future__ import annotations

import datetime
import math
from dataclasses import replace
from pathlib import Path

from magnetosuture_thread.coils.calibration_fit import CalibrationFit, fit_calibration
from magnetosuture_thread.coils.measurements import read_measurements
from magnetosuture_thread.errors import BagError, InvalidInputError
from magnetosuture_thread.jobs.output import whole_file

STRONGEST = 1e-3  # T of a background; that of the earth is a twentieth of it


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
    if output.exists() and output.samefile(measurements):
        raise BagError(output, "holds the measurements; write the calibration to another file")
    fit = fit_calibration(read_measurements(measurements), model)
    x, y = fit.background
    if math.hypot(x, y) > STRONGEST:
        text = f"a background of {1e3 * math.hypot(x, y):.3g} mT"
        raise InvalidInputError(str(measurements), text, f"at most {1e3 * STRONGEST:g} mT; are all fields in T?")
    notes = (
        f"from {fit.readings} readings in {measurements.name}, residual {fit.residual:.2e} T, "
        f"background {x:.2e}, {y:.2e} T"
    )
    date = datetime.date.today().isoformat()
    calibration = replace(fit.calibration, name=name or output.stem, date=date, notes=notes)
    with whole_file(output) as partial:
        partial.write_text(calibration.to_yaml(), encoding="utf-8")
    return replace(fit, calibration=calibration)
