"""From tip velocities to currents."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from magnetosuture_thread.coils.allocation import (
    COIL_ERROR,
    HEADING_ERROR,
    CoilAllocation,
    NeedleMechanics,
    PoseDeviation,
    bounded_least_squares,
)
from magnetosuture_thread.coils.field import LoopCoils, coils_around
from magnetosuture_thread.coils.needle_motion import NeedleTwist
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.rig.setups import read_setup
from magnetosuture_thread.settings.errors import InvalidInputError

NEEDLE = CoilBridgeSettings().needle()
COILS = LoopCoils(coils_around((0.0, np.pi / 2, np.pi, -np.pi / 2), 0.05, 0.025, 1.2e-3))
EAST = np.array([1.0, 0.0])
MIDDLE = -0.5 * NEEDLE.length * EAST  # the tail of a needle whose middle is the dish's


def allocation(limit: float = 10.0, needle: NeedleMechanics = NEEDLE) -> CoilAllocation:
    """Return the allocation of four coils around a dish."""
    return CoilAllocation(COILS, needle, 0.008, limit)


def turned(vector: np.ndarray, angle: float) -> np.ndarray:
    """Return a vector, turned counter-clockwise."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


def test_for_no_motion_the_field_holds_the_direction():
    found = allocation().allocate(NeedleTwist(), MIDDLE, EAST)
    field = COILS.per_current(np.zeros(2)) @ found.currents
    assert field[0] > 0.4 * 0.008
    assert abs(field[1]) < 1e-3 * field[0]
    assert np.linalg.norm(found.velocity) < 1e-5


def test_the_coil_ahead_pulls_and_the_field_lies_along_the_needle():
    found = allocation().allocate(NeedleTwist(0.005), MIDDLE, EAST)
    assert found.currents[0] == max(found.currents)
    field = COILS.per_current(np.zeros(2)) @ found.currents
    assert field[0] == pytest.approx(0.008, rel=0.5)
    assert abs(field[1]) < 1e-3 * field[0]
    np.testing.assert_allclose(found.velocity, [0.005, 0.0], atol=2e-5)
    assert not found.saturated


@given(
    x=st.floats(-0.01, 0.01),
    y=st.floats(-0.01, 0.01),
    angle=st.floats(-np.pi, np.pi),
    way=st.floats(-1.0, 1.0),
    speed=st.floats(0.001, 0.006),
)
def test_away_from_the_wall_the_velocity_is_reached_by_the_physics(
    x: float, y: float, angle: float, way: float, speed: float
):
    """The forces and the torque of the poles in the field, divided by the drag, give the velocity again."""
    tail, heading = np.array([x, y]), turned(EAST, angle)
    assume(np.linalg.norm([tail, tail + NEEDLE.length * heading], axis=1).max() < 0.012)
    velocity = speed * turned(heading, way)
    twist = NEEDLE.kinematics.twist(heading, velocity)
    found = allocation(limit=1000.0).allocate(twist, tail, heading, at_tip=True)
    across = turned(heading, np.pi / 2)
    pole = NEEDLE.moment / NEEDLE.length
    at_tail = COILS.per_current(tail) @ found.currents
    at_tip = COILS.per_current(tail + NEEDLE.length * heading) @ found.currents
    force = pole * (at_tip - at_tail)
    torque = pole * NEEDLE.length * 0.5 * (at_tail + at_tip) @ across
    tip = (force @ heading) / NEEDLE.drag * heading + (
        (force @ across) / NEEDLE.drag_across + 0.5 * NEEDLE.length * torque / NEEDLE.turning_drag
    ) * across
    np.testing.assert_allclose(found.velocity, tip, atol=1e-9)
    assert found.drift == pytest.approx((force @ across) / NEEDLE.drag_across, abs=1e-9)
    assert np.linalg.norm(tip - velocity) < 0.15 * speed


def test_saturation_is_reported_with_the_velocity_really_reached():
    found = allocation(limit=0.5).allocate(NeedleTwist(0.02), MIDDLE, EAST)
    assert found.saturated
    assert np.abs(found.currents).max() == pytest.approx(0.5)
    assert 0.0 < found.velocity[0] < 0.01


@pytest.mark.parametrize(("along", "x", "cosine"), [(np.nan, 0.0, 1.0), (0.001, np.inf, 1.0), (0.001, 0.0, np.nan)])
def test_what_is_not_finite_is_refused(along: float, x: float, cosine: float):
    allocation = CoilAllocation(COILS, NEEDLE, 0.008, 10.0)
    with pytest.raises(InvalidInputError, match="finite"):
        allocation.allocate(NeedleTwist(along), np.array([x, 0.0]), np.array([cosine, 0.0]))


@pytest.mark.parametrize("unknowns", [3, 4, 6, 8])
def test_bounded_least_squares_are_those_of_scipy(unknowns: int):
    rng = np.random.default_rng(unknowns)
    at_bounds = 0
    for number in range(100):
        system = np.vstack([rng.normal(size=(5, unknowns)), np.diag(rng.uniform(1e-3, 1.0, unknowns))])
        target = rng.normal(size=len(system)) * rng.choice([0.1, 1.0, 10.0])
        lower = rng.normal(size=unknowns)
        upper = lower + rng.uniform(0.0, 2.0, unknowns)
        if number % 5 == 0:
            upper[0] = lower[0]
        found = bounded_least_squares(system, target, lower, upper)
        expected = lsq_linear(system, target, (lower, upper + 1e-12), method="bvls", tol=1e-14).x
        np.testing.assert_allclose(found, expected, atol=1e-7)
        assert np.all((lower <= found) & (found <= upper))
        at_bounds += bool(np.any((found == lower) | (found == upper)))
    assert at_bounds > 50


@given(
    vx=st.floats(-1.0, 1.0),
    vy=st.floats(-1.0, 1.0),
    turn=st.floats(-1e3, 1e3),
    x=st.floats(-0.017, 0.017),
    angle=st.floats(-np.pi, np.pi),
)
def test_currents_never_leave_their_limits(vx: float, vy: float, turn: float, x: float, angle: float):
    found = allocation(limit=3.0).allocate(NeedleTwist(vx, vy, turn), np.array([x, 0.5 * x]), turned(EAST, angle))
    assert np.all(np.isfinite(found.currents))
    assert (np.abs(found.currents) <= 3.0).all()


@pytest.mark.parametrize("degrees", [-4.0, -1.0, 0.5, 2.5, 4.0])
def test_close_to_the_axis_of_a_coil_a_pull_across_the_needle_is_compensated_and_the_needle_turns(degrees: float):
    """A stronger field along the needle would pull it across by its own gradient, by up to twice as much."""
    settings = read_setup("hernia_ring").coils
    made, needle = settings.allocation(), settings.needle()
    e = turned(EAST, np.radians(degrees))
    n = np.array([-e[1], e[0]])
    tail = np.array([0.00226, 0.01153]) - 0.5 * needle.chord * e
    pulled = NeedleTwist(-0.0024, 0.0015)  # with what a straight thread adds to the drag
    wanted = needle.kinematics.twist(e, 0.001 * e - 0.0014 * n)
    found = made.allocate(wanted.less(pulled), tail, e)
    moved = found.velocity + needle.kinematics.tip_velocity(e, pulled)
    assert found.drift == pytest.approx(-pulled.across, abs=6.5e-4)
    assert moved @ e == pytest.approx(0.001, abs=1e-4)
    assert moved @ n - found.drift - pulled.across == pytest.approx(-0.0014, abs=5e-5)
    assert np.abs(found.currents).max() < settings.max_current


@pytest.mark.parametrize("degrees", [86.0, 89.0, 90.0, 91.0, 92.0, 95.0])
@pytest.mark.parametrize("drift", [-0.004, -0.0015, 0.0015, 0.004])
def test_however_it_is_pulled_the_field_stays_along_the_needle_and_turns_it_as_commanded(degrees: float, drift: float):
    settings = read_setup("hernia_ring").coils
    made, needle, coils = settings.allocation(), settings.needle(), settings.coil_field()
    e = turned(EAST, np.radians(degrees))
    n = np.array([-e[1], e[0]])
    tail = np.array([-0.0066, 0.0043]) - 0.5 * needle.chord * e
    wanted = needle.kinematics.twist(e, 0.001 * e - 0.001 * n)
    found = made.allocate(wanted.less(NeedleTwist(0.0002, drift)), tail, e)
    fields = [coils.per_current(at) @ found.currents for at in (tail, tail + needle.chord * e)]
    assert 0.5 * (fields[0] + fields[1]) @ e > 0.35 * settings.aligning_field
    assert found.velocity @ n - found.drift == pytest.approx(-0.001, abs=1e-4)


@pytest.mark.parametrize("degrees", [-84.0, -80.0, -76.0])
@pytest.mark.parametrize("rate", [-3.0, 0.0, 3.0])
@pytest.mark.parametrize("balance", [0.0, 3e-4])
def test_in_a_period_the_needle_turns_as_far_as_commanded_however_weak_the_field(
    degrees: float, rate: float, balance: float
):
    """Close to a coil's axis a pull across the needle leaves less of the field than half; integrated by Euler."""
    settings, middle = read_setup("dish_50mm").coils, np.array([0.0135, -0.006])
    made, needle, coils = settings.allocation(), settings.needle(), settings.coil_field()
    angle, period, fields = np.radians(degrees), 1.0 / settings.rate, []
    for pull in (-0.006, 0.006):
        e = turned(EAST, angle)
        found = made.allocate(NeedleTwist(0.002, pull, rate), middle - 0.5 * needle.chord * e, e, balance=balance)
        theta = angle
        for _ in range(500):
            e = turned(EAST, theta)
            ends = (middle - 0.5 * needle.chord * e, middle + 0.5 * needle.chord * e)
            x, y = 0.5 * (coils.per_current(ends[0]) + coils.per_current(ends[1])) @ found.currents
            across = e[0] * y - e[1] * x
            theta += period / 500 * needle.moment * (across - balance) / needle.turning_drag
        fields.append(e[0] * x + e[1] * y)
        assert theta - angle == pytest.approx(rate * period, abs=2e-3)
        n = np.array([-np.sin(angle), np.cos(angle)])
        turn_rate = (found.velocity @ n - found.drift) / (0.5 * needle.chord)
        assert turn_rate == pytest.approx(rate, abs=0.1)
    assert min(fields) < 0.6 * settings.aligning_field


@pytest.mark.parametrize("turn", [0.0, 0.4, np.pi / 4])
def test_along_the_axes_of_coils_no_currents_hold_the_needle_and_beside_them_they_do(turn: float):
    coils = LoopCoils(coils_around([turn + k * np.pi / 2 for k in range(4)], 0.05, 0.025, 1.2e-3))
    made = CoilAllocation(coils, NEEDLE, 0.008, 10.0)
    axes = [axis for axis, _ in made.axes()]
    assert axes == pytest.approx([turn, turn + 0.5 * np.pi], abs=1e-3)
    for axis in axes:
        drifts = []
        for angle in (axis - 0.3, axis, axis + 0.3):
            e = turned(EAST, angle)
            drifts.append(made.allocate(NeedleTwist(0.0, -1e-3), -0.5 * NEEDLE.chord * e, e).drift)
        assert drifts == pytest.approx([-1e-3, 0.0, -1e-3], abs=2e-4)


@pytest.mark.parametrize("distance", [0.05, 0.08])
def test_what_is_held_for_each_radian_off_an_axis_turns_the_field_by_no_more_than_a_heading_s_error(
    distance: float,
):
    settings = replace(read_setup("hernia_ring").coils, coil_distance=distance)
    made, off = settings.allocation(), 0.1
    axis, held = made.axes()[0]
    e = turned(EAST, axis + off)
    tail = -0.5 * settings.needle().chord * e
    at_rest, against = (made.allocate(NeedleTwist(0.0, across), tail, e) for across in (0.0, -off * held))
    assert against.drift == pytest.approx(-off * held, rel=0.1)
    field = COIL_ERROR * settings.field_per_current * np.linalg.norm(against.currents - at_rest.currents)
    assert field / settings.aligning_field == pytest.approx(HEADING_ERROR, rel=0.2)


@pytest.mark.parametrize(("degrees", "is_held"), [(3.0, False), (45.0, True)])
@pytest.mark.parametrize("doubt", [PoseDeviation(place=1e-3), PoseDeviation(stamp=0.05)])
def test_the_less_a_pose_is_known_the_less_of_a_pull_is_held_beside_an_axis(
    degrees: float, is_held: bool, doubt: PoseDeviation
):
    """There a needle that lies otherwise than it is measured is thrown; between two axes it is held all the same.

    In a field of 10 mT: what is held at all is in proportion to it.
    """
    made = replace(read_setup("hernia_ring").coils, aligning_field=0.01).allocation()
    e = turned(EAST, np.radians(degrees))
    tail, twist = -0.5 * NEEDLE.chord * e, NeedleTwist(0.008, 2e-3, 3.0)
    known, doubted = (made.allocate(twist, tail, e, deviation=of).drift for of in (PoseDeviation(), doubt))
    assert known > 1.4e-3
    assert (doubted > 0.95 * known) is is_held
    assert (doubted < 0.8 * known) is not is_held


def test_six_coils_have_no_axis():
    coils = LoopCoils(coils_around([k * np.pi / 3 for k in range(6)], 0.05, 0.025, 1.2e-3))
    assert CoilAllocation(coils, NEEDLE, 0.008, 10.0).axes() == ()
