"""The needle's motion by noisy poses, and the forces that follow from it."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest

from magnetosuture_thread import NeedlePose, ThreadPredictor
from magnetosuture_thread.model.needle_motion import (
    ACCELERATION,
    MAX_INTERVAL,
    MAX_SPEED,
    MAX_TURNING,
    TURNING,
    NeedleMotionFilter,
    filter_pose,
)
from magnetosuture_thread.model.prediction import NeedleMotion
from magnetosuture_thread.model.session import ThreadSession
from magnetosuture_thread.model.settings import ThreadModelSettings

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


def test_a_needle_that_stops_is_followed_at_once():
    random, motion = np.random.default_rng(4), NeedleMotionFilter()
    for k in range(240):
        pose = motion.update(measured(replace(on_circle(min(k, 120) / RATE), stamp=k / RATE), random))
        if k == 130:
            assert pose.motion is not None
            assert np.linalg.norm(pose.motion.velocity) < 0.2 * SPEED


def test_poses_whose_deviation_is_not_known_are_as_they_were():
    motion = NeedleMotionFilter()
    for k in range(5):
        pose = on_circle(k / RATE)
        assert motion.update(pose) is pose
    random = np.random.default_rng(9)
    for k in range(5, 20):
        motion.update(measured(on_circle(k / RATE), random))
    assert motion.update(on_circle(20 / RATE)).motion is None  # and ends what was known
    pose = measured(on_circle(21 / RATE), random)
    assert motion.update(pose) is pose


def test_after_a_change_of_mind_nothing_of_the_velocity_is_known():
    """Whatever was known of it, and however well: the covariance is that of a needle that was only just there."""
    state, measured_at = np.array([0.0, 0.0, 0.3, 4e-3, 0.0, 0.5]), np.array([0.0, 3e-4, 0.3])
    sizes, found = np.array([1e-5, 1e-5, 5e-3, 1e-4, 1e-4, 1e-2]), []
    root = sizes[:, None] * np.random.default_rng(10).normal(size=(6, 6))
    unknown = np.diag([0.0, 0.0, 0.0, MAX_SPEED**2, MAX_SPEED**2, MAX_TURNING**2])
    unknown[:3, :3] = (root @ root.T)[:3, :3]
    for covariance in (root @ root.T, unknown):
        moved = state.copy()
        filter_pose(moved, covariance, measured_at, 1.0 / RATE, PLACE**2, ANGLE**2)
        found.append(np.concatenate([moved, covariance.ravel()]))
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9, atol=1e-18)


def test_after_a_gap_or_out_of_order_a_pose_stays_as_it_was():
    random, motion = np.random.default_rng(5), NeedleMotionFilter()
    for k in range(20):
        motion.update(measured(on_circle(k / RATE), random))
    late = measured(on_circle(10 / RATE), random)
    assert motion.update(late) is late
    after = motion.update(measured(on_circle(20 / RATE), random))
    assert after.motion is not None
    far = measured(on_circle(20 / RATE + 1.01 * MAX_INTERVAL), random)
    assert motion.update(far) is far


def test_a_heading_that_passes_pi_is_no_turn():
    random, motion, turnings = np.random.default_rng(6), NeedleMotionFilter(), []
    for k in range(round(2.0 * math.pi * RADIUS / SPEED * RATE)):
        pose = motion.update(measured(on_circle(k / RATE), random))
        turnings.append(pose.motion.turning if pose.motion is not None else 0.0)
    assert np.abs(turnings[60:]).max() < 1.5


def after_arc(state: np.ndarray, interval: float) -> np.ndarray:
    """Return a state after a motion that is constant as the needle has it: an arc of a circle, exactly."""
    x, y, angle, along, across, turning = state.tolist()
    half = 0.5 * turning * interval
    way = complex(along, across) * interval * math.sin(half) / half * cmath.exp(1j * (angle + half))
    return np.array([x + way.real, y + way.imag, angle + 2.0 * half, along, across, turning])


def slope_of_arc(state: np.ndarray, interval: float) -> np.ndarray:
    """Return the derivative of the state after an arc by the state, by differences."""
    steps = np.diag([1e-9, 1e-9, 1e-5, 1e-7, 1e-7, 1e-4])
    columns = [(after_arc(state + step, interval) - after_arc(state - step, interval)) / step.max() for step in steps]
    return 0.5 * np.column_stack(columns)


def test_pose_and_covariance_are_predicted_along_an_arc():
    """A pose that says nothing leaves the prediction: F P F' + Q, with F by differences of the exact arc."""
    state, interval = np.array([1e-3, -2e-3, 1.3, 0.03, -0.02, 0.5]), 0.02
    sizes = np.array([1e-5, 1e-5, 5e-2, 1e-3, 1e-3, 5.0])
    root = sizes[:, None] * np.random.default_rng(8).normal(size=(6, 6))
    slope, white = slope_of_arc(state, interval), np.diag([0.0, 0.0, 0.0, ACCELERATION**2, ACCELERATION**2, TURNING**2])
    expected = slope @ root @ root.T @ slope.T
    for time in (np.arange(20) + 0.5) / 20 * interval:  # noise that has entered this long ago
        expected += interval / 20 * slope_of_arc(state, float(time)) @ white @ slope_of_arc(state, float(time)).T
    predicted, covariance = state.copy(), root @ root.T
    filter_pose(predicted, covariance, np.zeros(3), interval, 1e9, 1e9)
    np.testing.assert_allclose(predicted, after_arc(state, interval), rtol=1e-3)
    own = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(covariance / np.outer(own, own), expected / np.outer(own, own), atol=5e-3)
    covariance[:] = 0.0
    filter_pose(state, covariance, np.zeros(3), interval, 1e9, 1e9)
    np.testing.assert_allclose(covariance[3:, 3:], interval * white[3:, 3:], atol=1e-15)
    assert covariance[2, 5] == pytest.approx(0.5 * interval**2 * TURNING**2)


def test_the_velocity_is_that_in_the_dish_whichever_way_the_needle_heads():
    motion, velocity, heading = NeedleMotionFilter(), np.array([2e-3, -1e-3]), np.array([math.cos(2.1), math.sin(2.1)])
    for k in range(60):
        pose = motion.update(NeedlePose(k / RATE, velocity * k / RATE, heading, (1e-6, 1e-3)))
    assert pose.motion is not None
    assert pose.motion.velocity == pytest.approx(velocity, rel=1e-3)
    assert pose.motion.turning == pytest.approx(0.0, abs=1e-6)


def test_forces_are_those_of_the_given_motion():
    """A thread dragged along itself at one speed by the poses and at another by the motion."""
    predictor = ThreadPredictor.create("silk_6_0", length=0.019, segments=25)
    predictor.start(eastward(0.0, 0.0))
    plain = ThreadPredictor.create("silk_6_0", length=0.019, segments=25)
    plain.start(eastward(0.0, 0.0))
    motion, kept = NeedleMotion(np.array([3e-3, 0.0]), 0.0), []
    for k in range(1, 30):
        pose = eastward(k / RATE, 2e-3 * k / RATE)
        prediction, other = predictor.step(replace(pose, motion=motion)), plain.step(pose)
        np.testing.assert_array_equal(prediction.positions, other.positions)
        kept.append(prediction)
    drag = predictor.thread.medium.drag_along * predictor.thread.length
    for prediction in (kept[-1], kept[5]):  # later steps change nothing about an earlier one
        assert prediction.forces is not None
        # The rest is the compliance of the segments, which a higher tension strains by micrometres.
        assert prediction.forces.needle_force == pytest.approx([-3e-3 * drag, 0.0], rel=0.01, abs=1e-12)
    onward = replace(pose, stamp=1.0)
    np.testing.assert_array_equal(predictor.step(onward).positions, plain.step(onward).positions)


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
