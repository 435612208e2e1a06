"""Calibration of a rig's coils: its YAML file, and the least-squares fit to measurements that come in a CSV file."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from magnetosuture_thread.coils.field import CoilProperties, loop_fields
from magnetosuture_thread.settings.configuration import from_mapping, read_yaml, to_mapping
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError
from magnetosuture_thread.settings.files import MAX_TEXT_BYTES, read_regular

MODEL = "loops"  # of the field of a coil
MIN_COILS = 3  # needed to pull in every direction
TEXT_KEYS = ("name", "date", "notes")
REQUIRED_KEYS = ("name", "angle", "distance", "radius", "field_per_current")


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
            coils.append({key: value for key, value in named.items() if key in REQUIRED_KEYS or value})
        return header + yaml.safe_dump({**head, "coils": coils}, sort_keys=False, allow_unicode=True)


def read_calibration(path: Path) -> CoilCalibration:
    """Read a calibration from a YAML file.

    Raises:
        ConfigurationError: the file is unreadable or no YAML, a key is missing or unknown, or a value has the wrong
            type or is out of bounds; with file, key, value and expectation.
    """
    content, source = read_yaml(path, "coil calibration"), str(path)
    known = (*TEXT_KEYS, "model", "coils")
    if not isinstance(content, Mapping):
        raise ConfigurationError("coil calibration", content, f"keys {', '.join(known)}", source)
    for key, value in content.items():
        if key not in known:
            raise ConfigurationError(str(key), value, f"one of {', '.join(known)}", source)
        if key in TEXT_KEYS and not isinstance(value, str):
            raise ConfigurationError(key, value, "text", source)
    if content.get("model", MODEL) != MODEL:
        expected = f"{MODEL}, the only model; calibrate the coils again"
        raise ConfigurationError("model", content["model"], expected, source)
    listed = content.get("coils")
    if not isinstance(listed, list) or len(listed) < MIN_COILS:
        given = f"{len(listed)} coils" if isinstance(listed, list) else listed
        raise ConfigurationError("coils", given, f"a list of at least {MIN_COILS} coils", source)
    coils: list[CoilProperties] = []
    for index, values in enumerate(listed):
        where, needed = f"coils[{index}]", ", ".join(REQUIRED_KEYS)
        if not isinstance(values, Mapping):
            raise ConfigurationError(where, values, f"keys {needed}", source)
        for key in REQUIRED_KEYS:
            if key not in values:
                raise ConfigurationError(f"{where}.{key}", None, f"a value: {needed} are needed", source)
        try:
            coils.append(from_mapping(CoilProperties, {str(key): value for key, value in values.items()}))
        except ConfigurationError as error:
            name = error.name.replace(CoilProperties.GROUP, where, 1)
            raise ConfigurationError(name, error.value, error.expectation, source) from None
        if coils[-1].name in [coil.name for coil in coils[:-1]]:
            expected = "a name of its own for each"
            raise ConfigurationError("coils", f"two of the name {coils[-1].name}", expected, source)
    return CoilCalibration(coils=tuple(coils), **{key: content.get(key, "") for key in TEXT_KEYS})


Array = NDArray[np.float64]

COLUMNS = ("coil", "current", "x", "y", "bx", "by")
# Values out of these bounds are assumed to have another unit.
VALUE_BOUNDS = {"current": (1000.0, "A"), "x": (0.5, "m"), "y": (0.5, "m"), "bx": (1.0, "T"), "by": (1.0, "T")}
MAX_COILS = 64
MIN_READINGS = 6  # of a coil with current: twelve numbers for four parameters, with some for the residual
MIN_DISTANCE_RATIO = 1.05  # of a coil's distance to that of the farthest point
RADIUS_BOUNDS = (0.002, 0.5)  # m
PARAMETERS = ("angle", "distance", "radius", "field_per_current")
# Standard deviations, of the angle in rad, of the others relative: above, a parameter is poorly determined, or
# unidentifiable. The field hardly depends on the radius, which has no such limit.
POOR_DEVIATION = {"angle": 0.02, "distance": 0.1, "radius": 0.25, "field_per_current": 0.02}
MAX_DEVIATION = {"angle": 0.3, "distance": 1.0, "radius": math.inf, "field_per_current": 0.5}


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
        if not values["coil"]:
            raise InvalidInputError(f"{where}, coil", "nothing", "index or name of the coil that is on")
        named.append(f"coil_{int(values['coil'])}" if _is_index(values["coil"]) else values["coil"])
        numbers.append([_number(f"{where}, {column}", values[column], column) for column in COLUMNS[1:]])
    names, table = _ordered_names(named, path), np.array(numbers)
    coil, at = np.array([names.index(name) for name in named]), np.array([number for _, number, _ in rows[1:]])
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
    deviations: Array
    poor: tuple[tuple[str, ...], ...]
    background: Array
    residual: float
    worst: tuple[int, float]
    readings: int

    def to_json(self) -> dict[str, Any]:
        """Return the result as plain values."""
        coils = [
            {
                **{key: getattr(coil, key) for key in ("name", *PARAMETERS, "residual")},
                "deviations": dict(zip(PARAMETERS, row, strict=True)),
                "poor": list(poor),
            }
            for coil, row, poor in zip(self.calibration.coils, self.deviations.tolist(), self.poor, strict=True)
        ]
        return {
            "model": MODEL,
            "coils": coils,
            "background": self.background.tolist(),
            "residual": self.residual,
            "worst": self.worst,
            "readings": self.readings,
        }


def fit_calibration(data: ProbeMeasurements) -> CalibrationFit:
    """Fit coils as loops of current, and a background, to measurements.

        min  sum | B_0 + I_i b(p_i; angle, distance, radius, field) - B_i |^2

    over four numbers of each coil and the background B_0 of earth and probe, which is
    the same in all. First coil by coil, from several starts and both polarities, then all at once. The
    standard deviations are those of least squares, s^2 (J^T J)^-1, with the scatter s of the residuals.

    Args:
        data: readings in the dish.

    Raises:
        InvalidInputError: too few coils or readings, points beyond a coil, unidentifiable
            parameters, or a field that does not fit the model.

    Source: none; nonlinear least squares by scipy, trust region reflective.
    """
    _check_readings(data)
    size = float(np.sqrt(np.mean(data.field[data.current != 0.0] ** 2)))
    off = data.field[data.current == 0.0]
    background = off.mean(axis=0) if len(off) else np.zeros(2)
    starts = [_start(data, index, background, size) for index in range(len(data.names))]
    found = _solve(data, np.arange(len(data.names)), size, [np.concatenate([*starts, background / size])])
    difference = size * found.fun.reshape(-1, 2)
    residual = float(np.sqrt(np.mean(difference**2)))
    # A residual of more than a quarter of the measured field means other coils.
    if residual > 0.25 * size:
        given = f"a field that differs from the model's by {residual / size:.0%}"
        raise InvalidInputError(data.source, given, "one coil on at a time, in the dish frame, in SI units")
    coils = [_coil(data, index, found.x, size, difference) for index in range(len(data.names))]
    deviations = _deviations(data, coils, found.jac, size, residual / size)
    distances = np.linalg.norm(difference, axis=1)
    worst = int(np.argmax(distances))
    return CalibrationFit(
        CoilCalibration("", "", "", tuple(coils)),
        deviations,
        tuple(_exceeding(coil, row, POOR_DEVIATION) for coil, row in zip(coils, deviations, strict=True)),
        size * found.x[-2:],
        residual,
        (int(data.lines[worst]), float(distances[worst])),
        len(distances),
    )


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


def _solve(
    data: ProbeMeasurements, coils: NDArray[np.int64], size: float, starts: list[Array], background: Array | None = None
) -> Any:
    """Return the best least-squares fit of some of the coils, from several starts, in numbers of order one.

    The numbers are, for each coil, angle, log distance, log radius and field / size; then the background / size, unless
    that is given, as one coil alone might not tell it from its own field. Residuals are in units of the field's size.
    """
    from scipy.optimize import least_squares  # here, as whoever reads a calibration alone need not wait for it

    rows = np.flatnonzero(np.isin(data.coil, coils))
    of, points, current = np.searchsorted(coils, data.coil[rows]), data.points[rows], data.current[rows, None]
    field = data.field[rows] / size
    # A coil is beyond all points, and at most 1 m away.
    nearest = max(0.01, MIN_DISTANCE_RATIO * float(np.hypot(*data.points.T).max()))
    low = [-np.inf, math.log(nearest), math.log(RADIUS_BOUNDS[0]), -np.inf] * len(coils)
    high = [np.inf, math.log(max(1.0, 2.0 * nearest)), math.log(RADIUS_BOUNDS[1]), np.inf] * len(coils)
    if background is None:
        low, high = [*low, -np.inf, -np.inf], [*high, np.inf, np.inf]

    def residuals(x: Array) -> Array:
        angle, distance, radius, strength = x[: 4 * len(coils)].reshape(-1, 4).T[:, of]
        axis = np.column_stack([np.cos(angle), np.sin(angle)])
        across = np.column_stack([-axis[:, 1], axis[:, 0]])
        along, aside = np.sum(points * axis, axis=1), np.sum(points * across, axis=1)
        axial, outwards = loop_fields(along, aside, np.exp(distance), np.exp(radius), strength)
        of_coil = current * (axial[:, None] * axis + outwards[:, None] * across)
        return np.asarray(((x[-2:] if background is None else background / size) + of_coil - field).ravel())

    tolerances = dict.fromkeys(("ftol", "xtol", "gtol"), 1e-12 if background is None else 1e-5)
    options: dict[str, Any] = {"jac": "3-point", "bounds": (low, high), "x_scale": "jac", **tolerances}
    found = [least_squares(residuals, np.clip(start, low, high), max_nfev=300, **options) for start in starts]
    return min(found, key=lambda solution: float(solution.cost))


def _start(data: ProbeMeasurements, index: int, background: Array, size: float) -> Array:
    """Return initial parameters of a coil from its own readings, without the background."""
    on = (data.coil == index) & (data.current != 0.0)
    points, per_current = data.points[on], (data.field[on] - background) / data.current[on, None]
    # Field and gradient at the centre by a straight line, and how fast the field grows along itself.
    reach = max(1e-6, float(np.abs(points).max()))
    line = np.linalg.lstsq(np.column_stack([np.ones(len(points)), points / reach]), per_current, rcond=None)[0]
    strength = max(float(np.linalg.norm(line[0])), 1e-9)
    along = line[0] / strength
    growth = abs(float(along @ (line[1:].T / reach) @ along)) / strength
    distance = 2.5 / max(growth, 2.5)  # a dipole's is 3 / distance, a loop's a little less
    angle = math.atan2(along[1], along[0])
    starts = [
        np.array([turned, math.log(share * distance), math.log(0.5 * share * distance), sign * strength / size])
        # Initial distances, relative to that by the field's gradient.
        for share in (1.0, 0.5, 2.0)
        for turned, sign in ((angle, 1.0), (angle + math.pi, -1.0))
    ]
    return np.asarray(_solve(data, np.array([index]), size, starts, background).x)


def _coil(data: ProbeMeasurements, index: int, x: Array, size: float, difference: Array) -> CoilProperties:
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
        name = error.name.replace(CoilProperties.GROUP, data.names[index], 1)
        raise InvalidInputError(f"{data.source}, {name}", error.value, error.expectation) from None


def _deviations(
    data: ProbeMeasurements, coils: list[CoilProperties], jacobian: Array, size: float, residual: float
) -> Array:
    """Return standard deviations, shape (m, 4); reject unidentifiable parameters."""
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    _, values, turned = np.linalg.svd(jacobian / scale, full_matrices=False)
    labels = [f"{coil.name}.{name}" for coil in coils for name in PARAMETERS] + ["background x", "background y"]
    # Below this ratio of singular values of the scaled Jacobian, parameters are unidentifiable.
    if values[-1] < 1e-6 * values[0]:
        weights = np.abs(turned[-1])
        mixed = [label for label, weight in zip(labels, weights, strict=True) if weight > 0.3]
        words = "readings that tell them apart: all over the dish, and some without current"
        raise InvalidInputError(data.source, f"nothing that tells {', '.join(mixed)}", words)
    count, parameters = jacobian.shape
    scatter = residual * math.sqrt(count / max(1, count - parameters))
    deviations = scatter * np.linalg.norm(turned.T / values, axis=1) / scale
    shaped = deviations[:-2].reshape(-1, 4) * np.array([[1.0, coil.distance, coil.radius, size] for coil in coils])
    for coil, row in zip(coils, shaped, strict=True):
        unknown = _exceeding(coil, row, MAX_DEVIATION)
        if unknown:
            words = "readings that determine it: all over the dish, with a field well above the probe's noise"
            raise InvalidInputError(f"{data.source}, {coil.name}", f"an unknown {' and '.join(unknown)}", words)
    return np.asarray(shaped)


def _exceeding(coil: CoilProperties, deviations: Array, limits: dict[str, float]) -> tuple[str, ...]:
    """Return the parameters whose standard deviation exceeds its limit."""
    sizes = {name: 1.0 if name == "angle" else abs(getattr(coil, name)) for name in PARAMETERS}
    return tuple(
        name
        for name, deviation in zip(PARAMETERS, deviations.tolist(), strict=True)
        if deviation > limits[name] * sizes[name]
    )
