"""The job `magnetosuture calibrate-coils`: the coils' properties from probe measurements, written as a calibration."""

from __future__ import annotations

import datetime
import math
import os
import tempfile
from dataclasses import replace
from pathlib import Path

from magnetosuture_thread.coils.calibration_fit import CalibrationFit, fit_calibration
from magnetosuture_thread.coils.measurements import read_measurements
from magnetosuture_thread.errors import BagError, InvalidInputError

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
    _write_whole(output, calibration.to_yaml())
    return replace(fit, calibration=calibration)


def _write_whole(path: Path, text: str) -> None:
    """Write a file that is never seen half-written."""
    partial: Path | None = None
    try:
        handle, made = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.absolute().parent)
        partial = Path(made)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        partial.chmod(0o644)
        partial.replace(path)
        partial = None
    except OSError as error:
        raise BagError(path, f"cannot be written: {error.strerror or error}") from None
    finally:
        if partial is not None:
            partial.unlink(missing_ok=True)
