"""Fitting the coils to measurements of their field."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from magnetosuture_thread.coils.calibration import ProbeMeasurements, fit_calibration
from magnetosuture_thread.coils.field import CoilProperties, LoopCoils
from magnetosuture_thread.settings.errors import InvalidInputError

UNLIKE = (
    CoilProperties("coil_0", 0.05, 0.052, 0.024, 1.1e-3),
    CoilProperties("coil_1", 1.5, 0.048, 0.03, -1.3e-3),
    CoilProperties("coil_2", -2.9, 0.055, 0.025, 1.2e-3),
    CoilProperties("coil_3", -1.6, 0.05, 0.025, 0.9e-3),
)
EARTH = np.array([2e-5, -4e-5])


def lattice(reach: float, count: int) -> np.ndarray:
    """Return points in a disc."""
    at = np.linspace(-reach, reach, count)
    return np.array([(x, y) for x in at for y in at if math.hypot(x, y) <= 1.0001 * reach])


def measured(noise: float, points: np.ndarray) -> ProbeMeasurements:
    """Return what a probe reads of four coils, one on at a time with 2 A."""
    random, coils = np.random.default_rng(1), LoopCoils(UNLIKE)
    rows = [
        (index, 2.0, *point, *(2.0 * coils.per_current(point)[:, index] + EARTH))
        for index in range(4)
        for point in points
    ]
    table = np.array(rows)
    field = table[:, 4:] + noise * random.standard_normal((len(table), 2))
    names = tuple(coil.name for coil in UNLIKE)
    lines = np.arange(len(table)) + 2
    return ProbeMeasurements("probe.csv", names, table[:, 0].astype(int), table[:, 1], table[:, 2:4], field, lines)


def some(data: ProbeMeasurements, which: np.ndarray) -> ProbeMeasurements:
    """Return some of the readings."""
    rows = {name: getattr(data, name)[which] for name in ("coil", "current", "points", "field", "lines")}
    return dataclasses.replace(data, **rows)


def moved(data: ProbeMeasurements, row: int, place: tuple[float, float]) -> ProbeMeasurements:
    """Return the readings with one at another place."""
    points = data.points.copy()
    points[row] = place
    return dataclasses.replace(data, points=points)


GOOD = measured(1e-6, lattice(0.015, 7))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (some(GOOD, np.flatnonzero((GOOD.coil != 2) | (GOOD.lines % 6 == 0))), "coil_2: got 5 readings with current"),
        (dataclasses.replace(GOOD, field=1e-5 * GOOD.field), "the field of coils in T"),
        (dataclasses.replace(GOOD, field=np.roll(GOOD.field, 7, axis=0)), "differs from the model's by"),
        (moved(GOOD, 40, (0.06, 0.0)), r"line 42: got a point at \[0\.06, 0\.0\] m, expected points within the coils"),
        (measured(1e-6, np.zeros((9, 2))), "nothing that tells"),
        (measured(5e-4, lattice(0.003, 5)), "an unknown|differs"),
    ],
)
def test_readings_that_tell_nothing_are_refused(data: ProbeMeasurements, words: str):
    with pytest.raises(InvalidInputError, match=words) as caught:
        fit_calibration(data)
    assert str(caught.value).startswith("probe.csv")


def test_what_is_poorly_determined_is_said():
    fit = fit_calibration(measured(3e-5, lattice(0.006, 5)))
    assert all("distance" in poor for poor in fit.poor)
    assert not any("angle" in poor for poor in fit.poor)
