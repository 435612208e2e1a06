"""The walk along the thread, and the pieces of a thread that something hides in part."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from benchmarks.vision.measurements import Row, frame_of, measure, row_of
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.polyline import arc_lengths, points_at
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation
from magnetosuture_thread.vision.appearance import Appearance, Hiding, Strand
from magnetosuture_thread.vision.arc import Arc, MeasuredNeedle
from magnetosuture_thread.vision.centreline import WALL_PX, find_centreline, without_needle
from magnetosuture_thread.vision.images import Wall, prepare
from magnetosuture_thread.vision.observe import BARE_COLOUR, Placed, find_order, is_bare_beyond, observe
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import Track, VisionTracker
from magnetosuture_thread.vision.walk import smoothed
from test.vision.scenes import SCENE, line_error

NEEDLE = MeasuredNeedle(Arc(np.array([300.0, 240.0]), 0.0, 0.0), 87.0, 5.0)
TRACKER = VisionTracker(VisionTrackerSettings(), SCENE)
SCALE = 8e-5
DRAWN_VIEW = DishView((320.0, 240.0), SCALE)


def drawn(points: np.ndarray, width: int = 1, noise: float = 2.0, level: int = 140, needle: int = 5) -> np.ndarray:
    """Return a bright image with a needle of a width and a dark line."""
    image = np.full((480, 640), 225, np.uint8)
    cv2.polylines(image, [np.round(points * 16).astype(np.int32)], False, level, width, cv2.LINE_AA, 4)
    cv2.line(image, (300, 240), (387, 240), 50, needle)
    rough = np.random.default_rng(0).normal(0.0, noise, image.shape)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.8) + rough, 0, 255).astype(np.uint8)


def walk(
    image: np.ndarray, max_length: float = 400.0, reach: float = 230.0, needle: MeasuredNeedle = NEEDLE
) -> np.ndarray:
    """Follow the thread."""
    picture = prepare(image, DRAWN_VIEW, (reach + WALL_PX) * SCALE)
    return find_centreline(picture, without_needle(picture.darkest, needle), needle, max_length)


def wave(length: float = 150.0) -> np.ndarray:
    """Return a sine to the west of the needle's tail."""
    x = np.linspace(0.0, length, 300)
    return np.column_stack([300.0 - x, 240.0 + 12.0 * np.sin(x / 18.0)])


def winding(turn: np.ndarray, length: float = 237.0, start: tuple[float, float] = (300.0, 240.0)) -> np.ndarray:
    """Return a line of a length whose direction is given along it, from u towards v, shape (m + 1, 2)."""
    steps = length / len(turn) * np.column_stack([np.cos(turn), np.sin(turn)])
    return np.vstack([start, np.array(start) + np.cumsum(steps, axis=0)])


def check_order(found: np.ndarray, truth: np.ndarray, max_shift: float = 4.0) -> None:
    """Assert that a line goes along the true one, at the same length in the same place."""
    at = np.linspace(0.0, 0.94 * arc_lengths(truth)[-1], 60)
    assert arc_lengths(found)[-1] > 0.95 * arc_lengths(truth)[-1]
    assert np.linalg.norm(points_at(found, at) - points_at(truth, at), axis=1).max() < max_shift


@pytest.mark.parametrize(("noise", "level"), [(2.0, 140), (7.0, 140), (2.0, 195)], ids=["usual", "noisy", "faint"])
def test_it_follows_the_line_to_its_end_and_no_farther(noise: float, level: int):
    found = walk(drawn(wave(), noise=noise, level=level))
    mean, share = line_error(found, wave())
    assert mean < 0.5
    assert share > 0.97
    assert np.linalg.norm(found[-1] - wave()[-1]) < 6.0
    np.testing.assert_array_equal(found[0], NEEDLE.tail_px)


def test_it_stops_at_the_longest_length_and_at_the_wall():
    assert walk(drawn(wave()), max_length=60.0)[-1, 0] > 240.0
    near_wall = walk(drawn(wave()), reach=100.0)
    assert np.linalg.norm(near_wall - (320.0, 240.0), axis=1).max() <= 100.0
    assert np.linalg.norm(near_wall[-1] - (320.0, 240.0)) > 96.0


def test_without_a_line_there_is_only_the_tail():
    for noise in (2.0, 7.0):
        assert walk(drawn(np.array([[0.0, 0.0], [5.0, 5.0]]), noise=noise)).shape == (1, 2)


@pytest.mark.parametrize("angle", [-2.0, -1.1, 1.4, 2.6])
def test_the_thread_may_leave_the_tail_at_any_angle_but_the_needles(angle: float):
    line = winding(np.full(100, angle) + 0.4 * np.linspace(0.0, 1.0, 100), length=120.0)
    found = walk(drawn(line))
    assert np.linalg.norm(found[-1] - line[-1]) < 5.0


def test_a_near_pass_beside_an_earlier_part_does_not_capture_it():
    """A hairpin whose arms are 7 px apart."""
    s = np.linspace(0.0, 237.0, 1200)
    line = winding(np.pi + np.clip((s - 110.0) / 7.0, 0.0, np.pi) - 0.25 * np.clip((s - 140.0) / 90.0, 0.0, 1.0))
    check_order(walk(drawn(line), max_length=250.0), line)


SEED = 4712
FRAMES = 6
COVERS = ["cover_1.5mm", "cover_3mm", "cover_6mm", "cover_10mm", "two_covers", "hand_instrument"]
DARK = Appearance(width_px=3.0, darkness=np.array([1.0, 1.0]), strength=60.0, noise=1.0)
SHORT_NEEDLE = MeasuredNeedle(Arc(np.array([20.0, 20.0]), 0.0, 0.0), 40.0, 5.0)


@cache
def row(name: str) -> Row:
    """Return what the tracker makes of some frames of a class."""
    return row_of(name, [measure(*frame_of(name, index, SEED)) for index in range(FRAMES)])


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


def bare_dish(size: int = 400) -> Hiding:
    """Return a dish in whose middle a square hides all."""
    solid = np.zeros((size, size), np.uint8)
    solid[150:250, 150:250] = 255
    wall = Wall((0.5 * size, 0.5 * size), 0.5 * size)
    inside = np.ones(solid.shape, np.bool_)
    return Hiding(solid, (solid > 0).astype(np.int32), inside, wall)


def line(start: tuple[float, float], end: tuple[float, float]) -> np.ndarray:
    """Return points along a straight line [px]."""
    return np.linspace(start, end, 40)


TAIL = line((80.0, 200.0), (149.0, 200.0)), (0, 1)


def order_of(*pieces: tuple[np.ndarray, tuple[int, int]], longest: float = 260.0) -> list[Placed]:
    """Return the order of pieces, given with the areas that their ends run into."""
    lines, areas = zip(*pieces, strict=True)
    return find_order(list(lines), list(areas), bare_dish(), (0.92 * longest, longest), SCALE)


def test_an_order_that_ends_in_sight_and_is_too_short_is_not_told():
    beyond = line((251.0, 200.0), (330.0, 200.0)), (1, 0)
    assert len(order_of(TAIL, beyond, longest=260.0)) == 2
    assert len(order_of(TAIL, beyond, longest=420.0)) == 1  # as when a loop is left out


@pytest.mark.parametrize("worse", [0.0, 3.0])
def test_where_two_ways_are_nearly_as_good_none_is_taken(worse: float):
    left = line((251.0, 180.0), (330.0, 160.0)), (1, 0)
    right = line((251.0, 220.0 + worse), (330.0, 240.0 + worse)), (1, 0)
    assert len(order_of(TAIL, left, right, longest=270.0)) == 1


@pytest.mark.parametrize(
    ("row", "areas", "longest", "joined"),
    [
        (200.0, (1, 1), 260.0, True),
        (200.0, (1, 1), 200.0, False),  # the thread is too short for this way
        (200.0, (1, 2), 260.0, False),  # another object than it went below
        (140.0, (1, 1), 260.0, False),  # beside the object
        (200.0, (0, 0), 260.0, False),  # a gap on bare floor
    ],
)
def test_pieces_are_joined_below_the_object_that_the_thread_went_below(
    row: float, areas: tuple[int, int], longest: float, joined: bool
):
    tail, beyond = line((80.0, row), (149.0, row)), line((251.0, row), (330.0, row))
    assert (len(order_of((tail, (0, areas[0])), (beyond, (areas[1], 0)), longest=longest)) == 2) == joined


@pytest.mark.parametrize(
    ("across", "colour", "fades", "bare"),
    [
        (0.0, 0.0, False, True),
        (0.16, 0.0, False, True),
        (0.0, 0.5, False, True),
        (0.0, 1.45, False, False),
        (0.0, 0.0, True, False),
    ],
)
def test_an_end_is_bare_in_light_from_one_side_but_not_where_the_colour_changes_or_the_thread_fades(
    across: float, colour: float, fades: bool, bare: bool
):
    image = np.full((160, 160, 3), 180.0)
    image *= 1.0 + across * (np.arange(160) > 80)[:, None, None] - 0.5 * across * (np.arange(160) != 80)[:, None, None]
    image[:, 81:] *= 1.0 + 0.5 * colour * BARE_COLOUR * np.array([-1.0, 0.0, 1.0])
    image[79:82, 20:81] -= DARK.strength
    picture = prepare(np.round(image).astype(np.uint8), DishView((80.0, 80.0), SCALE), 0.0175)
    points = np.column_stack([np.arange(20.0, 81.0, 2.0), np.full(31, 80.0)])
    strength = np.where(fades & (np.arange(31) > 24), 2.0, DARK.strength)
    strand = Strand(points, strength, np.ones(31, np.bool_))
    assert is_bare_beyond(picture, picture.darkest.pixels, DARK, strand, SHORT_NEEDLE) == bare


def observed(image: np.ndarray, needle: MeasuredNeedle, walk: np.ndarray, length: float) -> ThreadObservation:
    """Return what is observed of a thread of a length [m], with a walk along it [px]."""
    picture = prepare(image, DRAWN_VIEW, 0.0172)
    gray = smoothed(without_needle(picture.darkest, needle))
    return observe(picture, gray, needle, walk, length, scale_known=True)


def straight_thread() -> tuple[MeasuredNeedle, np.ndarray]:
    """Return a needle, and an image of it with a straight thread of 150 px behind it on a bright floor."""
    image = np.full((480, 640), 225, np.uint8)
    cv2.line(image, (300, 240), (150, 240), 100, 2)
    cv2.line(image, (300, 240), (387, 240), 50, 5)
    return MeasuredNeedle(Arc(np.array([300.0, 240.0]), 0.0, 0.0), 87.0, 5.0), image


@pytest.mark.parametrize("covered", [False, True])
def test_the_edge_of_an_object_that_a_walk_goes_along_shows_no_thread(covered: bool):
    needle, image = straight_thread()
    if covered:
        image[240:300, 215:255] = 140
    noise = np.random.default_rng(0).normal(0.0, 2.0, image.shape)
    image = np.clip(cv2.GaussianBlur(image, (0, 0), 0.8) + noise, 0.0, 255.0).astype(np.uint8)
    walk = line((300.0, 240.0), (149.0, 240.0))
    seen = observed(image, needle, walk, 150.0 * SCALE)
    u = np.concatenate([DRAWN_VIEW.to_pixels(piece.points)[:, 0] for piece in seen.pieces])
    assert ((u > 220.0) & (u < 250.0)).any() == (not covered)
    assert seen.complete == (not covered)


@pytest.mark.parametrize("bare", [False, True])
def test_a_thread_is_complete_only_if_bare_floor_lies_beyond_its_end(bare: bool):
    needle, image = straight_thread()
    image[:, :149] = 225 if bare else 190  # another floor, that the thread may go on below
    walk = line((300.0, 240.0), (151.0, 240.0))
    seen = observed(image, needle, walk, 150.0 * SCALE)
    assert seen.complete == bare
    assert [piece.last_end for piece in seen.pieces] == [PieceEnd.FREE if bare else PieceEnd.UNKNOWN]
