"""Where the needle is now."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.coils.needle import NeedleWatch
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.errors import InvalidInputError

NEEDLE = CoilBridgeSettings().needle()
EAST = np.array([1.0, 0.0])


def watch() -> NeedleWatch:
    """Return a watch that has seen a needle at time 1."""
    made = NeedleWatch(NEEDLE, 0.2, 0.045)
    made.see(np.zeros(2), EAST, 1.0, 1, 1.0, 50.0)
    return made


def test_without_a_pose_there_is_none():
    assert NeedleWatch(NEEDLE, 0.2, 0.045).pose(1.0, 50.0) is None


def test_a_pose_ends_by_the_monotonic_clock_whatever_the_other_says():
    assert watch().pose(1.0, 50.19) is not None
    assert watch().pose(1.0, 50.21) is None


def test_a_pose_is_carried_along_the_needle():
    seen = watch()
    seen.move(np.array([0.005, 0.0]), 1.0)
    pose = seen.pose(1.04, 50.04)
    assert pose is not None
    np.testing.assert_allclose(pose.tail, [0.0002, 0.0], atol=1e-12)
    np.testing.assert_allclose(pose.heading, EAST)


def test_a_velocity_across_turns_the_needle_about_its_middle():
    seen = watch()
    seen.move(np.array([0.0, 0.0035]), 1.0)  # one length in two seconds: 1 rad/s
    pose = seen.pose(1.05, 50.05)
    assert pose is not None
    np.testing.assert_allclose(pose.heading, [np.cos(0.05), np.sin(0.05)])
    middle = pose.tail + 0.0035 * pose.heading
    np.testing.assert_allclose(middle, [0.0035, 0.0], atol=1e-12)


def test_a_late_pose_is_carried_by_all_that_the_coils_gave_since_its_stamp():
    seen = NeedleWatch(NEEDLE, 0.3, 0.045)
    seen.move(np.array([0.02, 0.0]), 1.0)
    seen.move(np.array([0.01, 0.0]), 1.1)
    seen.move(np.zeros(2), 1.15)
    seen.see(np.zeros(2), EAST, 1.05, 1, 1.17, 50.0)
    pose = seen.pose(1.2, 50.03)
    assert pose is not None
    np.testing.assert_allclose(pose.tail, [0.02 * 0.05 + 0.01 * 0.05, 0.0], atol=1e-12)


def test_where_time_is_set_back_a_pose_is_carried_from_there():
    seen = NeedleWatch(NEEDLE, 0.3, 0.045)
    seen.move(np.array([0.02, 0.0]), 100.0)
    seen.move(np.array([0.01, 0.0]), 1.0)
    seen.see(np.zeros(2), EAST, 1.05, 1, 1.1, 50.0)
    pose = seen.pose(1.15, 50.05)
    assert pose is not None
    np.testing.assert_allclose(pose.tail, [0.001, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("tail", "heading", "stamp", "words"),
    [
        (np.array([np.nan, 0.0]), EAST, 1.0, "finite numbers"),
        (np.zeros(2), np.array([np.inf, 0.0]), 1.0, "finite numbers"),
        (np.zeros(2), EAST, 0.5, "0.500 s old"),
        (np.zeros(2), EAST, 1.5, "0.500 s ahead"),
        (np.zeros(2), EAST, 0.0, "0 is none in ROS"),
        (np.zeros(2), EAST, 0.95, "no earlier than the last one's"),
        (np.array([1e200, 0.0]), EAST, 1.0, "within 0.045 m"),
        (np.array([0.05, 0.025]), EAST, 1.0, "within 0.045 m"),
        (np.array([0.043, 0.0]), EAST, 1.0, "within 0.045 m"),
    ],
)
def test_a_bad_pose_is_refused_and_the_last_stays(tail, heading, stamp, words):
    seen = watch()
    with pytest.raises(InvalidInputError, match=words):
        seen.see(tail, heading, stamp, 2, 1.0, 50.0)
    pose = seen.pose(1.0, 50.1)
    assert pose is not None
    np.testing.assert_allclose(pose.tail, [0.0, 0.0])


def test_a_pose_ends_by_its_stamp_too_and_says_why():
    seen = watch()
    assert seen.lost(1.19, 50.0) == ""
    assert seen.lost(1.21, 50.0) == "no needle pose for 0.2 s"
    assert seen.lost(1.0, 50.21) == "no needle pose for 0.2 s"
    assert NeedleWatch(NEEDLE, 0.2, 0.045).lost(1.0, 50.0) == "no needle pose yet"


def test_two_that_say_where_the_needle_is_are_one_too_many():
    seen = watch()
    with pytest.raises(InvalidInputError, match="2 publishers at once"):
        seen.see(np.array([0.01, 0.0]), EAST, 1.0, 7777, 1.0, 50.01)
    assert seen.lost(1.0, 50.02) == "several publishers of needle/measured_cp at once"
    assert seen.pose(1.0, 50.02) is None
