"""The needle's motion by noisy poses, and the forces that follow from it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from magnetosuture_thread import NeedlePose
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.estimator.thread_session import NeedleMotionFilter, ThreadSession

RATE = 60.0
PLACE, ANGLE = 1e-5, 5e-3  # m and rad; deviations of a tracked needle
SPEED, RADIUS = 4e-3, 6e-3  # m/s and m; of a needle on a circle


def eastward(stamp: float, x: float) -> NeedlePose:
    """Return the exact pose of a needle that heads east on the x axis."""
    return NeedlePose(stamp, np.array([x, 0.0]), np.array([1.0, 0.0]))


def on_circle(time: float) -> NeedlePose:
    """Return the exact pose of a needle that goes round."""
    turn = SPEED * time / RADIUS
    tail = RADIUS * np.array([math.sin(turn), 1.0 - math.cos(turn)])
    return NeedlePose(time, tail, np.array([math.cos(turn), math.sin(turn)]))


def measured(pose: NeedlePose, random: np.random.Generator) -> NeedlePose:
    """Return a pose with a tracker's noise."""
    angle = math.atan2(pose.heading[1], pose.heading[0]) + ANGLE * random.standard_normal()
    tail = pose.tail + PLACE * random.standard_normal(2)
    return NeedlePose(pose.stamp, tail, np.array([math.cos(angle), math.sin(angle)]), (PLACE, ANGLE))


@pytest.mark.parametrize("seed", range(3))
def test_velocity_and_pose_of_a_needle_on_a_circle(seed: int):
    random, motion, filtered = np.random.default_rng(seed), NeedleMotionFilter(), []
    for k in range(600):
        filtered.append(motion.update(measured(on_circle(k / RATE), random)))
    errors, shifts, turnings = [], [], []
    for pose in filtered[60:]:
        exact = on_circle(pose.stamp)
        assert pose.motion is not None
        errors.append((pose.motion.velocity - SPEED * exact.heading) / pose.deviation[0])
        shifts.append((pose.tail - exact.tail) / pose.deviation[0])
        turnings.append(pose.motion.turning)
    # As good as its own covariance says, and better than a difference of poses, of 0.85 mm/s.
    assert 0.7 < np.sqrt(np.mean(np.square(shifts))) < 1.3
    assert filtered[-1].deviation[0] < 0.8 * PLACE
    assert np.sqrt(np.mean(np.square(errors))) * filtered[-1].deviation[0] < 0.25e-3
    assert np.mean(turnings) == pytest.approx(SPEED / RADIUS, rel=0.03)


def test_the_pull_of_a_session_is_that_of_the_needle_and_not_of_noise():
    """Of a thread drawn along itself: 22 % of the peak by differences of poses, in closed loop."""
    random, settings = np.random.default_rng(7), ThreadModelSettings(initial_shape="straight", estimator=False)
    session, pulls = ThreadSession(settings, None), []
    for k in range(300):
        exact = eastward(k / RATE, SPEED * k / RATE)
        result = session.on_pose(round(1e9 * k / RATE), measured(exact, random))
        assert result.prediction is not None
        if k > 60:
            assert result.prediction.forces is not None
            pulls.append(result.prediction.forces.needle_force)
    drag = session.thread.medium.drag_along * session.thread.length * SPEED
    off = np.linalg.norm(np.array(pulls) + np.array([drag, 0.0]), axis=1) / drag
    assert np.sqrt(np.mean(off**2)) < 0.06
