"""The gain of each coil, estimated from the direction in which the needle lies."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from magnetosuture_thread.coils.allocation import MAX_CHANGE, CoilGainEstimator
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.rig.closed_loop import START, ClosedLoop, Measurement
from magnetosuture_thread.rig.rig import Rig, RigFrame
from magnetosuture_thread.rig.setups import read_setup

SETTINGS = CoilBridgeSettings(motion_compensation=True, thread_drag=0.0093)
COILS, NEEDLE = SETTINGS.coil_field(), SETTINGS.needle()
NOISE = 5e-3  # rad; of a tracked heading
FRAME = 1.0  # s; in which a needle turns to a field far from the one before
PULL = 0.5 * NEEDLE.chord * SETTINGS.thread_drag * 0.005  # N m; of a thread that is dragged sideways at 5 mm/s


def place(
    estimator: CoilGainEstimator,
    gains: NDArray[np.float64],
    currents: NDArray[np.float64],
    torque: float = 0.0,
    seed: int = 0,
) -> None:
    """Apply currents in turn, shape (k, m), and measure the needle where field, liquid and a torque balance."""
    random, angle = np.random.default_rng([seed, 2]), 0.0
    for k, current in enumerate(currents):
        middle, before = random.uniform(-0.005, 0.005, 2), angle
        for _ in range(100):
            chord = 0.5 * NEEDLE.chord * np.array([math.cos(angle), math.sin(angle)])
            x, y = 0.5 * (COILS.per_current(middle - chord) + COILS.per_current(middle + chord)) @ (gains * current)
            balanced = NEEDLE.turning_drag * math.remainder(angle - before, math.tau) / FRAME + torque
            lead = math.asin(max(-0.9, min(0.9, balanced / (NEEDLE.moment * math.hypot(x, y)))))
            angle += 0.5 * math.remainder(math.atan2(y, x) - lead - angle, math.tau)
        seen = angle + NOISE * random.standard_normal()
        heading = np.array([math.cos(seen), math.sin(seen)])
        estimator.apply(1.0 + FRAME * (k - 1), current)
        estimator.update(middle - 0.5 * NEEDLE.chord * heading, heading, 1.0 + FRAME * k)


def random_currents(count: int, seed: int) -> NDArray[np.float64]:
    """Return currents that nobody chose, shape (count, m) [A]."""
    return np.random.default_rng(seed).uniform(-4.0, 4.0, (count, len(COILS.names)))


@pytest.mark.parametrize("seed", range(3))
def test_gains_are_found_but_for_a_common_factor(seed: int):
    gains = 1.0 + 0.05 * np.random.default_rng([seed, 1]).uniform(-1.0, 1.0, 4)
    estimator = SETTINGS.gain_estimator()
    place(estimator, gains, random_currents(200, seed), seed=seed)
    assert np.abs(gains / gains.mean() - 1.0).max() > 0.01
    np.testing.assert_allclose(estimator.gains / estimator.gains.mean(), gains / gains.mean(), atol=0.015)


def test_a_thread_that_turns_the_needle_is_not_taken_for_other_gains():
    estimator = SETTINGS.gain_estimator()
    place(estimator, np.ones(4), np.tile([2.0, 3.0, 2.0, 1.0], (200, 1)), PULL)
    np.testing.assert_allclose(estimator.gains, 1.0, atol=0.05)


def test_a_needle_that_something_holds_across_the_field_says_nothing_of_the_gains():
    estimator = SETTINGS.gain_estimator()
    place(estimator, np.ones(4), random_currents(100, 4))
    before = estimator.gains.copy()
    place(estimator, np.ones(4), random_currents(10, 5), 40.0 * PULL)
    np.testing.assert_allclose(estimator.gains, before, atol=0.02)


def test_gains_are_bounded():
    estimator = SETTINGS.gain_estimator()
    for size in np.linspace(0.0, 3.0, 100):  # slowly, so that each measurement agrees with those before
        place(estimator, np.array([1.0 + size, 1.0, 1.0, 1.0]), random_currents(3, round(1000 * size)))
    assert np.abs(estimator.gains - 1.0).max() <= MAX_CHANGE + 1e-12


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
        lambda stamp, tail, heading, _: follower.compute_command(stamp, tail, heading).velocity,
    )
    fastest = 0.0
    while loop.now < START + 6.0:
        frame = loop.step()
        fastest = max(fastest, math.hypot(*frame.commanded) if frame else 0.0)
    assert not loop.bridge.latch.latched_reason
    assert fastest < 0.015  # on a path of 5 mm/s
