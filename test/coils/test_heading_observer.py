"""The heading between poses, the gain of each coil and the error of the stamps, against an integrated needle."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from magnetosuture_thread.coils.heading_observer import MAX_CHANGE, HeadingObserver
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.rig.closed_loop import START, ClosedLoop, Measurement
from magnetosuture_thread.rig.rig import Rig, RigFrame
from magnetosuture_thread.rig.setups import read_setup

SETTINGS = CoilBridgeSettings(motion_compensation=True, thread_drag=0.0093)
COILS, NEEDLE = SETTINGS.coil_field(), SETTINGS.needle()
NOISE = 5e-3  # rad; of a tracked heading
STEP, FRAME = 1.0 / SETTINGS.rate, 0.05  # s; of the bridge and of the camera
PULL = 0.5 * NEEDLE.chord * SETTINGS.thread_drag * 0.005  # N m; of a thread that is dragged sideways at 5 mm/s


def unit(angle: float) -> NDArray[np.float64]:
    """Return the unit vector in a direction [rad]."""
    return np.array([math.cos(angle), math.sin(angle)])


class TurningNeedle:
    """A needle in the dish's middle, turned by coils of other gains and a torque, and observed by late poses.

    c dtheta/dt = m n . B - T, integrated by Euler's method in steps of 0.5 ms.
    """

    def __init__(self, gains: NDArray[np.float64], *, age: float = 0.0, stamp_error: float = 0.0, seed: int = 0):
        self.observer = SETTINGS.heading_observer()
        self.gains, self.age, self.stamp_error = gains, age, stamp_error
        self.random, self.angle, self.now, self.middle = np.random.default_rng([seed, 2]), 0.0, 1.0, np.zeros(2)
        self.waiting: list[tuple[float, float, float]] = []  # poses: due, stamp and angle

    def run(self, currents: NDArray[np.float64], torque: float = 0.0, pull: float = 0.0) -> float:
        """Apply currents in turn, shape (k, m), each for a step; return the largest error of the heading [rad]."""
        worst, every = 0.0, round(FRAME / STEP)
        for k, current in enumerate(currents):
            if k % every == 0:
                seen = self.angle + NOISE * self.random.standard_normal()
                self.waiting.append((self.now + self.age, self.now + self.stamp_error, seen))
            while self.waiting and self.waiting[0][0] <= self.now + 1e-9:
                _, stamp, seen = self.waiting.pop(0)
                self.observer.update(unit(seen), stamp)
            estimate = self.observer.angle(self.now)
            if estimate is not None:
                worst = max(worst, abs(math.remainder(estimate - self.angle, math.tau)))
            heading = unit(self.angle if estimate is None else estimate)
            self.observer.apply(self.now, self.middle - 0.5 * NEEDLE.chord * heading, heading, current, pull)
            ends = [self.middle + side * 0.5 * NEEDLE.chord * unit(self.angle) for side in (-1.0, 1.0)]
            x, y = 0.5 * (COILS.per_current(ends[0]) + COILS.per_current(ends[1])) @ (self.gains * current)
            for _ in range(round(STEP / 5e-4)):
                across = y * math.cos(self.angle) - x * math.sin(self.angle)
                self.angle += 5e-4 * (NEEDLE.moment * across - torque) / NEEDLE.turning_drag
            self.now += STEP
        return worst


def turning_currents(seconds: float, seed: int, size: float = 4.0) -> NDArray[np.float64]:
    """Return the currents of a field that turns to and fro, and of coils against each other, shape (k, m) [A]."""
    random, time = np.random.default_rng([seed, 3]), np.arange(0.0, seconds, STEP)
    course = 1.5 * np.sin(1.3 * time + random.uniform(0.0, 6.0)) + 0.4 * np.sin(5.0 * time + random.uniform(0.0, 6.0))
    per_current = np.asarray(COILS.per_current(np.zeros(2)))
    wanted = SETTINGS.aligning_field * np.array([np.cos(course), np.sin(course)])
    currents = np.linalg.pinv(per_current) @ wanted
    against = np.linalg.svd(per_current)[2][2:]  # that give no field in the middle
    sizes = np.repeat(random.uniform(-size, size, (len(time) // 40 + 1, len(against))), 40, axis=0)[: len(time)]
    return np.asarray(currents.T + sizes @ against)


def random_gains(seed: int) -> NDArray[np.float64]:
    """Return gains that nobody chose, of mean 1."""
    gains = 1.0 + 0.05 * np.random.default_rng([seed, 1]).uniform(-1.0, 1.0, 4)
    return np.asarray(gains / gains.mean())


@pytest.mark.parametrize("seed", range(3))
def test_gains_are_found_but_for_a_common_factor(seed: int):
    gains = random_gains(seed)
    needle = TurningNeedle(1.2 * gains, seed=seed)
    needle.run(turning_currents(20.0, seed))
    assert np.abs(gains - 1.0).max() > 0.01
    np.testing.assert_allclose(needle.observer.gains, gains, atol=0.015)


@pytest.mark.parametrize("age", [0.02, 0.1, 0.25])
def test_a_heading_is_known_between_poses_however_late_they_are(age: float):
    """The needle turns by up to 4 rad/s: by 1 rad in the longest of these ages."""
    for seed in range(3):
        needle = TurningNeedle(random_gains(seed), age=age, seed=seed)
        needle.run(turning_currents(5.0, seed), PULL)
        assert needle.run(turning_currents(5.0, seed + 10), PULL) < 0.06


@pytest.mark.parametrize("error", [-0.05, 0.0, 0.03, 0.08])
def test_the_error_of_stamps_is_found_from_a_needle_that_turns(error: float):
    for seed in range(3):
        needle = TurningNeedle(random_gains(seed), age=0.1, stamp_error=error, seed=seed)
        needle.run(turning_currents(6.0, seed))
        assert needle.observer.stamp_error == pytest.approx(error, abs=0.012)


def test_a_pull_that_is_measured_turns_the_needle_as_a_force_at_its_tail():
    """It changes its side each 0.15 s, as in a needle that swings; three poses would not show its torque."""
    errors = []
    for known in (0.0, 1.0):
        needle, worst = TurningNeedle(np.ones(4)), 0.0
        for k in range(40):
            pull = 0.03 if k % 2 else -0.03
            torque = 0.5 * NEEDLE.chord * NEEDLE.drag_across * pull
            error = needle.run(turning_currents(0.15, 4), torque, known * pull)
            worst = max(worst, error) if k > 10 else 0.0
        errors.append(worst)
    assert errors[1] < 0.5 * errors[0]


def test_a_thread_that_turns_the_needle_is_not_taken_for_other_gains():
    needle = TurningNeedle(np.ones(4))
    needle.run(np.tile([2.0, 3.0, 2.0, 1.0], (2000, 1)), PULL)
    np.testing.assert_allclose(needle.observer.gains, 1.0, atol=0.05)


def test_a_needle_that_something_holds_across_the_field_says_nothing_of_the_gains():
    needle = TurningNeedle(np.ones(4))
    needle.run(turning_currents(5.0, 4))
    before = needle.observer.gains.copy()
    needle.run(turning_currents(0.5, 5, size=0.0), 40.0 * PULL)
    np.testing.assert_allclose(needle.observer.gains, before, atol=0.02)


def test_a_needle_that_something_holds_across_the_field_is_believed_to_lie_there():
    needle, currents = TurningNeedle(np.ones(4)), turning_currents(4.0, 4, size=0.0)
    needle.run(currents[:400])
    needle.run(currents[400:460], 25.0 * PULL)  # by 0.6 rad
    assert needle.run(currents[460:], 25.0 * PULL) < 0.15


def test_gains_are_bounded():
    needle = TurningNeedle(np.ones(4))
    for size in np.linspace(0.0, 3.0, 40):  # slowly, so that each measurement agrees with those before
        needle.gains = np.array([1.0 + size, 1.0, 1.0, 1.0])
        needle.run(turning_currents(0.5, round(1000 * size)))
    assert np.abs(needle.observer.gains - 1.0).max() <= MAX_CHANGE + 1e-12


def test_without_a_field_the_heading_is_the_measured_one_and_time_may_be_set_back():
    observer: HeadingObserver = SETTINGS.heading_observer()
    assert observer.angle(1.0) is None
    for stamp, angle in ((1.0, 0.3), (1.1, 2.9)):
        observer.rest(stamp)
        observer.update(unit(angle), stamp)
        assert observer.angle(stamp + 0.02) == pytest.approx(angle)
    assert observer.angle(0.5) is None


class LateLoop(ClosedLoop):
    """Poses arrive 50 to 120 ms after their frame, in order, as on a machine that hardly keeps up."""

    due = 0.0
    ages = np.random.default_rng(7)

    def _measure(self, frame: RigFrame) -> Measurement | None:
        measured = super()._measure(frame)
        if measured is not None:
            self.due = measured.due = max(self.due, self.now + self.ages.uniform(0.05, 0.12))
        return measured


def test_a_needle_behind_a_clamped_thread_follows_late_poses_and_is_not_stopped():
    """The thread turns the needle by 0.3 rad from the field. Taken for gains, that reverses the modelled force."""
    setup = read_setup("petri_35mm_polyamide")
    follower = setup.follower.follower()
    loop = LateLoop(
        setup,
        Rig(setup.rig, setup.scene),
        lambda stamp, tail, heading, thread: follower.compute_command(stamp, tail, heading, thread.age).velocity,
    )
    fastest = 0.0
    while loop.now < START + 6.0:
        frame = loop.step()
        fastest = max(fastest, math.hypot(*frame.commanded) if frame else 0.0)
    assert not loop.bridge.latch.latched_reason
    assert fastest < 0.015  # on a path of 5 mm/s


class BlindLoop(ClosedLoop):
    """No pose comes from a time on."""

    last = math.inf

    def _measure(self, frame: RigFrame) -> Measurement | None:
        return None if self.now >= self.last else super()._measure(frame)


def test_a_needle_that_is_turned_stops_turning_where_no_poses_come():
    """A crossing of a coil's axis is commanded by its rate, which would go on until the command is stale."""
    setup = read_setup("hernia_ring")
    loop = BlindLoop(setup, Rig(setup.rig, setup.scene), lambda *_: np.array([0.0, 0.0, 6.0]))
    loop.last = START + 1.0
    before, turned = math.nan, 0.0
    while loop.now < loop.last + 0.3:
        frame = loop.step()
        if frame is not None and frame.time < 1.0:
            before = frame.heading
        elif frame is not None:
            turned = max(turned, abs(math.remainder(frame.heading - before, math.tau)))
    assert 0.2 < turned < 0.35 + 6.0 * 0.05 + 0.1  # and until the last pose, and by the thread


class ShiftedLoop(ClosedLoop):
    """Stamps are wrong by a shift until a time, and right from then on."""

    shift, until = 0.0, math.inf

    def _measure(self, frame: RigFrame) -> Measurement | None:
        measured = super()._measure(frame)
        if measured is not None and self.now < self.until:
            measured.stamp, measured.due = measured.stamp + self.shift, measured.due + max(0.0, self.shift)
        return measured


@pytest.mark.parametrize("shift", [-0.08, 0.08])
@pytest.mark.parametrize("rate", [2.0, 4.0])
def test_wrong_stamps_are_found_out_without_a_pose_that_is_refused_and_may_become_right(rate: float, shift: float):
    """At rest, as where a camera starts anew. A stamp that is corrected is no other one to those who judge its age."""
    setup = read_setup("dish_50mm")

    def turned(stamp: float, *_: object) -> NDArray[np.float64]:
        return np.array([0.0, 0.0, rate * math.copysign(1.0, math.sin(rate * stamp))]) * (not 4.0 < stamp - START < 5.0)

    loop = ShiftedLoop(setup, Rig(setup.rig, setup.scene), turned)
    loop.shift, loop.until = shift, START + 4.5
    refused = 0
    while loop.now < START + 8.0:
        loop.step()
        refused += bool(loop.bridge.extrapolator.rejections)
        if loop.now < START + 4.0:
            found = loop.bridge._heading.stamp_error
    assert not loop.bridge.latch.latched_reason
    assert refused == 0
    assert found == pytest.approx(shift, abs=0.03)
    assert loop._reason == ""
