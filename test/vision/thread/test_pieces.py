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
from magnetosuture_thread.vision.needle.arc import Arc
from magnetosuture_thread.vision.needle.measured_needle import MeasuredNeedle
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.thread.appearance import MIN_SHARE, Appearance, appearance_of, respaced
from magnetosuture_thread.vision.thread.hiding import NEEDLE_PX, Hiding, _fit_light, _mark_unlike
from magnetosuture_thread.vision.thread.observe import observe
from magnetosuture_thread.vision.thread.order import Piece, find_order
from magnetosuture_thread.vision.thread.piece_ends import BARE_COLOUR, is_bare_beyond
from magnetosuture_thread.vision.thread.profiles import (
    integrate_across,
    middle_strengths,
    sample_across,
    usual_profile,
)
from magnetosuture_thread.vision.thread.strands import Strand, first_clear_of, strand_along
from magnetosuture_thread.vision.tracker import VisionTracker

SEED = 4712
FRAMES = 6
SCENE = Scene(dish=Dish(2.0 * DISH_RADIUS))
COVERS = ["cover_1.5mm", "cover_3mm", "cover_6mm", "cover_10mm", "two_covers", "hand_instrument"]
SCALE = 8e-5
DARK = Appearance(pale=False, width_px=3.0, darkness=np.array([1.0, 1.0]), strength=60.0, noise=1.0)
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


def test_drawn_paths_are_no_pieces():
    assert row("drawn_path").found >= FRAMES - 1
    assert (row("drawn_path").wrong_pieces or 0.0) < 0.01


def test_over_time_pieces_are_found_outside_of_the_region_too():
    tracker, image, _ = tracker_of("cover_10mm", 1)
    alone = tracker.look(image).observation
    seen = [tracker.track(image, 1.0 + 0.03 * k) for k in range(5)]
    assert len(alone.pieces) > 1
    assert len(seen[-1].observation.pieces) == len(alone.pieces)
    assert seen[-1].observation.pieces[-1].length == pytest.approx(alone.pieces[-1].length, rel=0.02)


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


def test_a_strand_from_its_other_end_has_its_points_strengths_and_gaps_in_that_order():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 1.0]])
    turned = Strand(points, np.array([3.0, 4.0, 5.0]), np.array([True, True, False])).turned()
    assert (turned.points[0].tolist(), turned.strength.tolist()) == ([2.0, 1.0], [5.0, 4.0, 3.0])
    assert turned.visible.tolist() == [False, True, True]


def test_a_thread_is_visible_where_it_is_darker_than_a_share_of_its_usual_strength():
    image = np.full((60, 120), 200, np.uint8)
    for left, share in ((10, 1.0), (40, 1.5 * MIN_SHARE), (70, 0.5 * MIN_SHARE)):
        cv2.line(image, (left, 30), (left + 29, 30), round(200.0 - share * DARK.strength), 3)
    shown = strand_along(image, DARK, np.array([[20.0, 30.0], [50.0, 30.0], [80.0, 30.0]])).visible
    assert shown.tolist() == [True, True, False]


def test_a_walk_along_the_needle_is_clear_of_it_beyond_its_tip():
    along = np.arange(0.0, 80.0, 2.0)
    walk = NEEDLE.arc.at(along)
    assert along[first_clear_of(NEEDLE, walk)] == pytest.approx(NEEDLE.length_px + NEEDLE_PX, abs=2.0)
    assert along[first_clear_of(NEEDLE, NEEDLE.arc.at(-along))] == pytest.approx(NEEDLE_PX, abs=2.0)


@pytest.mark.parametrize("spacing", [0.5, 2.0, 7.0, 30.0])
def test_a_polyline_gets_vertices_of_about_the_wanted_distance(spacing: float):
    apart = np.linalg.norm(np.diff(respaced(line((0.0, 0.0), (21.0, 28.0)), spacing), axis=0), axis=1)
    assert np.ptp(apart) < 1e-9
    assert abs(len(apart) - 35.0 / spacing) < 0.5 + 1e-9


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_width_and_strength_of_a_thread_are_those_of_its_profile(sign: float):
    aside = np.arange(80.0)[:, None] - 40.0
    image = np.round(120.0 + sign * 60.0 * np.exp(-0.5 * aside**2) * np.ones(160)).astype(np.uint8)
    points = np.column_stack([np.arange(20.0, 140.0, 2.0), np.full(60, 40.0)])
    picture = prepare(image, 1)
    found = appearance_of(picture, picture.darkest.pixels, points, np.ones(60, np.bool_))
    assert found.pale == (sign > 0.0)
    assert found.strength == pytest.approx(60.0, rel=0.03)
    assert found.width_px == pytest.approx(2.355, abs=0.5)


def test_the_noise_of_a_pixel_is_measured_beside_the_thread():
    deviation, random = 10.0, np.random.default_rng(0)
    image = random.normal(150.0, deviation, (240, 320))
    measured = []
    for row in range(40, 220, 40):
        cv2.line(image, (20, row), (300, row), 60.0, 3)
    picture = prepare(np.clip(image, 0.0, 255.0).astype(np.uint8), 1)
    for row in range(40, 220, 40):
        points = np.column_stack([np.arange(30.0, 290.0, 2.0), np.full(130, float(row))])
        measured.append(appearance_of(picture, picture.darkest.pixels, points, np.ones(130, np.bool_)).noise)
    assert np.mean(measured) == pytest.approx(deviation, rel=0.1)


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


@pytest.mark.parametrize("side", range(4))
@pytest.mark.parametrize("left", [40, 6])
def test_an_end_beside_the_border_of_the_frame_is_not_bare(side: int, left: int):
    image = np.full((160, 160), 180, np.uint8)
    image[79:82, left:140] = 120
    along = np.arange(139.0, left, -2.0)
    points = np.column_stack([along, np.full_like(along, 80.0)])
    for _ in range(side):  # a quarter turn
        image = np.ascontiguousarray(np.rot90(image))
        points = np.column_stack([points[:, 1], 159.0 - points[:, 0]])
    picture = prepare(image, 1)
    strand = Strand(points, np.full(len(points), DARK.strength), np.ones(len(points), np.bool_))
    away = MeasuredNeedle(Arc(np.array([500.0, 500.0]), 0.0, 0.0), 40.0, 5.0)
    assert is_bare_beyond(picture, picture.darkest.pixels, DARK, strand, away) == (left == 40)


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


def test_profiles_are_taken_across_a_line_from_its_left_to_its_right():
    image = (20.0 + 2.0 * np.arange(60) + np.arange(50)[:, None]).astype(np.uint8)
    points, aside = np.linspace((10.0, 10.0), (40.0, 30.0), 31), np.linspace(-4.0, 4.0, 9)
    profiles = np.empty((3, 9))
    sample_across(image, points, np.array([0, 12, 30]), aside, profiles)
    right = np.array([-20.0, 30.0]) / np.hypot(20.0, 30.0)
    at = points[[0, 12, 30], None] + aside[:, None] * right
    np.testing.assert_allclose(profiles, 20.0 + at @ (2.0, 1.0), atol=1e-9)


def test_the_usual_profile_is_that_of_most_above_the_floor_beside_each():
    aside = np.arange(-8.0, 8.5, 0.5)
    shape = -60.0 * np.exp(-0.5 * aside**2)
    profiles = shape + np.array([200.0, 150.0, 120.0, 90.0, 180.0])[:, None]
    profiles[1, 16:] += 80.0  # an edge
    usual = np.empty(33)
    usual_profile(profiles, aside, 4.0, usual)
    np.testing.assert_allclose(usual, shape, atol=0.05)


@pytest.mark.parametrize("pale", [False, True])
def test_the_integral_across_a_thread_is_its_share_of_the_floors_light_times_its_width(pale: bool):
    image = np.full((60, 80), 100, np.uint8)
    image[28:32] = 140 if pale else 60
    points = np.column_stack([np.arange(10.0, 70.0, 2.0), np.full(30, 29.5)])
    values = np.empty(2)
    integrate_across(image, points, np.array([3, 20]), 8.0, 0.5, pale, values)
    np.testing.assert_allclose(values, 0.4 * 4.0, rtol=0.03)


@pytest.mark.parametrize("pale", [False, True])
def test_a_line_is_as_strong_as_on_its_side_that_differs_more_or_less(pale: bool):
    image = np.full((60, 80), 100, np.int64)
    image[:29] = 130
    image[28:31] = 40
    image = 200 - image if pale else image
    points = np.column_stack([np.arange(10.0, 70.0, 2.0), np.full(30, 29.0)])
    for two_sided, expected in ((False, 90.0), (True, 60.0)):
        values = np.empty(30)
        middle_strengths(image.astype(np.uint8), points, 5.0, pale, two_sided, values)
        np.testing.assert_allclose(values, expected)
    aside = np.empty(30)
    middle_strengths(image.astype(np.uint8), points - (0.0, 2.0), 5.0, pale, False, aside)
    np.testing.assert_allclose(aside, 90.0)  # as its middle is looked for up to a pixel aside
    middle_strengths(image.astype(np.uint8), np.add(points, (0.0, 2.0)), 5.0, pale, True, aside)
    np.testing.assert_allclose(aside, 60.0)


def test_the_floors_light_is_that_of_most_cells_whatever_lies_on_the_others():
    random = np.random.default_rng(4)
    places = np.column_stack([np.ones(600), random.uniform(-1.0, 1.0, (600, 2))])
    given = np.array([[180.0, 150.0], [12.0, -6.0], [-8.0, 5.0]])
    values = places @ given + random.normal(0.0, 1.0, (600, 2))
    values[::4] += 60.0
    values[1::7] = 20.0
    weights = np.empty((3, 2))
    _fit_light(places, values, weights)
    np.testing.assert_allclose(weights, given, atol=0.5)


def test_what_is_brighter_or_darker_or_of_another_colour_within_the_dish_is_no_floor():
    light = np.full((20, 30, 3), 100.0, np.float32)
    small = light.astype(np.uint8)
    small[4, 10:13], small[8, 10:13], small[12, 10:13], small[16, 10:13] = 110, 90, (104, 100, 96), 104
    small[10, 1], small[10, 28] = 150, 150  # at the distances 39 and 42 from the centre
    found = np.zeros((20, 30), np.uint8)
    _mark_unlike(small, light, (0.05, 0.06), (42.0, 30.0, 41.0), found)
    expected = np.zeros_like(found)
    expected[[4, 8, 12], 10:13] = expected[10, 1] = 1
    np.testing.assert_array_equal(found, expected)
