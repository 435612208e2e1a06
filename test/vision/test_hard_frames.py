"""Needle and thread in frames of the benchmark's hard classes, other ones than it draws by default."""

from __future__ import annotations

import re
from functools import cache

import cv2
import numpy as np
import pytest

from benchmarks.vision.frames import DISH_RADIUS
from benchmarks.vision.measurements import Row, frame_of, measure, row_of
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.scene.scene import Dish
from magnetosuture_thread.vision.look import State
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import VisionTracker

SCENE = Scene(dish=Dish(2.0 * DISH_RADIUS))
SEED = 4711
FRAMES = 6
FOLDS = ("0_4", "4_15", "15_26", "26_50")
BESIDE = [f"fold_{fold}_{length}mm" for fold in FOLDS for length in ("2.5", "7")]
OPEN = [name for name in BESIDE if "_15_26" in name or "_26_50" in name]
COLOURED = ["black_1px", "black_2px", "black_4px", "violet_4px", "violet_12px", "black_12px", "white_1px", "white_4px"]


@cache
def row(name: str) -> Row:
    """Return what the tracker makes of some frames of a class."""
    return row_of(name, [measure(*frame_of(name, index, SEED)) for index in range(FRAMES)])


@pytest.mark.parametrize("name", BESIDE)
def test_a_needle_with_a_thread_beside_under_or_over_it_is_found_and_never_reversed(name: str):
    assert row(name).wrong == 0
    assert row(name).found - row(name).unknown >= FRAMES - 1


@pytest.mark.parametrize("name", OPEN)
def test_a_thread_folded_back_is_followed_from_where_it_comes_out(name: str):
    assert row(name).covered > 0.8  # of all frames, so that one needle may be lost
    assert (row(name).wrong_line or 0.0) < 0.005


@pytest.mark.parametrize("name", [f"thread_{each}" for each in COLOURED])
def test_dark_pale_thin_and_wide_threads_are_followed(name: str):
    assert (row(name).found, row(name).unknown, row(name).wrong) == (FRAMES, 0, 0)
    assert row(name).covered > 0.95
    assert (row(name).wrong_line or 0.0) < 0.02


@pytest.mark.parametrize(
    ("name", "followed"), [("second_thread", 6), ("crossing_itself", 6), ("second_thread_shallow", 4)]
)
def test_where_threads_cross_the_needles_own_is_followed_or_none(name: str, followed: int):
    assert row(name).found == FRAMES
    assert round(row(name).covered_90 * FRAMES) >= followed
    assert (row(name).wrong_line or 0.0) < 0.01
    assert (row(name).misplaced, row(name).incomplete, row(name).not_free) == (0, 0, 0)


def test_a_thread_beside_the_needles_own_is_not_taken_for_it():
    assert row("second_thread_beside").found == FRAMES
    assert row("second_thread_beside").covered > 0.95
    assert (row("second_thread_beside").wrong_line or 0.0) < 0.005


@pytest.mark.parametrize("name", ["thread_undyed_1px", "thread_undyed_4px"])
def test_nothing_else_is_followed_in_place_of_a_faint_thread(name: str):
    assert row(name).found == FRAMES
    assert (row(name).wrong_line or 0.0) < 0.01


@pytest.mark.parametrize(
    ("name", "index", "seed"),
    [
        ("thread_undyed_6px", 5, 21),  # followed along one edge
        ("thread_undyed_4px", 2, 1033),  # in the middle between it and its shadow
        ("thread_white_0.5px", 3, 21),  # reflections taken for pieces of it
        ("thread_white_1.5px", 2, 21),
        ("thread_undyed_0.75px", 0, 21),  # seen in part only
        ("thread_undyed_0.75px", 2, 21),
        ("thread_undyed_1px", 52, 310001),  # up to a reflection beside it
    ],
)
def test_pale_threads_that_were_followed_wrong_once_are_not(name: str, index: int, seed: int):
    result = measure(*frame_of(name, index, seed))
    assert result.pieces.covered > 0.95 * result.visible
    assert result.wrong < 0.005 * result.line
    assert result.pieces.wrong < 0.005 * result.pieces.length


@pytest.mark.parametrize("index", [19, 35])
def test_a_line_as_long_as_the_thread_may_be_faintest_where_it_comes_out(index: int):
    result = measure(*frame_of("thread_undyed_0.75px", index, 310001))
    assert result.pieces.covered > 0.9 * result.visible
    assert result.pieces.wrong < 0.1 * result.pieces.length


@pytest.mark.parametrize("name", ["thread_undyed_2px", "thread_white_1px", "thread_white_4px"])
def test_standard_deviations_of_pale_threads_are_honest(name: str):
    assert 0.5 < (row(name).normalised or 0.0) < 2.0


def test_a_rod_never_points_the_wrong_way():
    rods = row("blunt_rod")
    assert (rods.wrong, rods.found) == (0, FRAMES)


def test_a_thread_that_leaves_a_rod_tells_its_tail():
    assert row("blunt_rod").unknown == 0
    assert row("blunt_rod").dishonest == 0


@pytest.mark.parametrize("name", ["length_off_2", "length_off_5", "suture_needle", "instrument_beside"])
def test_needles_of_other_lengths_and_bends_are_measured(name: str):
    assert (row(name).wrong, row(name).dishonest) == (0, 0)
    assert row(name).found - row(name).unknown >= FRAMES - 1


def test_a_rod_below_a_coloured_line_is_found_and_its_heading_unknown():
    """The line that a program draws cuts it in two; no thread tells its tail."""
    rods = row("rod_in_path")
    assert rods.found >= FRAMES - 1
    assert (rods.unknown, rods.wrong, rods.dishonest) == (rods.found, 0, 0)


def test_of_a_dish_that_the_frame_cuts_off_needle_and_thread_are_where_they_are():
    cut = row("cut_dish_far")
    assert cut.found >= FRAMES // 2
    assert (cut.wrong, cut.unknown, cut.dishonest) == (0, 0, 0)
    assert (cut.tail_px or 0.0) < 0.6


def test_of_two_needles_the_one_that_a_thread_leaves_is_taken():
    assert row("second_needle").found >= FRAMES - 1
    assert row("second_needle").wrong == 0


def test_a_needle_that_no_thread_leaves_is_not_taken_for_the_one_in_glare():
    decoys = row("decoy_needle")
    assert decoys.found == 0
    assert any("no thread leaves" in reason for reason in decoys.reasons)


def test_a_thread_that_passes_a_tail_does_not_leave_it():
    decoys = row("decoy_at_thread")
    assert decoys.found == 0
    assert any("no thread leaves" in reason for reason in decoys.reasons)


@pytest.mark.parametrize(
    ("name", "index", "seed"),
    [
        ("decoy_at_thread", 21, 280001),
        ("length_off_10", 0, 270001),
        ("thread_black_6px", 2, 290001),
        ("thread_black_6px", 11, 310001),  # a thread wider than the needle leaves its tail sideways
        ("thread_black_6px", 42, 310001),
    ],
)
def test_needles_that_were_wrong_once_are_not(name: str, index: int, seed: int):
    result = measure(*frame_of(name, index, seed))
    assert not result.is_wrong
    assert not result.is_reversed
    assert result.found == (name != "decoy_at_thread")


@pytest.mark.parametrize("name", ["width_320", "width_1280", "width_1920", "dark_field"])
def test_small_and_large_frames_and_a_dark_floor_are_tracked(name: str):
    figures = row(name)
    assert (figures.found, figures.unknown, figures.wrong, figures.covered_90) == (FRAMES, 0, 0, 1.0)
    assert figures.tail_px is not None
    assert figures.tail_px < 0.5


@pytest.mark.parametrize("degrees", [6, 10])
def test_a_tilted_camera_is_warned_of_and_its_errors_are_within_the_covariance(degrees: int):
    figures = row(f"tilt_{degrees}deg")
    assert (figures.found, figures.wrong, figures.dishonest) == (FRAMES, 0, 0)
    for index in range(FRAMES):
        _, image = frame_of(f"tilt_{degrees}deg", index, SEED)
        tracker = VisionTracker(VisionTrackerSettings(), SCENE)
        warned = re.fullmatch(r"the camera is tilted by (\d+) degrees", tracker.look(image).warning)
        assert warned is not None
        assert abs(int(warned[1]) - degrees) <= 1
    assert not VisionTracker(VisionTrackerSettings(), SCENE).look(frame_of("usual", 0, SEED)[1]).warning


def test_over_time_a_tilted_camera_on_a_dark_floor_is_tracked_as_in_each_frame():
    image = 255 - frame_of("tilt_6deg", 1, SEED)[1]
    tracker = VisionTracker(VisionTrackerSettings(confirm_frames=1), SCENE)
    alone = tracker.look(image)
    for index in range(3):
        seen = tracker.track(image, 0.1 * index)
        assert seen.state is State.TRACKED
        assert seen.warning == alone.warning != ""
        np.testing.assert_allclose(seen.tail, alone.tail, atol=2e-5)


def test_the_view_of_a_large_frame_is_in_its_own_pixels():
    case, image = frame_of("width_1920", 0, SEED)
    tracker = VisionTracker(VisionTrackerSettings(confirm_frames=1), SCENE)
    found = tracker.look(image)
    assert found.view is not None
    np.testing.assert_allclose(found.view.centre_px, case.view.centre_px, atol=1.0)
    u, v = found.view.centre_px
    given = VisionTrackerSettings(dish_centre_px=(u, v), metres_per_pixel=found.view.metres_per_pixel, confirm_frames=1)
    for seen in (VisionTracker(given, SCENE).look(image), VisionTracker(given, SCENE).track(image, 0.0)):
        np.testing.assert_allclose(seen.tail, found.tail, atol=1e-5)
        assert seen.view is not None
        np.testing.assert_allclose(seen.view.centre_px, (u, v))


@pytest.mark.parametrize("name", ["usual", "dark_field"])
def test_with_a_given_view_a_dim_floor_and_a_dark_one_are_told_apart(name: str):
    case, image = frame_of(name, 0, SEED)
    (u, v), scale = case.view.centre_px, case.view.metres_per_pixel
    given = VisionTrackerSettings(dish_centre_px=(u, v), metres_per_pixel=scale, confirm_frames=1)
    dim = image if name == "dark_field" else cv2.convertScaleAbs(image, alpha=0.4)
    tracker = VisionTracker(given, SCENE)
    for found in (tracker.look(dim), tracker.track(dim, 0.0), tracker.track(dim, 0.1)):
        assert found.state is State.TRACKED
        assert np.linalg.norm(found.tail - case.needle.tail) < 1.5 * scale


@pytest.mark.parametrize("centre", [(0.0, 0.0), (1e5, 1e5), (320.0, 240.0)])
@pytest.mark.parametrize("scale", [1e-7, 1e-5, 0.01])
def test_a_view_that_cannot_be_gives_no_pose_and_no_error(centre: tuple[float, float], scale: float):
    given = VisionTrackerSettings(dish_centre_px=centre, metres_per_pixel=scale)
    for width in (640, 1920):
        image = frame_of(f"width_{width}", 0, SEED)[1]
        for found in (VisionTracker(given, SCENE).look(image), VisionTracker(given, SCENE).track(image, 0.0)):
            assert found.state is not State.TRACKED
            assert found.reason


def test_a_scale_that_no_camera_has_is_refused():
    with pytest.raises(ConfigurationError, match="at least 1e-07 m"):
        VisionTrackerSettings(metres_per_pixel=1e-12)


@pytest.mark.parametrize(
    ("name", "index", "seed"),
    [
        ("fold_4_15_2.5mm", 3, 14001),  # both directions fit alike
        ("rod_in_path", 0, 12001),  # a line passes beside one end of a rod
        ("rod_in_path", 28, 12001),
        ("decoy_needle", 19, 14001),  # the thread passes beside its tip
        ("decoy_needle", 8, 6003),
        ("rod_in_path", 11, 12001),  # a pale line grinds an end of a rod to a point
        ("decoy_needle", 97, 31001),  # a walk over bare floor reaches the thread
        ("decoy_needle", 32, 91001),  # a faint reflection of the lamp leaves the tail
        ("decoy_at_thread", 59, 91001),  # the thread passes beyond the tail, and touches nothing
        ("decoy_at_thread", 9, 91001),  # a walk has one edge only, the thread's
        ("decoy_at_thread", 3, 410001),  # what is thin looks wide beside its strength at half the size
        ("decoy_at_thread", 12, 410001),
        ("decoy_at_thread", 56, 510001),  # a walk over bare floor reaches the thread, at a quarter of the size
        ("fold_0_4_2.5mm", 2, 410001),  # the thread lies over one side of the tip, which looks like a rod's tail
        ("rod_in_path", 57, 310001),  # a line over a rod leaves one end through its middle
        ("rod_in_path", 25, 310004),  # a line hides one end of a rod, whose length is set wrong
        ("rod_in_path", 89, 310004),
        ("rod_in_path", 8, 310005),  # beyond a line over a rod lies the rest of it
        ("rod_in_path", 87, 310005),  # a rod is longer than set, by more than what a thread is wide
        ("rod_in_path", 88, 310005),  # a line passes one end of a rod
    ],
)
def test_poses_that_were_reversed_once_are_not(name: str, index: int, seed: int):
    assert not measure(*frame_of(name, index, seed)).is_wrong
