"""What the needle does beside its currents, measured from its poses and compensated by the coils."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from magnetosuture_thread.coils.motion_observer import PLACE_DEVIATION, PULL_NOISE, MotionObserver
from magnetosuture_thread.coils.settings import CoilBridgeSettings

SETTINGS = CoilBridgeSettings(motion_compensation=True)
NEEDLE = SETTINGS.needle()
PERIOD = 1.0 / SETTINGS.rate


def direction(angle: float) -> NDArray[np.float64]:
    return np.array([math.cos(angle), math.sin(angle)])


def apply(observer: MotionObserver, now: float, e: NDArray[np.float64], along: float, drift: float) -> None:
    """Set currents that give a velocity along and across the needle, and intend the same."""
    velocity = along * e + drift * np.array([-e[1], e[0]])
    observer.apply(now, velocity, velocity, 0.0)


def observed(turn_rate: float, along: float, drift: float, applied: tuple[float, float]) -> MotionObserver:
    """Return an observer of two seconds of poses, on time, of a needle that turns as well."""
    observer, middle, lever = MotionObserver(NEEDLE.kinematics, max_speed=0.01), np.zeros(2), 0.5 * NEEDLE.chord
    for k in range(400):
        angle = 0.3 + turn_rate * k * PERIOD
        e = direction(angle)
        apply(observer, 1.0 + k * PERIOD, e, *applied)
        if k % 10 == 0:
            observer.update(middle - lever * e, e, 1.0 + k * PERIOD)
        middle = middle + PERIOD * (along * e + drift * np.array([-e[1], e[0]]))
    return observer


def test_the_pull_is_the_motion_beside_that_of_the_currents():
    pull = observed(0.0, 3e-3, 1e-3, (4e-3, -5e-4)).pull(direction(0.3))
    assert pull == pytest.approx((-1e-3, 1.5e-3, 0.0), rel=0.01)


def test_the_pull_is_one_of_the_dish_and_does_not_turn_with_the_needle():
    observer = observed(0.0, 0.0, 1e-3, (0.0, 0.0))
    turned = observer.pull(direction(0.3 + 0.5 * math.pi))
    assert turned == pytest.approx((1e-3, 0.0, 0.0), rel=0.01, abs=1e-9)


def test_no_more_of_a_pull_is_compensated_than_the_greatest_speed():
    observer = observed(0.0, 0.0, 0.05, (0.0, 0.0))
    assert math.hypot(*observer.velocity) == pytest.approx(0.01)


@pytest.mark.parametrize("age", [0.0, 0.05, 0.1, 0.2])
@pytest.mark.parametrize("interval", [1.0 / 60.0, 0.05, 0.2])
def test_the_place_is_off_by_as_much_as_is_believed_when_a_next_pose_is_answered(age: float, interval: float):
    """Of many middles that a changing pull moves, each carried on by its last two poses."""
    observer, e = MotionObserver(NEEDLE.kinematics), direction(0.3)
    assert observer.place_deviation(1.0) == 0.0
    for stamp in (1.0, 1.0 + interval):
        observer.update(np.zeros(2), e, stamp)
    random, steps, after = np.random.default_rng(3), 400, age + interval
    step, velocity, place = (interval + after) / steps, np.zeros(4000), np.zeros((steps + 1, 4000))
    for k in range(steps):
        velocity = velocity + math.sqrt(PULL_NOISE * step) * random.standard_normal(4000)
        place[k + 1] = place[k] + step * velocity
    last = round(interval / step)
    seen = place[[0, last]] + PLACE_DEVIATION * random.standard_normal((2, 4000))
    off = place[-1] - seen[1] - after / interval * (seen[1] - seen[0])
    assert observer.place_deviation(1.0 + interval + age) == pytest.approx(off.std(), rel=0.06)


def test_the_place_of_a_needle_that_is_held_is_known_as_that_of_one_that_moves():
    """Poses that have not visibly moved change no pull, and tell the place all the same."""
    held = observed(0.0, 0.0, 0.0, (5e-3, 0.0)).place_deviation(2.98)
    assert held == observed(0.0, 3e-3, 0.0, (8e-3, 0.0)).place_deviation(2.98)


@pytest.mark.parametrize("interval", [1.0 / 60.0, 0.05])
@pytest.mark.parametrize("is_driven", [True, False])
def test_a_turn_by_the_field_about_a_tail_that_a_thread_holds_is_no_pull(is_driven: bool, interval: float):
    """Of 0.35 rad at 7 rad/s, as across a coil's axis; another turn of poses says as much of a pull as before."""
    observer, angle, swiftest = MotionObserver(NEEDLE.kinematics, max_speed=NEEDLE.max_pull_speed), 0.3, 0.0
    for k in range(round(2.0 / interval)):
        now = 1.0 + k * interval
        rate = 7.0 if 1.5 <= now < 1.549 else 0.0
        observer.update(np.zeros(2), direction(angle), now, trusted=True)
        observer.apply(now, np.zeros(2), np.zeros(2), rate if is_driven else 0.0)
        angle += rate * interval
        swiftest = max(swiftest, math.hypot(*observer.velocity))
    assert (swiftest < 1.2e-3) if is_driven else (swiftest > 3e-3)


def test_after_a_gap_between_poses_nothing_is_known():
    observer = observed(0.0, 0.0, 1e-3, (0.0, 0.0))
    observer.update(np.zeros(2), direction(0.3), 4.0)
    assert observer.pull(direction(0.3)) == (0.0, 0.0, 0.0)


def test_a_pull_that_changes_at_once_is_known_after_two_poses_and_its_noise_is_small():
    """A tracked middle trembles by 12 um, at 20 frames a second: two poses differ by up to 0.5 mm/s."""
    observer, e, random, found = MotionObserver(NEEDLE.kinematics), direction(0.0), np.random.default_rng(0), []
    for k in range(200):
        now, pull = 1.0 + 0.05 * k, 5e-3 if k >= 100 else 0.0
        apply(observer, now, e, 0.0, 0.0)
        place = max(0, k - 100) * 0.05 * pull * e
        observer.update(place + 1.2e-5 * random.standard_normal(2), e, now)
        found.append(observer.pull(e).along)
    assert np.std(found[20:100]) < 5e-4
    assert found[103] == pytest.approx(5e-3, rel=0.15)


@pytest.mark.parametrize("interval", [0.015, 0.05, 0.2])
def test_innovations_of_a_pull_that_changes_as_it_may_are_as_large_as_the_filter_believes(interval: float):
    observer, e, random, innovations = MotionObserver(NEEDLE.kinematics), direction(0.0), np.random.default_rng(1), []
    place, pull = np.zeros(2), np.zeros(2)
    for k in range(800):
        apply(observer, 1.0 + interval * k, e, 0.0, 0.0)
        step = observer.update(place + PLACE_DEVIATION * random.standard_normal(2), e, 1.0 + interval * k)
        innovations.append(math.nan if step is None else step.innovation)
        for _ in range(10):
            pull = pull + math.sqrt(PULL_NOISE * interval / 10) * random.standard_normal(2)
            place = place + interval / 10 * pull
    assert np.nanmean(innovations[20:]) == pytest.approx(1.0, rel=0.15)


def test_a_pose_is_compared_with_the_currents_of_its_time_however_late_it_comes():
    """The currents change all the time, and poses come 0.15 s late: all of the motion is explained by them."""
    observer, e, tail, waiting = MotionObserver(NEEDLE.kinematics), direction(0.3), np.zeros(2), []
    for k in range(800):
        now = 1.0 + k * PERIOD
        speed = 4e-3 * math.sin(20.0 * k * PERIOD)
        if k % 10 == 0:
            waiting.append((tail, now))
            if len(waiting) > 3:
                observer.update(waiting[-4][0], e, waiting[-4][1])
        apply(observer, now, e, speed, 0.0)
        tail = tail + PERIOD * speed * e
    assert np.abs(observer.pull(e)).max() < 1e-9


@pytest.mark.parametrize(("mobility", "late"), [*((m, n) for m in (0.5, 0.7, 1.0, 1.3, 1.5) for n in (0, 1, 2, 4, 8))])
def test_what_is_compensated_converges_with_late_poses(mobility: float, late: int):
    """The needle moves at `mobility` times the velocity that the model expects of its currents, and is pulled."""
    observer, e, tail, waiting = MotionObserver(NEEDLE.kinematics), direction(0.3), np.zeros(2), []
    wanted, pull, before = 2e-3, -1e-3, np.zeros(2)
    for k in range(4000):
        now = 1.0 + k * PERIOD
        if k % 10 == 0:
            waiting.append((tail, now))
            if len(waiting) > late:
                observer.update(waiting[-1 - late][0], e, waiting[-1 - late][1], trusted=True)
        applied = wanted - observer.pull(e).along
        apply(observer, now, e, applied, 0.0)
        before, tail = tail, tail + PERIOD * (mobility * applied + pull) * e
    assert (tail - before) @ e / PERIOD == pytest.approx(wanted, rel=0.02)


@pytest.mark.parametrize(("held", "learned"), [(0.0625, True), (0.064, False), (0.12, False)])
def test_currents_that_the_coils_may_have_switched_off_say_nothing(held: float, learned: bool):
    """The coils hold their currents for at least 0.0625 s; the needle does not move by them at all."""
    observer, e = MotionObserver(NEEDLE.kinematics, min_hold=0.0625), direction(0.3)
    observer.update(np.zeros(2), e, 1.0)
    apply(observer, 1.0, e, 4e-3, 0.0)
    observer.update(np.zeros(2), e, 1.0 + held, trusted=True)
    assert (observer.pull(e).along < 0.0) == learned


def test_nothing_is_learnt_of_poses_that_stand_still():
    """Another object is tracked: currents do not move it, and only a needle known to be tracked is taken for held."""
    observer, e, random = MotionObserver(NEEDLE.kinematics), direction(0.3), np.random.default_rng(0)
    for k in range(100):
        apply(observer, 1.0 + 0.05 * k, e, 2e-3, 0.0)
        observer.update(1e-5 * random.standard_normal(2), e, 1.0 + 0.05 * k)
    assert observer.pull(e) == (0.0, 0.0, 0.0)
    for k in range(100, 140):
        apply(observer, 1.0 + 0.05 * k, e, 2e-3, 0.0)
        observer.update(np.zeros(2), e, 1.0 + 0.05 * k, trusted=True)
    assert observer.pull(e).along == pytest.approx(-2e-3, rel=0.01)
