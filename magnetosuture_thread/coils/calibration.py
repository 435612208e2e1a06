"""Calibration of a rig's coils: its YAML file, and the least-squares fit to measurements that come in a CSV file."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from magnetosuture_thread.coils.field import CoilProperties, loop_fields
from magnetosuture_thread.geometry.polyline import Indices, Points, Vector
from magnetosuture_thread.settings.configuration import (
    Quantity,
    bounded,
    configuration_fields,
    errors_of_file,
    from_mapping,
    read_yaml,
    to_mapping,
)
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError
from magnetosuture_thread.settings.files import MAX_TEXT_BYTES, read_regular

MODEL = "loops"  # of the field of a coil
MIN_COILS, MAX_COILS = 3, 64  # three are needed to pull in every direction
TEXT_KEYS = ("name", "date", "notes")
PARAMETERS = ("angle", "distance", "radius", "field_per_current")  # of a coil


@dataclass(frozen=True)
class CoilCalibration:
    """Measured properties of a rig's coils.

    Attributes:
        name: of the rig.
        date: of the measurement, as text.
        notes: anything else.
        coils: in the order of their currents.
    """

    name: str
    date: str
    notes: str
    coils: tuple[CoilProperties, ...]

    def to_yaml(self) -> str:
        """Return the calibration as YAML text."""
        head = {**{key: getattr(self, key) for key in TEXT_KEYS}, "model": MODEL}
        header = (
            "# Calibration of a rig's coils, for the parameter `calibration` of coil_bridge. "
            "SI units: rad, m, T/A, ohm, T.\n"
        )
        coils = []
        for coil in self.coils:
            named = {k: float(f"{v:.8g}") if isinstance(v, float) else v for k, v in to_mapping(coil).items()}
            coils.append({key: value for key, value in named.items() if key in ("name", *PARAMETERS) or value})
        return header + yaml.safe_dump({**head, "coils": coils}, sort_keys=False, allow_unicode=True)


def read_calibration(path: Path) -> CoilCalibration:
    """Read a calibration from a YAML file.

    Raises:
        ConfigurationError: the file is unreadable or no YAML, a key is missing or unknown, or a value has the wrong
            type or is out of bounds; with file, key, value and expectation.
    """
    content, known = read_yaml(path, "coil calibration"), (*TEXT_KEYS, "model", "coils")
    with errors_of_file(str(path)):
        if not isinstance(content, Mapping):
            raise ConfigurationError("coil calibration", content, f"keys {', '.join(known)}")
        for key, value in content.items():
            if key not in known:
                raise ConfigurationError(str(key), value, f"one of {', '.join(known)}")
            if key in TEXT_KEYS and not isinstance(value, str):
                raise ConfigurationError(key, value, "text")
        if content.get("model", MODEL) != MODEL:
            raise ConfigurationError("model", content["model"], f"{MODEL}, the only model; calibrate the coils again")
        listed = content.get("coils")
        if not isinstance(listed, list) or len(listed) < MIN_COILS:
            given = f"{len(listed)} coils" if isinstance(listed, list) else listed
            raise ConfigurationError("coils", given, f"a list of at least {MIN_COILS} coils")
        coils = tuple(_coil_from(f"coils[{index}]", values) for index, values in enumerate(listed))
        for name, count in Counter(coil.name for coil in coils).items():
            if count > 1:
                raise ConfigurationError("coils", f"two of the name {name}", "a name of its own for each")
    return CoilCalibration(coils=coils, **{key: content.get(key, "") for key in TEXT_KEYS})


def _coil_from(where: str, values: Any) -> CoilProperties:
    needed = ("name", *PARAMETERS)
    if not isinstance(values, Mapping):
        raise ConfigurationError(where, values, f"keys {', '.join(needed)}")
    for key in needed:
        if key not in values:
            raise ConfigurationError(f"{where}.{key}", None, f"a value: {', '.join(needed)} are needed")
    try:
        return from_mapping(CoilProperties, {str(key): value for key, value in values.items()})
    except ConfigurationError as error:
        raise ConfigurationError(error.name.replace("coil", where, 1), error.value, error.expectation) from None


# Of the numbers of a line; beyond, they are assumed to have another unit.
QUANTITIES = {
    "current": bounded("A", -1000.0, 1000.0),
    **dict.fromkeys(("x", "y"), bounded("m", -0.5, 0.5)),
    **dict.fromkeys(("bx", "by"), bounded("T", -1.0, 1.0)),
}
COLUMNS = ("coil", *QUANTITIES)
MIN_READINGS = 6  # of a coil with current: twelve numbers for four parameters, with some for the residual
MIN_DISTANCE_RATIO = 1.05  # of a coil's distance to that of the farthest point
# Standard deviations, of the angle in rad, of the others relative, in the order of `PARAMETERS`: above, a parameter is
# poorly determined, or unidentifiable. The field hardly depends on the radius, which has no such limit.
POOR_DEVIATION = (0.02, 0.1, 0.25, 0.02)
MAX_DEVIATION = (0.3, 1.0, math.inf, 0.5)


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
    coil: Indices
    current: Vector
    points: Points
    field: Points
    lines: Indices


def read_measurements(path: Path) -> ProbeMeasurements:
    """Read measurements from a CSV file with the columns coil, current, x, y, bx, by in any order, in SI units.

    A coil is given by its index, from 0, or as coil_0, and then every index must be there; or by any other
    name, and then the coils' order is that in which they come. Empty lines and lines that begin with # are
    ignored.

    Raises:
        InvalidInputError: the file is unreadable, or a line is invalid; with its number.
    """
    try:
        lines = read_regular(path, MAX_TEXT_BYTES).decode("utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "not text"
        raise InvalidInputError(str(path), reason, "a readable CSV file") from None
    rows: list[tuple[str, int, list[str]]] = []  # place, number and cells of each line
    for number, line in enumerate(lines, 1):
        where = f"{path}, line {number}"
        if line.strip() and not line.startswith("#"):
            try:
                rows.append((where, number, [cell.strip() for cells in csv.reader([line]) for cell in cells]))
            except csv.Error as error:
                raise InvalidInputError(where, str(error), "comma-separated values") from None
    where, _, header = rows[0] if rows else (str(path), 0, [])
    if sorted(header) != sorted(COLUMNS):
        raise InvalidInputError(where, header or "nothing", f"the columns {','.join(COLUMNS)}")
    if len(rows) == 1:
        raise InvalidInputError(str(path), "a header only", "measurements below it")
    named, numbers = [], []
    for where, _, cells in rows[1:]:
        if len(cells) != len(COLUMNS):
            raise InvalidInputError(where, f"{len(cells)} values", f"{len(COLUMNS)}: {','.join(header)}")
        values = dict(zip(header, cells, strict=True))
        if not (name := values.pop("coil")):
            raise InvalidInputError(f"{where}, coil", "nothing", "index or name of the coil that is on")
        named.append(f"coil_{int(name)}" if _is_index(name) else name)
        numbers.append([_number(f"{where}, {column}", values[column], QUANTITIES[column]) for column in QUANTITIES])
    names, table = _ordered_names(named, path), np.array(numbers)
    coil, at = np.array([names.index(name) for name in named]), np.array([number for _, number, _ in rows[1:]])
    return ProbeMeasurements(str(path), names, coil, table[:, 0], table[:, 1:3], table[:, 3:], at)


def _is_index(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) < 4


def _number(where: str, text: str, limits: Quantity) -> float:
    with suppress(ValueError):
        if limits.within(value := float(text)):
            return value
    raise InvalidInputError(where, text or "nothing", limits.expectation(float))


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


@dataclass(frozen=True)
class CalibrationFit:
    """Result of a calibration fit.

    Attributes:
        calibration: the coils.
        deviations: standard deviations of angle [rad], distance [m], radius [m] and field per current [T/A]
            of each coil, shape (m, 4).
        poor: names of the poorly determined parameters of each coil.
        background: reading of the probe without currents, shape (2,) [T].
        residual: root mean square of the difference of a component [T].
        worst: line of the file with the largest difference, and its size [T].
        readings: number used in the fit.
    """

    calibration: CoilCalibration
    deviations: Vector
    poor: tuple[tuple[str, ...], ...]
    background: Vector
    residual: float
    worst: tuple[int, float]
    readings: int


def fit_calibration(data: ProbeMeasurements) -> CalibrationFit:
    """Fit coils as loops of current, and a background, to measurements.

        min  sum | B_0 + I_i b(p_i; angle, distance, radius, field) - B_i |^2

    over four numbers of each coil and the background B_0 of earth and probe, which is
    the same in all. Each coil starts on the side to which its own field grows. The
    standard deviations are those of least squares, s^2 (J^T J)^-1, with the scatter s of the residuals.

    Args:
        data: readings in the dish.

    Raises:
        InvalidInputError: too few coils or readings, points beyond a coil, unidentifiable
            parameters, or a field that does not fit the model.

    Source: none; nonlinear least squares by scipy, trust region reflective.
    """
    from scipy.optimize import least_squares  # here, as whoever reads a calibration alone need not wait for it

    _check_readings(data)
    count, size = len(data.names), float(np.sqrt(np.mean(data.field[data.current != 0.0] ** 2)))
    off = data.field[data.current == 0.0]
    background = off.mean(axis=0) if len(off) else np.zeros(2)
    start = np.concatenate([*(_start(data, index, background, size) for index in range(count)), background / size])
    limits = {setting.name: setting.quantity for setting in configuration_fields(CoilProperties)}
    # A coil is beyond all points, and where and as large as one may be.
    nearest = max(limits["distance"].minimum, MIN_DISTANCE_RATIO * float(np.hypot(*data.points.T).max()))
    farthest, radii = max(limits["distance"].maximum, 2.0 * nearest), limits["radius"]
    low = [-math.inf, math.log(nearest), math.log(radii.minimum), -math.inf] * count + [-math.inf] * 2
    high = [math.inf, math.log(farthest), math.log(radii.maximum), math.inf] * count + [math.inf] * 2

    def residuals(x: Vector) -> Vector:
        """Return the differences in units of the field's size, of numbers of order one; see `_start`."""
        angle, distance, radius, strength = x[:-2].reshape(-1, 4).T[:, data.coil]
        axis = np.column_stack([np.cos(angle), np.sin(angle)])
        across = np.column_stack([-axis[:, 1], axis[:, 0]])
        along, aside = np.sum(data.points * axis, axis=1), np.sum(data.points * across, axis=1)
        axial, outwards = loop_fields(along, aside, np.exp(distance), np.exp(radius), strength)
        of_coil = data.current[:, None] * (axial[:, None] * axis + outwards[:, None] * across)
        return np.asarray((x[-2:] + of_coil - data.field / size).ravel())

    tolerances = dict.fromkeys(("ftol", "xtol", "gtol"), 1e-12)
    options: dict[str, Any] = {"jac": "3-point", "bounds": (low, high), "x_scale": "jac", **tolerances}
    found = least_squares(residuals, np.clip(start, low, high), max_nfev=300, **options)
    difference = size * found.fun.reshape(-1, 2)
    residual = float(np.sqrt(np.mean(difference**2)))
    # A residual of more than a quarter of the measured field means other coils.
    if residual > 0.25 * size:
        given = f"a field that differs from the model's by {residual / size:.0%}"
        raise InvalidInputError(data.source, given, "one coil on at a time, in the dish frame, in SI units")
    coils = tuple(_coil(data, index, found.x, size, difference) for index in range(count))
    sizes = np.array([[1.0, coil.distance, coil.radius, abs(coil.field_per_current)] for coil in coils])
    shares = _deviations(data, np.asarray(found.jac), residual / size)
    shares[:, 3] *= size / sizes[:, 3]
    for coil, share in zip(coils, shares, strict=True):
        if unknown := _exceeding(share, MAX_DEVIATION):
            words = "readings that determine it: all over the dish, with a field well above the probe's noise"
            raise InvalidInputError(f"{data.source}, {coil.name}", f"an unknown {' and '.join(unknown)}", words)
    poor = tuple(_exceeding(share, POOR_DEVIATION) for share in shares)
    distances = np.linalg.norm(difference, axis=1)
    worst = int(np.argmax(distances))
    farthest_off, calibration = (int(data.lines[worst]), float(distances[worst])), CoilCalibration("", "", "", coils)
    background = size * found.x[-2:]
    return CalibrationFit(calibration, shares * sizes, poor, background, residual, farthest_off, len(distances))


def _check_readings(data: ProbeMeasurements) -> None:
    if len(data.names) < MIN_COILS:
        raise InvalidInputError(f"{data.source}, coil", ", ".join(data.names), f"at least {MIN_COILS} coils")
    for index, name in enumerate(data.names):
        count = int(np.count_nonzero(data.current[data.coil == index]))
        if count < MIN_READINGS:
            expected = f"at least {MIN_READINGS} with current, all over the dish"
            raise InvalidInputError(f"{data.source}, {name}", f"{count} readings with current", expected)
    if float(np.abs(data.field).max()) < 1e-6:
        raise InvalidInputError(f"{data.source}, bx and by", "less than 1e-6 T everywhere", "the field of coils in T")


def _start(data: ProbeMeasurements, index: int, background: Vector, size: float) -> Vector:
    """Return angle, log distance, log radius and field / size of a coil, roughly, by its own readings."""
    on = (data.coil == index) & (data.current != 0.0)
    points, per_current = data.points[on], (data.field[on] - background) / data.current[on, None]
    # Field and gradient at the centre by a straight line, and how fast the field grows along itself: towards the coil.
    reach = max(1e-6, float(np.abs(points).max()))
    line = np.linalg.lstsq(np.column_stack([np.ones(len(points)), points / reach]), per_current, rcond=None)[0]
    strength = max(float(np.linalg.norm(line[0])), 1e-9)
    along = line[0] / strength
    growth = float(along @ (line[1:].T / reach) @ along) / strength
    distance = 2.5 / max(abs(growth), 2.5)  # a dipole's is 3 / distance, a loop's a little less
    sign = math.copysign(1.0, growth)
    angle = math.atan2(sign * along[1], sign * along[0])
    return np.array([angle, math.log(distance), math.log(0.5 * distance), sign * strength / size])


def _coil(data: ProbeMeasurements, index: int, x: Vector, size: float, difference: Vector) -> CoilProperties:
    """Return a coil from its parameters."""
    angle, distance, radius, field = x[4 * index : 4 * index + 4]
    farthest = int(np.argmax(np.hypot(*data.points.T)))
    if math.exp(distance) <= 1.001 * MIN_DISTANCE_RATIO * float(np.linalg.norm(data.points[farthest])):
        where, place = f"{data.source}, line {data.lines[farthest]}", data.points[farthest].tolist()
        expected = f"points within the coils; {data.names[index]} is nearer"
        raise InvalidInputError(where, f"a point at {place} m", expected)
    residual = float(np.sqrt(np.mean(difference[data.coil == index] ** 2)))
    wrapped = math.remainder(float(angle), 2.0 * math.pi)
    try:
        return CoilProperties(
            data.names[index], wrapped, math.exp(distance), math.exp(radius), float(field) * size, residual=residual
        )
    except ConfigurationError as error:
        name = error.name.replace("coil", data.names[index], 1)
        raise InvalidInputError(f"{data.source}, {name}", error.value, error.expectation) from None


def _deviations(data: ProbeMeasurements, jacobian: Vector, residual: float) -> Vector:
    """Return standard deviations of the numbers of `_start`, shape (m, 4); reject unidentifiable parameters."""
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    _, values, turned = np.linalg.svd(jacobian / scale, full_matrices=False)
    # Below this ratio of singular values of the scaled Jacobian, parameters are unidentifiable.
    if values[-1] < 1e-6 * values[0]:
        labels = [f"{coil}.{name}" for coil in data.names for name in PARAMETERS] + ["background x", "background y"]
        mixed = [label for label, weight in zip(labels, np.abs(turned[-1]), strict=True) if weight > 0.3]
        words = "readings that tell them apart: all over the dish, and some without current"
        raise InvalidInputError(data.source, f"nothing that tells {', '.join(mixed)}", words)
    count, parameters = jacobian.shape
    scatter = residual * math.sqrt(count / max(1, count - parameters))
    deviations = scatter * np.linalg.norm(turned.T / values, axis=1) / scale
    return np.asarray(deviations[:-2].reshape(-1, 4))


def _exceeding(shares: Vector, limits: Sequence[float]) -> tuple[str, ...]:
    """Return the parameters of a coil whose standard deviation, as a share but of the angle, exceeds its limit."""
    return tuple(name for name, share, most in zip(PARAMETERS, shares, limits, strict=True) if share > most)
