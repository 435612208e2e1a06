"""Probe measurements of the coils' field, from a CSV file."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.files import read_regular
from magnetosuture_thread.untrusted import MAX_TABLE_BYTES

COLUMNS = ("coil", "current", "x", "y", "bx", "by")
# Values out of these bounds are assumed to have another unit.
VALUE_BOUNDS = {"current": (1000.0, "A"), "x": (0.5, "m"), "y": (0.5, "m"), "bx": (1.0, "T"), "by": (1.0, "T")}
MAX_COILS = 64


@dataclass(frozen=True, eq=False)
class ProbeMeasurements:
    """Readings of a field probe in the dish plane, one coil on at a time.

    Attributes:
        source: the file.
        names: of the coils, in the order of their currents.
        coil: index of the coil that is on, shape (n,).
        current: in it, shape (n,) [A].
        points: positions of the probe in the dish frame, shape (n, 2) [m].
        field: readings along x and y, shape (n, 2) [T].
        lines: of the file, shape (n,).
    """

    source: str
    names: tuple[str, ...]
    coil: NDArray[np.int64]
    current: NDArray[np.float64]
    points: NDArray[np.float64]
    field: NDArray[np.float64]
    lines: NDArray[np.int64]

    def location(self, line: int) -> str:
        """Return file and line number, for an error."""
        return f"{self.source}, line {line}"


def read_measurements(path: Path) -> ProbeMeasurements:
    """Read measurements from a CSV file with the columns coil, current, x, y, bx, by in any order, in SI units.

    A coil is given by its index, from 0, or as coil_0, and then every index must be there; or by any other
    name, and then the coils' order is that in which they come. Empty lines and lines that begin with # are
    ignored.

    Raises:
        InvalidInputError: the file is unreadable, or a line is invalid; with its number.
    """
    try:
        lines = read_regular(path, MAX_TABLE_BYTES).decode("utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "not text"
        raise InvalidInputError(str(path), reason, "a readable CSV file") from None
    rows = []
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            rows += [(number, [cell.strip() for cell in cells]) for cells in csv.reader([line])]
        except csv.Error as error:
            raise InvalidInputError(f"{path}, line {number}", str(error), "comma-separated values") from None
    if not rows or sorted(rows[0][1]) != sorted(COLUMNS):
        where, given = (f"{path}, line {rows[0][0]}", rows[0][1]) if rows else (str(path), "nothing")
        raise InvalidInputError(where, given, f"the columns {','.join(COLUMNS)}")
    header = rows.pop(0)[1]
    if not rows:
        raise InvalidInputError(str(path), "a header only", "measurements below it")
    named, numbers = [], []
    for number, cells in rows:
        where = f"{path}, line {number}"
        if len(cells) != len(COLUMNS):
            raise InvalidInputError(where, f"{len(cells)} values", f"{len(COLUMNS)}: {','.join(header)}")
        values = dict(zip(header, cells, strict=True))
        if not values["coil"]:
            raise InvalidInputError(f"{where}, coil", "nothing", "index or name of the coil that is on")
        named.append(f"coil_{int(values['coil'])}" if _is_index(values["coil"]) else values["coil"])
        numbers.append([_number(f"{where}, {column}", values[column], column) for column in COLUMNS[1:]])
    names = _ordered_names(named, path)
    table = np.array(numbers)
    index = {name: k for k, name in enumerate(names)}
    coil = np.array([index[name] for name in named], dtype=np.int64)
    at = np.array([number for number, _ in rows], dtype=np.int64)
    return ProbeMeasurements(str(path), names, coil, table[:, 0], table[:, 1:3], table[:, 3:], at)


def _is_index(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) < 4


def _number(where: str, text: str, column: str) -> float:
    limit, unit = VALUE_BOUNDS[column]
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= limit:
        raise InvalidInputError(where, text or "nothing", f"a number from {-limit:g} to {limit:g} {unit}")
    return value


def _ordered_names(named: list[str], path: Path) -> tuple[str, ...]:
    """Return the coils' names in the order of their currents."""
    names = list(dict.fromkeys(named))
    if len(names) > MAX_COILS:
        raise InvalidInputError(f"{path}, coil", f"{len(names)} coils", f"at most {MAX_COILS}")
    if not all(name.startswith("coil_") and _is_index(name.removeprefix("coil_")) for name in names):
        return tuple(names)
    wanted = [f"coil_{k}" for k in range(len(names))]
    if set(names) != set(wanted):
        missing = next(name for name in wanted if name not in names)
        raise InvalidInputError(f"{path}, coil", f"nothing of {missing}", "measurements of every coil, from 0 on")
    return tuple(wanted)
