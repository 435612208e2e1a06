"""Extrapolation and plausibility of needle poses."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest

from magnetosuture_thread.coils.inputs import PoseExtrapolator
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.settings.errors import InvalidInputError

NEEDLE = CoilBridgeSettings().needle().kinematics
EAST = np.array([1.0, 0.0])


def extrapolator_at_origin() -> PoseExtrapolator:
    """Return an extrapolator with a pose at time 1."""
    made = PoseExtrapolator(NEEDLE, 0.2, 0.045)
    made.update(np.zeros(2), EAST, 1.0, 1, 1.0, 50.0)
    return made


def test_a_late_pose_is_carried_by_all_that_the_coils_gave_since_its_stamp():
    extrapolator = extrapolator_at_origin()
    extrapolator.apply_velocity(np.array([0.02, 0.0]), 1.0, 48.95 + 1.0)
    extrapolator.apply_velocity(np.array([0.01, 0.0]), 1.1, 48.95 + 1.1)
    extrapolator.apply_velocity(np.zeros(2), 1.15, 48.95 + 1.15)
    extrapolator.update(np.zeros(2), EAST, 1.05, 2, 1.17, 50.0)
    pose = extrapolator.pose(1.2, 50.03)
    assert pose is not None
    np.testing.assert_allclose(pose.tail, [0.02 * 0.05 + 0.01 * 0.05, 0.0], atol=1e-12)


def stalled() -> PoseExtrapolator:
    """Return a watch of a needle that moves at time 1, when the coils hold for 0.1 s and stop by 0.2 s."""
    extrapolator = PoseExtrapolator(NEEDLE, 1.0, 0.045, min_hold=0.1, max_hold=0.2)
    extrapolator.update(np.zeros(2), EAST, 1.0, 1, 1.0, 50.0)
    extrapolator.apply_velocity(np.array([0.01, 0.0]), 1.0, 50.0)
    return extrapolator


def test_after_a_longer_stall_only_a_pose_from_after_the_coils_stopped_counts():
    extrapolator = stalled()
    assert extrapolator.pose(1.3, 50.3) is None
    assert extrapolator.stale_reason(1.3, 50.3) == "no needle pose since the loop stalled"
    with pytest.raises(InvalidInputError, match="stall of the loop"):
        extrapolator.update(np.array([0.001, 0.0]), EAST, 1.15, 2, 1.3, 50.3)
    assert extrapolator.pose(1.3, 50.3) is None
    extrapolator.update(np.array([0.0015, 0.0]), EAST, 1.21, 3, 1.31, 50.31)
    pose = extrapolator.pose(1.4, 50.4)
    assert pose is not None
    np.testing.assert_allclose(pose.tail, [0.0015, 0.0], atol=1e-12)  # it rests since


def doubter() -> PoseExtrapolator:
    """Return a watch that knows a dish of 35 mm and a needle of at most 20 mm/s, extrapolator at time 1."""
    extrapolator = PoseExtrapolator(NEEDLE, 0.2, 0.045, max_speed=0.02, uncertainty=0.0005)
    extrapolator.dish_radius = 0.0175
    extrapolator.update(np.zeros(2), EAST, 1.0, 1, 1.0, 50.0)
    return extrapolator


def show(extrapolator: PoseExtrapolator, tails: list[list[float]], since: float = 1.0) -> list[bool]:
    """Show a pose every 20 ms; return which were believed."""
    believed = []
    for k, tail in enumerate(tails):
        at = since + 0.02 * (k + 1)
        try:
            extrapolator.update(np.array(tail), EAST, at, round(50 * at), at, at + 49.0)
            believed.append(True)
        except InvalidInputError:
            believed.append(False)
    return believed


@pytest.mark.parametrize(
    ("tail", "words"),
    [
        ([0.0112, 0.0], "its tip is 0.0182 m from the dish's centre, within 0.018 m"),
        ([-0.0182, 0.0], "its tail is 0.0182 m"),
        ([0.0, 0.003], "its tail jumped by 0.003 m in 0.02 s, at most 0.0009 m"),
        ([1e200, 0.0], "from the dish's centre"),
    ],
)
def test_a_pose_that_cannot_be_is_not_believed_and_the_needle_rests(tail: list[float], words: str):
    extrapolator = doubter()
    with pytest.raises(InvalidInputError, match="needle/measured_cp"):
        extrapolator.update(np.array(tail), EAST, 1.02, 2, 1.02, 50.02)
    assert words in extrapolator.stale_reason(1.02, 50.02)
    assert extrapolator.pose(1.02, 50.02) is None


def test_a_tracker_that_says_how_uncertain_it_is_may_be_off_by_three_sigma():
    for sigma, believed in ((1e-3, True), (1e-4, False)):
        extrapolator, covariance = doubter(), np.diag([sigma**2, 0.0, 0.0])
        with nullcontext() if believed else pytest.raises(InvalidInputError, match="jumped"):
            extrapolator.update(np.array([0.0025, 0.0]), EAST, 1.02, 2, 1.02, 50.02, covariance)


def test_poses_are_believed_again_when_five_in_a_row_agree():
    extrapolator = doubter()
    assert show(extrapolator, [[0.004, 0.0]] * 6) == [False] * 4 + [True] * 2
    assert extrapolator.pose(1.12, 50.12) is not None


def test_after_one_outlier_the_needle_goes_on_by_itself():
    extrapolator = doubter()
    believed = show(extrapolator, [[0.0, 0.0], [0.0, 0.006], *[[0.0, 0.0]] * 6])
    assert believed == [True, False, *[True] * 6]
    assert extrapolator.stale_reason(1.16, 50.16) == ""


@pytest.mark.parametrize(
    ("tail", "heading", "stamp", "words"),
    [
        (np.array([np.nan, 0.0]), EAST, 1.0, "finite numbers"),
        (np.zeros(2), np.array([np.inf, 0.0]), 1.0, "finite numbers"),
        (np.zeros(2), EAST, 0.5, "0.500 s old"),
        (np.zeros(2), EAST, 1.5, "0.500 s ahead"),
        (np.zeros(2), EAST, 0.0, "0 is none in ROS"),
        (np.zeros(2), EAST, 0.95, "no earlier than the last one's"),
    ],
)
def test_a_bad_pose_is_refused_and_the_last_stays(tail, heading, stamp, words):
    extrapolator = extrapolator_at_origin()
    with pytest.raises(InvalidInputError, match=words):
        extrapolator.update(tail, heading, stamp, 2, 1.0, 50.0)
    pose = extrapolator.pose(1.0, 50.1)
    assert pose is not None
    np.testing.assert_allclose(pose.tail, [0.0, 0.0])


def test_a_pose_ends_by_its_stamp_too_and_says_why():
    extrapolator = extrapolator_at_origin()
    assert extrapolator.stale_reason(1.19, 50.0) == ""
    assert extrapolator.stale_reason(1.21, 50.0) == "no needle pose for 0.2 s"
    assert extrapolator.stale_reason(1.0, 50.21) == "no needle pose for 0.2 s"
    assert PoseExtrapolator(NEEDLE, 0.2, 0.045).stale_reason(1.0, 50.0) == "no needle pose yet"


def test_two_that_say_where_the_needle_is_are_one_too_many():
    extrapolator = extrapolator_at_origin()
    with pytest.raises(InvalidInputError, match="2 publishers at once"):
        extrapolator.update(np.array([0.01, 0.0]), EAST, 1.0, 7777, 1.0, 50.01)
    assert extrapolator.stale_reason(1.0, 50.02) == "several publishers of needle/measured_cp at once"
    assert extrapolator.pose(1.0, 50.02) is None


@pytest.mark.parametrize(
    ("variances", "jump", "believed"),
    [
        ([0.0, 1e-6, 0.0], 0.0025, True),
        ([1.0, 0.0, 0.0], 0.0028, True),
        ([1.0, 0.0, 0.0], 0.003, False),
        ([np.inf, 0.0, 0.0], 0.0025, False),
    ],
)
def test_no_uncertainty_excuses_more_than_2_mm_and_an_infinite_one_says_nothing(
    variances: list[float], jump: float, believed: bool
):
    with nullcontext() if believed else pytest.raises(InvalidInputError, match="jumped"):
        doubter().update(np.array([0.0, jump]), EAST, 1.02, 2, 1.02, 50.02, np.diag(variances))
