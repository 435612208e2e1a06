"""Fitting the coils to measurements of their field."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest

from magnetosuture_thread.coils.calibration import ProbeMeasurements, fit_calibration
from magnetosuture_thread.coils.field import CoilProperties, LoopCoils
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.rig.mechanics.needle import CoilField
from magnetosuture_thread.rig.settings import RigSettings
from magnetosuture_thread.settings.errors import InvalidInputError

UNLIKE = (
    CoilProperties("coil_0", 0.05, 0.052, 0.024, 1.1e-3),
    CoilProperties("coil_1", 1.5, 0.048, 0.03, -1.3e-3),
    CoilProperties("coil_2", -2.9, 0.055, 0.025, 1.2e-3),
    CoilProperties("coil_3", -1.6, 0.05, 0.025, 0.9e-3),
)
EARTH = np.array([2e-5, -4e-5])
Field = Callable[[np.ndarray], np.ndarray]


def lattice(reach: float, count: int) -> np.ndarray:
    """Return points in a disc."""
    at = np.linspace(-reach, reach, count)
    return np.array([(x, y) for x in at for y in at if math.hypot(x, y) <= 1.0001 * reach])


def measured(
    per_current: Field, noise: float = 0.0, points: np.ndarray | None = None, currents: tuple[float, ...] = (2.0,)
) -> ProbeMeasurements:
    """Return what a probe reads of four coils, one on at a time."""
    random = np.random.default_rng(1)
    points = lattice(0.015, 7) if points is None else points
    rows = [
        (index, current, *point, *(current * per_current(point)[:, index] + EARTH))
        for index in range(4)
        for current in currents
        for point in points
    ]
    table = np.array(rows)
    field = table[:, 4:] + noise * random.standard_normal((len(table), 2))
    names = tuple(coil.name for coil in UNLIKE)
    lines = np.arange(len(table)) + 2
    return ProbeMeasurements("probe.csv", names, table[:, 0].astype(int), table[:, 1], table[:, 2:4], field, lines)


def test_measurements_of_the_model_itself_give_its_parameters_again():
    fit = fit_calibration(measured(LoopCoils(UNLIKE).per_current))
    for found, coil in zip(fit.calibration.coils, UNLIKE, strict=True):
        assert found.name == coil.name
        assert found.angle == pytest.approx(coil.angle, abs=1e-7)
        assert found.distance == pytest.approx(coil.distance, rel=1e-7)
        assert found.field_per_current == pytest.approx(coil.field_per_current, rel=1e-7)
        assert found.radius == pytest.approx(coil.radius, rel=1e-6)
    np.testing.assert_allclose(fit.background, EARTH, atol=1e-9)
    assert fit.residual < 1e-10
    assert fit.poor == ((),) * 4


def wound(change: dict[str, float]) -> Field:
    """Return the field of the simulated rig's finite windings, one coil of which is not as it is meant to be."""
    rig = RigSettings()
    angle = rig.coil_angles[1] + change.get("around", 0.0)
    distance, axis = rig.coil_distance + change.get("farther", 0.0), angle + change.get("turned", 0.0)
    turns, others = rig.coil_turns * change.get("strength", 1.0), rig.field()
    other = CoilField([axis], rig.coil_distance, rig.coil_radius, rig.coil_length, turns)
    # Where the axis of the other one would begin, if it passed through the dish's centre.
    begin = distance * direction(angle) - rig.coil_distance * direction(axis)

    def per_current(point: np.ndarray) -> np.ndarray:
        found = others.per_current(point)
        found[:, 1] = other.per_current(point - begin)[:, 0]
        return found

    return per_current


def direction(angle: float) -> np.ndarray:
    return np.array([math.cos(angle), math.sin(angle)])


def error(field: Field, truth: Field, index: int) -> float:
    """Return the error of a coil's field in the dish, as a share of it, by root mean square."""
    points = lattice(0.0165, 13)
    true = np.array([truth(point)[:, index] for point in points])
    apart = np.array([field(point)[:, index] for point in points]) - true
    return float(np.sqrt((apart**2).sum() / (true**2).sum()))


@pytest.mark.parametrize(
    ("change", "before", "after"),
    [
        ({}, 0.02, 0.005),
        ({"farther": 0.004}, 0.2, 0.005),
        ({"turned": math.radians(5.0)}, 0.03, 0.02),  # an axis past the centre, which the model does not have
        ({"farther": 0.004, "around": math.radians(5.0), "strength": 0.9}, 0.3, 0.005),
    ],
)
def test_a_rig_that_is_not_as_drawn_is_known_much_better_after_a_calibration(
    change: dict[str, float], before: float, after: float
):
    """Windings of finite length, measured by a probe with a noise of 20 uT at 2 A; none of the models has them."""
    truth = wound(change)
    fit = fit_calibration(measured(truth, 2e-5, currents=(2.0, -2.0)))
    drawn = LoopCoils(CoilBridgeSettings().coils_properties())
    assert error(drawn.per_current, truth, 1) > before
    assert error(LoopCoils(fit.calibration.coils).per_current, truth, 1) < after
    assert error(LoopCoils(fit.calibration.coils).per_current, truth, 0) < 0.005
    assert fit.calibration.coils[1].residual > 1.5e-5
    np.testing.assert_allclose(fit.background, EARTH, atol=5e-6)


def some(data: ProbeMeasurements, which: np.ndarray) -> ProbeMeasurements:
    """Return some of the readings."""
    rows = {name: getattr(data, name)[which] for name in ("coil", "current", "points", "field", "lines")}
    return dataclasses.replace(data, **rows)


def moved(data: ProbeMeasurements, row: int, place: tuple[float, float]) -> ProbeMeasurements:
    """Return the readings with one at another place."""
    points = data.points.copy()
    points[row] = place
    return dataclasses.replace(data, points=points)


GOOD = measured(LoopCoils(UNLIKE).per_current, 1e-6)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (some(GOOD, np.flatnonzero((GOOD.coil != 2) | (GOOD.lines % 6 == 0))), "coil_2: got 5 readings with current"),
        (dataclasses.replace(some(GOOD, GOOD.coil < 2), names=("coil_0", "coil_1")), "at least 3 coils"),
        (dataclasses.replace(GOOD, current=np.zeros(len(GOOD.coil))), "0 readings with current"),
        (dataclasses.replace(GOOD, field=1e-5 * GOOD.field), "the field of coils in T"),
        (dataclasses.replace(GOOD, field=np.roll(GOOD.field, 7, axis=0)), "differs from the model's by"),
        (moved(GOOD, 40, (0.06, 0.0)), r"line 42: got a point at \[0\.06, 0\.0\] m, expected points within the coils"),
        (measured(LoopCoils(UNLIKE).per_current, 1e-6, np.zeros((9, 2))), "nothing that tells"),
        (measured(LoopCoils(UNLIKE).per_current, 5e-4, lattice(0.003, 5)), "an unknown|differs"),
    ],
)
def test_readings_that_tell_nothing_are_refused(data: ProbeMeasurements, words: str):
    with pytest.raises(InvalidInputError, match=words) as caught:
        fit_calibration(data)
    assert str(caught.value).startswith("probe.csv")


def test_what_is_poorly_determined_is_said():
    fit = fit_calibration(measured(LoopCoils(UNLIKE).per_current, 3e-5, lattice(0.006, 5)))
    assert all("distance" in poor for poor in fit.poor)
    assert not any("angle" in poor for poor in fit.poor)
