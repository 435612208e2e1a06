"""The session's estimate: where it comes from, late and bad observations, other settings and scenes while it runs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.estimator.estimator import ThreadEstimate
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.estimator.thread_session import PredictionResult, ThreadSession
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.thread_observation import ThreadObservation
from magnetosuture_thread.settings.configuration import from_mapping
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.thread.prediction import NeedlePose
from test.estimator.threads import LENGTH, error_percent, piece_of, poses, thread_of, true_shapes, whole
from test.shared import known
from test.thread.worlds import scene_with

WAY = poses(45)
NODES = true_shapes(thread_of(viscosity=2.0), WAY)  # the session is told of a liquid half as viscous


def made(**values: Any) -> ThreadModelSettings:
    return from_mapping(ThreadModelSettings, {"material": "silk_6_0", **values})


def stamp_of(pose: NeedlePose) -> int:
    return round(pose.stamp * 1e9)


def at(pose: NeedlePose) -> NeedlePose:
    """Return the pose with the stamp that a message of it has."""
    return replace(pose, stamp=stamp_of(pose) * 1e-9)


def show(session: ThreadSession, k: int) -> list[PredictionResult]:
    """Return what comes of an observation of a frame."""
    return [*session.on_observation(stamp_of(WAY[k]), whole(NODES[k], k)), *session.late_estimates()]


def follow(session: ThreadSession, first: int = 0, last: int = len(WAY)) -> list[PredictionResult]:
    """Return what comes of frames whose observations come before their poses."""
    results = []
    for k in range(first, last):
        results += show(session, k)
        results.append(session.on_pose(stamp_of(WAY[k]), at(WAY[k])))
    return results


def estimated(result: PredictionResult) -> ThreadEstimate:
    assert result.estimate_problem is None
    return known(result.estimate)


def test_every_frame_has_an_estimate_beside_the_prediction_of_the_model_alone():
    session, alone = ThreadSession(made(), None), ThreadSession(made(estimator=False), None)
    results, others = follow(session), follow(alone)
    assert len(results) == len(WAY)
    assert [result.estimate for result in others] == [None] * len(WAY)
    for result, other in zip(results, others, strict=True):
        prediction = known(result.prediction)
        np.testing.assert_array_equal(prediction.positions, known(other.prediction).positions)
        assert estimated(result).stamp == prediction.stamp
    last = estimated(results[-1])
    assert error_percent(prediction.positions, NODES[-1]) > 2.0 * error_percent(last.positions, NODES[-1])
    np.testing.assert_array_equal(known(results[-1].margins)["wall"].clearance, last.margins["wall"].clearance)


@pytest.mark.parametrize("values", [{"formulation": "paper"}, {"medium": "air"}])
def test_other_threads_are_predicted_only(values: dict[str, Any]):
    session = ThreadSession(made(**values), None)
    assert not session.needs_measured_thread(0) or session.settings.initial_shape == "measured"
    results = follow(session, 0, 5)
    assert [result.estimate for result in results] == [None] * 5
    assert all(result.prediction is not None for result in results)


def test_a_part_of_the_thread_is_estimated_before_the_prediction_starts():
    session = ThreadSession(made(), None)
    for k in range(10):
        part = ThreadObservation((piece_of(NODES[k], k, 0.0, 0.5 * LENGTH),), False)
        list(session.on_observation(stamp_of(WAY[k]), part))
        result = session.on_pose(stamp_of(WAY[k]), at(WAY[k]))
        assert result.waiting
        assert estimated(result).hidden == pytest.approx(0.5, abs=0.1)


def test_late_observations_take_the_place_of_the_estimates_there_were():
    in_time, late = ThreadSession(made(), None), ThreadSession(made(), None)
    expected = follow(in_time)
    found: dict[int, ThreadEstimate] = {}
    for k in range(len(WAY) + 6):
        if k < len(WAY):
            result = late.on_pose(stamp_of(WAY[k]), at(WAY[k]))
            assert not result.late
        if k >= 6:
            given = stamp_of(WAY[k - 6])
            results = [each for each in show(late, k - 6) if each.late]
            assert results[0].stamp == given
            found |= {each.stamp: estimated(each) for each in results}
    np.testing.assert_allclose(results[-1].speeds, expected[-1].speeds, rtol=0.05)
    for each in expected:
        np.testing.assert_array_equal(found[each.stamp].positions, estimated(each).positions)
        np.testing.assert_array_equal(found[each.stamp].covariance, estimated(each).covariance)


def test_observations_that_cannot_be_used_leave_the_estimate_with_a_reason():
    session = ThreadSession(made(), None)
    follow(session, 0, 20)
    last = stamp_of(WAY[19])
    for stamp in (last, last - 60_000_000_000):  # doubled, of long ago
        assert not list(session.on_observation(stamp, whole(NODES[19], 19)))
        (refused,) = session.late_estimates()
        assert isinstance(refused.estimate_problem, InvalidInputError)
        assert (refused.late, refused.waiting, refused.margins) == (True, False, None)
    assert not list(session.on_observation(last + 60_000_000_000, whole(NODES[19], 19)))
    assert not session.late_estimates()  # poses may have come to a stop; the next one says that they have not
    future = session.on_pose(last + 1_000_000, replace(WAY[19], stamp=(last + 1_000_000) * 1e-9))
    assert isinstance(future.estimate_problem, InvalidInputError)
    assert future.estimate is not None


@pytest.mark.parametrize("values", [{"segments": 40, "viscosity": 1.1}, {"thread_length": 0.0191}])
def test_other_settings_keep_the_estimate(values: dict[str, Any]):
    session = ThreadSession(made(), None)
    before = estimated(follow(session, 0, 30)[-1])
    session.change(made(**values), None)
    result = session.on_pose(stamp_of(WAY[30]), at(WAY[30]))  # a frame that shows nothing of the thread
    estimate = estimated(result)
    assert estimate.unmeasured_for == pytest.approx(1 / 30.0)
    assert len(estimate.positions) == session.settings.segments + 1
    assert np.linalg.norm(estimate.positions[-1] - NODES[30, -1]) < 1.5e-4
    np.testing.assert_allclose(estimate.noise, before.noise)
    assert float(estimate.deviation[-1]) < 1e-4
    # What is late then is refused, and what comes later is taken.
    (late,) = show(session, 28)
    assert late.estimate_problem is not None
    # The longer thread is 0.5 % longer.
    assert error_percent(estimated(follow(session, 31, 45)[-1]).positions[-1:], NODES[-1, -1:]) < 0.8


def test_a_scene_that_appears_pushes_the_estimate_out():
    session = ThreadSession(made(), None)
    estimate = estimated(follow(session, 0, 30)[-1])
    post = Disc(tuple(estimate.positions[12] + np.array([0.0, 4e-4])), 6e-4)
    scene = scene_with(post)
    session.change(session.settings, scene)
    result = session.on_pose(stamp_of(WAY[30]), at(WAY[30]))
    margins = known(result.margins)
    assert margins.scene_version == scene.version
    assert margins["obstacle"].minimum > -1e-6
