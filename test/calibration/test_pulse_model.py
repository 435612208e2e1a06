"""The motion of a bare needle under a pulse, against closed forms and against the simulated rig's own mechanics."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from magnetosuture_thread.calibration.commission import on_their_sides
from magnetosuture_thread.calibration.pulse_model import Pulse, PulseModel, RigParameters
from magnetosuture_thread.geometry.scene import Dish, Scene
from magnetosuture_thread.rig.dynamics import NeedleBody
from magnetosuture_thread.rig.rig import Rig
from magnetosuture_thread.rig.settings import RigSettings
from magnetosuture_thread.rig.truth import NO_THREAD

LENGTH, NEEDLE = 6e-3, NeedleBody(6e-3, 4e-4, 0.0, 8e5, 0.7)
ANGLES = np.array([0.2, 1.5, 3.3, -1.6])
TIMES = np.arange(0.0, 0.8, 0.02)
DEVIATIONS = np.array([5e-6, 5e-6, 2e-3])  # m, m, rad; of measured poses


def parameters(**changes: object) -> RigParameters:
    """Return a rig whose coils are thin loops of 480 turns, and whose needle is that of the simulated rig."""
    distance, radius = 0.05, 0.025
    field = 480.0 * 4e-7 * math.pi * radius**2 / (2.0 * (radius**2 + distance**2) ** 1.5)
    gains, moment = np.array([1.0, -0.7, 1.3, 0.8]), NEEDLE.pole * LENGTH
    residual, light = np.array([4e-5, -6e-5]), np.zeros(2)
    rig = RigParameters(ANGLES, gains * field, distance, radius, moment, LENGTH, NEEDLE.drag, 0.03, residual, light)
    return replace(rig, **changes)  # type: ignore[arg-type]


def pulse(currents: list[float], seconds: float = 0.4) -> Pulse:
    """Return a pulse without poses, on at 0.1 s."""
    return Pulse(np.array(currents), 0.1, 0.1 + seconds, TIMES, np.zeros((len(TIMES), 3)))


def simulated(given: Pulse, start: np.ndarray) -> np.ndarray:
    """Return the poses of the simulated rig, which integrates implicitly and knows nothing of this model."""
    settings = RigSettings(
        coil_angles=tuple(ANGLES.tolist()),
        coil_gains=(1.0, -0.7, 1.3, 0.8),
        coil_length=0.0,
        current_delay=0.03,
        residual_field=(4e-5, -6e-5),
        needle_length=LENGTH,
        needle_magnetisation=8e5,
        viscosity=0.7,
        needle_start=tuple(start.tolist()),
        **NO_THREAD,
    )
    rig, poses = Rig(settings, Scene(Dish(0.035))), []
    rig.apply(np.full(4, 1e-12), -0.03)
    for step in range(160):  # a frame every fourth
        time = 0.005 * step
        if step % 4 == 0:
            frame = rig.look(time, rendered=False)
            poses.append([*frame.tail, frame.heading])
        on = 0.1 - 1e-9 <= time < given.off - 1e-9
        rig.apply(given.currents if on else np.zeros(4), time)
    return np.array(poses)


@pytest.mark.parametrize("currents", [[0.6, 0.0, 0.0, 0.0], [0.0, 0.8, -0.4, 0.0], [-0.3, 0.5, 0.4, 0.9]])
def test_the_model_moves_as_the_mechanics_of_the_simulated_rig(currents: list[float]):
    start, given = np.array([-0.004, 0.002, 0.7]), pulse(currents)
    found, expected = parameters().poses(given, start), simulated(given, start)
    assert np.ptp(expected[:, 2]) > 0.3
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=4e-6)
    np.testing.assert_allclose(found[:, 2], expected[:, 2], atol=4e-3)


def test_a_needle_in_a_uniform_field_turns_as_the_closed_form_says():
    field = np.array([3e-5, 9e-5])
    rig = parameters(residual=field)
    found = rig.poses(pulse([0.0] * 4), np.array([0.001, 0.002, -0.5]))
    size, towards = float(np.hypot(*field)), math.atan2(field[1], field[0])
    rate = rig.moment * size / rig.drag[2]
    expected = towards - 2.0 * np.arctan(np.tan(0.5 * (towards + 0.5)) * np.exp(-rate * TIMES))
    np.testing.assert_allclose(found[:, 2], expected, atol=1e-5)
    middle = found[:, :2] + 0.5 * LENGTH * np.column_stack([np.cos(found[:, 2]), np.sin(found[:, 2])])
    np.testing.assert_allclose(middle, np.tile(middle[0], (len(middle), 1)), atol=1e-12)


def test_nothing_moves_before_the_delay_is_over():
    given = pulse([0.6, 0.0, 0.0, 0.0])
    found = parameters(residual=np.zeros(2)).poses(given, np.array([-0.004, 0.002, 0.7]))
    assert np.all(found[TIMES <= 0.13] == found[0])
    assert np.abs(found[TIMES > 0.17] - found[0]).max(axis=1).min() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("current", "residual", "turned"), [(0.3, (4e-5, -6e-5), (1, 0, 1, 0)), (0.1, (-9e-5, 4e-5), (0, 0, 1, 0))]
)
def test_a_coil_that_was_believed_on_the_other_side_by_a_needle_against_its_field_is_put_right(
    current, residual, turned
):
    truth, pulses = parameters(residual=np.array(residual)), []
    for coil in range(4):
        # From nearly against the field, where the needle is pushed away, until it has turned round.
        against = ANGLES[coil] + (0.0 if truth.fields[coil] < 0.0 else math.pi)
        for start in (against + 0.03, against + 1.2):
            given = pulse([current * (k == coil) for k in range(4)])
            poses = truth.poses(given, np.array([-0.003, 0.0, start]))
            pulses.append(replace(given, poses=poses))
    rough = parameters(drag=tuple(1.5 * drag for drag in NEEDLE.drag), residual=np.zeros(2), delay=0.0)
    wrong = replace(rough, angles=ANGLES + 0.1 + math.pi * np.array(turned))
    apart = np.abs(np.exp(1j * on_their_sides(wrong, pulses, DEVIATIONS).angles) - np.exp(1j * ANGLES))
    assert apart.max() < 0.11
    np.testing.assert_array_equal(on_their_sides(rough, pulses, DEVIATIONS).angles, rough.angles)


def test_a_fit_ends_as_soon_as_something_interrupts_it():
    truth, called = parameters(), list[None]()

    def check() -> None:
        called.append(None)
        if len(called) == 3:
            raise KeyboardInterrupt

    given = pulse([0.5, 0.0, 0.0, 0.0])
    pulses = [replace(given, poses=truth.poses(given, np.array([-0.003, 0.0, angle]))) for angle in (0.4, 1.2)]
    with pytest.raises(KeyboardInterrupt):
        PulseModel(truth, DEVIATIONS, check).fit(pulses)
    called.clear()
    with pytest.raises(KeyboardInterrupt):
        on_their_sides(truth, pulses, DEVIATIONS, check)
    assert len(called) == 3


@pytest.mark.slow
def test_a_fit_to_noisy_poses_finds_the_rig_and_its_intervals_hold_it():
    truth, random = parameters(light=np.array([2e-5, -3e-5])), np.random.default_rng(5)
    pulses, pose = [], np.array([-0.003, 0.0, 0.4])
    for _ in range(40):
        given = pulse((random.standard_normal(4) * (random.random(4) < 0.7) * 0.5).tolist(), random.uniform(0.1, 0.5))
        exact = truth.poses(given, pose)
        pulses.append(replace(given, poses=exact + DEVIATIONS * random.standard_normal(exact.shape)))
        pose = np.array([*(random.uniform(-3e-3, 3e-3, 2) - [0.003, 0.0]), exact[-1, 2]])
    drags = tuple(factor * drag for factor, drag in zip((1.4, 0.8, 1.3), NEEDLE.drag, strict=True))
    guess = parameters(
        angles=ANGLES + np.array([0.3, -0.2, 0.2, -0.3]),
        fields=np.array([1.2, -1.0, 0.9, 0.9]) * float(np.exp(np.log(np.abs(truth.fields)).mean())),
        drag=drags,
        delay=0.0,
        residual=np.zeros(2),
        light=np.zeros(2),
    )
    # The mean of the fields is held.
    guess = replace(guess, fields=guess.fields * np.exp(np.log(np.abs(truth.fields / guess.fields)).mean()))
    model = PulseModel(guess, DEVIATIONS)
    model.fit(pulses)
    found = model.parameters
    assert model.chi_square == pytest.approx(1.0, abs=0.1)
    errors = [
        *(found.angles - truth.angles),
        *np.log(found.fields / truth.fields),
        math.log(found.distance / truth.distance),
        math.log(found.radius / truth.radius),
        *np.log(np.array(found.drag) / truth.drag),
        math.log(found.length / truth.length),
        100.0 * (found.delay - truth.delay),
        *(1e4 * (found.residual - truth.residual)),
        *(1e5 * (found.light - truth.light)),
    ]
    assert np.count_nonzero(np.abs(errors) < 1.96 * model.deviations) >= len(errors) - 2
    assert np.abs(errors[:4]).max() < 0.003
    assert np.abs(errors[4:8]).max() < 0.005
    assert np.abs(errors[10:13]).max() < 0.02
    assert np.abs(errors[-2:]).max() < 0.6  # 10 um
