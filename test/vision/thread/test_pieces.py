"""Pieces of a thread that something hides in part, in rendered frames."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from benchmarks.vision.frames import DISH_RADIUS
from benchmarks.vision.measurements import Row, frame_of, measure, row_of
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.polyline import arc_lengths
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.scene.scene import Dish
from magnetosuture_thread.thread_observation import PieceEnd
from magnetosuture_thread.vision.images import Wall, prepare
from magnetosuture_thread.vision.look import Track
from magnetosuture_thread.vision.needle.arc import Arc, MeasuredNeedle
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.thread.appearance import Appearance, Strand, appearance_of
from magnetosuture_thread.vision.thread.hiding import Hiding
from magnetosuture_thread.vision.thread.observe import Piece, find_order, observe
from magnetosuture_thread.vision.thread.pieces import BARE_COLOUR, is_bare_beyond
from magnetosuture_thread.vision.tracker import VisionTracker

SEED = 4712
FRAMES = 6
SCENE = Scene(dish=Dish(2.0 * DISH_RADIUS))
COVERS = ["cover_1.5mm", "cover_3mm", "cover_6mm", "cover_10mm", "two_covers", "hand_instrument"]
SCALE = 8e-5
DARK = Appearance(width_px=3.0, darkness=np.array([1.0, 1.0]), strength=60.0, noise=1.0)
NEEDLE = MeasuredNeedle(Arc(np.array([20.0, 20.0]), 0.0, 0.0), 40.0, 5.0)


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


def test_a_thread_in_sight_is_complete():
    assert (row("usual").complete, row("usual").incomplete) == (FRAMES, 0)


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
    return Hiding(solid, (solid > 0).astype(np.int32), inside, np.full(solid.shape, 200.0, np.float32), wall)


def line(start: tuple[float, float], end: tuple[float, float]) -> np.ndarray:
    """Return points along a straight line [px]."""
    return np.linspace(start, end, 40)


def test_the_straight_way_below_a_cover_is_taken_and_a_piece_beside_is_left():
    tail = Piece(line((80.0, 200.0), (149.0, 200.0)), (0, 1))
    beyond = Piece(line((330.0, 200.0), (251.0, 200.0)), (0, 1))
    order = find_order([tail, beyond], bare_dish(), (240.0, 260.0), SCALE)
    assert [(placed.index, placed.turned) for placed in order.placed] == [(0, False), (1, True)]
    low, high = order.placed[1].arc_length
    assert low == pytest.approx(69.0 + 102.0)
    assert low < high <= 260.0 - 79.0 + 1e-9
    assert order.length == pytest.approx((69.0 + 102.0 + 79.0, high + 79.0))


@pytest.mark.parametrize("worse", [0.0, 3.0])
def test_where_two_ways_are_nearly_as_good_none_is_taken(worse: float):
    tail = Piece(line((80.0, 200.0), (149.0, 200.0)), (0, 1))
    left = Piece(line((251.0, 180.0), (330.0, 160.0)), (1, 0))
    right = Piece(line((251.0, 220.0 + worse), (330.0, 240.0 + worse)), (1, 0))
    order = find_order([tail, left, right], bare_dish(), (240.0, 270.0), SCALE)  # each way is as long as the thread
    assert [placed.index for placed in order.placed] == [0]
    assert order.wide == ()


def test_a_thread_too_short_for_a_way_does_not_take_it():
    tail = Piece(line((80.0, 200.0), (149.0, 200.0)), (0, 1))
    beyond = Piece(line((251.0, 200.0), (330.0, 200.0)), (1, 0))
    order = find_order([tail, beyond], bare_dish(), (190.0, 200.0), SCALE)
    assert [placed.index for placed in order.placed] == [0]


def test_a_gap_on_bare_floor_is_no_reason_to_join():
    tail = Piece(line((80.0, 100.0), (149.0, 100.0)), (0, 0))
    beyond = Piece(line((170.0, 100.0), (260.0, 100.0)), (0, 0))
    assert len(find_order([tail, beyond], bare_dish(), (150.0, 260.0), SCALE).placed) == 1


@pytest.mark.parametrize(("row", "area", "joined"), [(200.0, 1, True), (200.0, 2, False), (140.0, 1, False)])
def test_a_thread_goes_on_below_the_object_that_it_went_below_and_not_beside_it(row: float, area: int, joined: bool):
    tail = Piece(line((80.0, row), (149.0, row)), (0, 1))
    beyond = Piece(line((251.0, row), (330.0, row)), (area, 0))
    order = find_order([tail, beyond], bare_dish(), (240.0, 260.0), SCALE)
    assert (len(order.placed) == 2) == joined


def test_hidden_outlines_surround_what_covers_the_thread():
    case, image = frame_of("cover_10mm", 1, SEED)
    tracker, _, _ = tracker_of("cover_10mm", 1)
    track = tracker.look(image)
    assert isinstance(track.view, DishView)
    middle = case.hidden_by[0].outline.mean(axis=0)
    boxes = [(outline.min(axis=0), outline.max(axis=0)) for outline in track.observation.hidden]
    near = case.thread[len(case.thread) // 2] if np.linalg.norm(middle) > DISH_RADIUS else middle
    assert any((low <= near).all() and (near <= high).all() for low, high in boxes)


def test_width_and_strength_of_a_thread_are_those_of_its_profile():
    aside = np.arange(80.0)[:, None] - 40.0
    image = np.round(120.0 - 60.0 * np.exp(-0.5 * aside**2) * np.ones(160)).astype(np.uint8)
    points = np.column_stack([np.arange(20.0, 140.0, 2.0), np.full(60, 40.0)])
    picture = prepare(image, 1)
    found = appearance_of(picture, picture.darkest.pixels, points, np.ones(60, np.bool_))
    assert found.strength == pytest.approx(60.0, rel=0.03)
    assert found.width_px == pytest.approx(2.355, abs=0.5)


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
    picture = prepare(np.round(image).astype(np.uint8), 1)
    points = np.column_stack([np.arange(20.0, 81.0, 2.0), np.full(31, 80.0)])
    strength = np.where(fades & (np.arange(31) > 24), 2.0, DARK.strength)
    strand = Strand(points, strength, np.ones(31, np.bool_))
    assert is_bare_beyond(picture, picture.darkest.pixels, DARK, strand, NEEDLE) == bare


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
    view, walk = DishView((320.0, 240.0), SCALE), line((300.0, 240.0), (149.0, 240.0))
    seen = observe(prepare(image, 2), needle, walk, view, 0.0172, 150.0 * SCALE, scale_known=True)
    u = np.concatenate([view.to_pixels(piece.points)[:, 0] for piece in seen.pieces])
    assert ((u > 220.0) & (u < 250.0)).any() == (not covered)
    assert seen.complete == (not covered)


@pytest.mark.parametrize("bare", [False, True])
def test_a_thread_is_complete_only_if_bare_floor_lies_beyond_its_end(bare: bool):
    needle, image = straight_thread()
    image[:, :149] = 225 if bare else 190  # another floor, that the thread may go on below
    view, walk = DishView((320.0, 240.0), SCALE), line((300.0, 240.0), (151.0, 240.0))
    seen = observe(prepare(image, 2), needle, walk, view, 0.0172, 150.0 * SCALE, scale_known=True)
    assert seen.complete == bare
    assert [piece.last_end for piece in seen.pieces] == [PieceEnd.FREE if bare else PieceEnd.UNKNOWN]


def test_a_piece_whose_place_is_unknown_has_no_direction():
    needle = MeasuredNeedle(Arc(np.array([300.0, 240.0]), 0.0, 0.0), 87.0, 5.0)
    image = np.full((480, 640), 225, np.uint8)
    cv2.line(image, (300, 240), (387, 240), 50, 5)
    cv2.line(image, (300, 240), (220, 240), 100, 2)
    cv2.line(image, (240, 330), (320, 340), 100, 2)  # in no way from the other
    image[200:300, 160:221] = 140
    view, walk = DishView((320.0, 240.0), SCALE), line((300.0, 240.0), (221.0, 240.0))
    seen = observe(prepare(image, 2), needle, walk, view, 0.0172, 260.0 * SCALE, scale_known=True)
    first, *others = seen.pieces
    assert (first.arc_length, first.direction_known) == ((0.0, 0.0), True)
    assert [np.isnan(piece.arc_length[0]) for piece in others] == [True]
    assert not others[0].direction_known
