"""Needle and thread in frames of the benchmark's hard classes, other ones than it draws by default."""

from __future__ import annotations

import re
from functools import cache
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from benchmarks.vision.frames import DISH_RADIUS
from benchmarks.vision.measurements import frame_of, measure, row_of
from magnetosuture_thread.geometry.polyline import arc_lengths
from magnetosuture_thread.geometry.scene import Dish, Scene
from magnetosuture_thread.geometry.thread_observation import PieceEnd
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import State, Track, VisionTracker

pytestmark = pytest.mark.slow

SCENE = Scene(dish=Dish(2.0 * DISH_RADIUS))
SEED = 4711
FRAMES = 6
FOLDS = [f"{fold}_{length}mm" for fold in ("0_4", "4_15", "15_26", "26_50") for length in ("2.5", "7")]
THREADS = ["black_0.5px", "black_1px", "black_4px", "violet_0.5px", "violet_2px", "violet_6px"]
# Of each class: poses with a known heading, share of the thread that is followed, and of the line where no thread is.
LIMITS: dict[str, tuple[int, float, float]] = {
    **{
        f"fold_{name}": (FRAMES - 1, 0.8 if name[0] in "12" else 0.0, 0.005 if name[0] in "12" else 1.0)
        for name in FOLDS
    },
    **{f"thread_{name}": (FRAMES, 0.95, 0.02) for name in THREADS},
    **{f"wall_{end}": (FRAMES - 1, 0.7, 0.02) for end in ("tip", "tail", "side")},
    **{f"width_{columns}": (FRAMES, 0.95, 0.01) for columns in (320, 1280, 1920)},
    **{name: (FRAMES, 0.95, 0.01) for name in ("usual", "saturated", "dark_field", "blunt_rod")},
    **{
        name: (FRAMES - 1, 0.7, 0.02) for name in ("length_off_2", "length_off_5", "suture_needle", "instrument_beside")
    },
    "second_thread_beside": (FRAMES, 0.95, 0.005),
    "second_needle": (FRAMES - 1, 0.7, 0.02),
    "cut_dish_far": (FRAMES // 2, 0.3, 0.02),
}
COVERS = ["cover_1.5mm", "cover_3mm", "cover_6mm", "cover_10mm", "two_covers", "hand_instrument"]


@cache
def row(name: str) -> SimpleNamespace:
    """Return what the tracker makes of some frames of a class."""
    return SimpleNamespace(**row_of(name, [measure(*frame_of(name, index, SEED)) for index in range(FRAMES)]))


@pytest.mark.parametrize("name", LIMITS)
def test_no_pose_is_wrong_and_the_thread_is_followed(name: str):
    known, followed, wrong_line = LIMITS[name]
    figures = row(name)
    assert (figures.wrong, figures.reversed) == (0, 0)
    assert figures.found - figures.unknown >= known
    assert figures.dishonest == 0 or name.startswith(("fold", "wall"))
    assert figures.tail_px is not None
    assert figures.tail_px < 1.2
    assert figures.covered >= followed  # of all frames, so that one needle may be lost
    assert (figures.wrong_line or 0.0) < wrong_line


@pytest.mark.parametrize(
    ("name", "followed"), [("second_thread", 6), ("crossing_itself", 6), ("second_thread_shallow", 4)]
)
def test_where_threads_cross_the_needles_own_is_followed_or_none(name: str, followed: int):
    assert row(name).found == FRAMES
    assert round(row(name).covered_90 * FRAMES) >= followed
    assert (row(name).wrong_line or 0.0) < 0.01
    assert (row(name).misplaced, row(name).incomplete, row(name).not_free) == (0, 0, 0)


@pytest.mark.parametrize(
    ("name", "index", "seed"),
    [
        ("fold_4_15_2.5mm", 3, 14001),  # both directions fit alike
        ("fold_0_4_2.5mm", 2, 410001),  # the thread lies over one side of the tip, which looks like a rod's tail
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


@pytest.mark.parametrize("degrees", [6, 10])
def test_a_tilt_that_two_rings_agree_on_is_warned_of_and_errors_of_any_are_within_the_covariance(degrees: int):
    figures = row(f"tilt_{degrees}deg")
    assert (figures.found, figures.reversed, figures.dishonest) == (FRAMES, 0, 0)
    warned = 0
    for index in range(FRAMES):
        _, image = frame_of(f"tilt_{degrees}deg", index, SEED)
        warning = VisionTracker(VisionTrackerSettings(), SCENE).look(image).warning
        angle = re.fullmatch(r"the camera is tilted by (\d+) degrees", warning)
        assert angle is not None or warning == ""
        assert angle is None or abs(int(angle[1]) - degrees) <= 1
        warned += angle is not None
    assert warned >= FRAMES // 2
    assert not VisionTracker(VisionTrackerSettings(), SCENE).look(frame_of("usual", 0, SEED)[1]).warning


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


def tracker_of(name: str, index: int) -> tuple[VisionTracker, np.ndarray, float]:
    """Return a tracker for a frame, the frame, and the thread's length [m]."""
    case, image = frame_of(name, index, SEED)
    length = float(arc_lengths(case.thread)[-1])
    return VisionTracker(VisionTrackerSettings(thread_length=length), SCENE), image, length


def look(name: str, index: int) -> Track:
    """Return what a tracker makes of a frame."""
    tracker, image, _ = tracker_of(name, index)
    return tracker.look(image)


@pytest.mark.parametrize("name", COVERS)
def test_the_thread_is_found_on_both_sides_of_what_covers_it(name: str):
    assert row(name).pieces >= 0.9
    assert (row(name).wrong_pieces or 0.0) < 0.01


@pytest.mark.parametrize("name", [*COVERS, "cover_end", "cover_crossing", "glare_thread"])
def test_no_piece_is_said_to_lie_where_it_does_not_and_no_part_is_taken_for_all(name: str):
    assert (row(name).misplaced, row(name).incomplete, row(name).not_free) == (0, 0, 0)


def test_a_covered_end_is_neither_free_nor_is_the_thread_complete():
    assert (row("cover_end").complete, row("cover_end").free) == (0, 0)
    for index in range(FRAMES):
        assert PieceEnd.COVERED in {piece.last_end for piece in look("cover_end", index).observation.pieces}


@pytest.mark.parametrize("name", ["usual", "cover_6mm", "crossing_needle"])
def test_standard_deviations_are_honest(name: str):
    assert 0.6 < (row(name).normalised or 0.0) < 1.4


def test_pieces_beyond_a_cover_are_joined_with_an_interval_of_arc_length():
    joined = [look("two_covers", index).observation for index in range(FRAMES)]
    placed = [[piece for piece in each.pieces if np.isfinite(piece.arc_length[0])] for each in joined]
    assert sum(len(each) == 3 for each in placed) >= FRAMES - 2
    for pieces in placed:
        lows = [piece.arc_length[0] for piece in pieces]
        assert lows == sorted(lows)
        for piece in pieces:
            assert piece.arc_length[0] <= piece.arc_length[1]
            assert len(piece.deviation) == len(piece.points)


def test_with_a_wrong_length_no_frame_is_complete_and_no_end_is_free():
    _, image, length = tracker_of("usual", 0)
    for wrong in (0.7 * length, 1.5 * length):
        track = VisionTracker(VisionTrackerSettings(thread_length=wrong), SCENE).look(image)
        assert not track.observation.complete
        assert PieceEnd.FREE not in {piece.last_end for piece in track.observation.pieces}
