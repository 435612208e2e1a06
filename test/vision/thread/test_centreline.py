"""The walk along the thread."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.vision.images import Wall, prepare
from magnetosuture_thread.vision.needle.arc import Arc
from magnetosuture_thread.vision.needle.measured_needle import MeasuredNeedle
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.thread.appearance import respaced
from magnetosuture_thread.vision.thread.centreline import (
    FollowedThread,
    certain_points,
    find_centreline,
    follow_thread,
)
from magnetosuture_thread.vision.thread.crossings import Crossing, strands_meet
from magnetosuture_thread.vision.thread.forks import worth, worth_of_whole
from magnetosuture_thread.vision.thread.joint import joins_passing_line
from magnetosuture_thread.vision.thread.leave import begin_path, ways_out
from magnetosuture_thread.vision.thread.loose import has_loose_thread
from magnetosuture_thread.vision.thread.ridge import ZERO, Ridge, darker_than_around, faint_ridge
from magnetosuture_thread.vision.thread.search import WALL_PX, ThreadSearch, Walk
from magnetosuture_thread.vision.thread.walk import is_hidden, refine, walk_on
from magnetosuture_thread.vision.tracker import VisionTracker
from test.vision.scenes import PIXEL, SCENE, VIEW, Pose, blob, line_error, render

NEEDLE = MeasuredNeedle(Arc(np.array([300.0, 240.0]), 0.0, 0.0), 87.0, 5.0)
TRACKER = VisionTracker(VisionTrackerSettings(), SCENE)


def drawn(points: np.ndarray, width: int = 1, noise: float = 2.0, level: int = 140) -> np.ndarray:
    """Return a bright image with a needle and a dark line."""
    image = np.full((480, 640), 225, np.uint8)
    cv2.polylines(image, [np.round(points * 16).astype(np.int32)], False, level, width, cv2.LINE_AA, 4)
    cv2.line(image, (300, 240), (387, 240), 50, 5)
    rough = np.random.default_rng(0).normal(0.0, noise, image.shape)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.8) + rough, 0, 255).astype(np.uint8)


def walk(image: np.ndarray, max_length: float = 400.0, reach: float = 230.0) -> np.ndarray:
    """Follow the thread."""
    return find_centreline(prepare(image, 2), NEEDLE, max_length, (320.0, 240.0), reach + WALL_PX)


def follow(image: np.ndarray) -> FollowedThread:
    """Follow the thread, with a confidence."""
    return follow_thread(prepare(image, 2), NEEDLE, 400.0, (320.0, 240.0), 230.0 + WALL_PX)


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


def test_it_goes_over_a_short_gap_and_ends_at_a_long_one():
    line = wave()
    for gap, crosses in ((7.0, True), (35.0, False)):
        image = drawn(line)
        image[200:280, int(230.0 - gap) : 230] = 225
        assert (walk(image)[-1, 0] < 170.0) == crosses


def test_under_glare_the_thread_may_go_on():
    line = np.column_stack([300.0 - np.linspace(0.0, 180.0, 300), 240.0 + np.linspace(0.0, 30.0, 300)])
    image = drawn(line)
    image[:, 190:222] = 225  # a gap too long to cross ...
    assert walk(image)[-1, 0] > 200.0
    image[:, 192:220] = 252  # ... but not where the lamp is seen instead of the floor
    assert walk(image)[-1, 0] < 130.0


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


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("radius", [30.0, 16.0])
def test_the_walk_goes_straight_through_its_own_crossing(sign: float, radius: float):
    turned = np.clip((np.linspace(0.0, 237.0, 800) - 50.0) / radius, 0.0, 1.6 * np.pi)
    line = winding(np.pi + sign * turned)
    check_order(walk(drawn(line), max_length=250.0), line)


def test_where_straight_on_shows_less_of_the_thread_the_loop_is_taken():
    """The loop closes on itself almost in line: going past it leaves a half of the thread unseen."""
    s = np.linspace(0.0, 237.0, 800)
    line = winding(np.pi - 0.15 + np.clip((s - 60.0) / 15.0, 0.0, 2.0 * np.pi + 0.3))
    image = drawn(line)
    found = walk(image, max_length=250.0)
    assert arc_lengths(found)[-1] > 0.93 * 237.0
    assert line_error(found, line)[1] > 0.95


def test_the_walk_crosses_under_the_needle():
    turned = np.clip((np.linspace(0.0, 237.0, 800) - 25.0) / 26.0, 0.0, 1.5 * np.pi)
    line = winding(np.pi + turned)
    assert line[:, 0].max() > 330.0 or line[:, 1].min() < 200.0
    check_order(walk(drawn(line), max_length=250.0), line)


@pytest.mark.parametrize(("width", "level", "radius"), [(12, 60, 26.0), (14, 60, 23.0), (14, 120, 23.0)])
def test_a_rope_is_followed_below_the_needle_to_its_end(width: int, level: int, radius: float):
    line = winding(np.pi + np.clip((np.linspace(0.0, 237.0, 800) - 25.0) / radius, 0.0, 1.15 * np.pi))
    assert line_error(walk(drawn(line, width=width, level=level), max_length=250.0), line)[1] > 0.95


def test_a_near_pass_beside_an_earlier_part_does_not_capture_it():
    """A hairpin whose arms are 7 px apart."""
    s = np.linspace(0.0, 237.0, 1200)
    line = winding(np.pi + np.clip((s - 110.0) / 7.0, 0.0, np.pi) - 0.25 * np.clip((s - 140.0) / 90.0, 0.0, 1.0))
    check_order(walk(drawn(line), max_length=250.0), line)


def test_the_thread_is_followed_past_posts():
    tail = np.array([0.004, 0.006])
    angle = np.pi - 0.2 + np.linspace(0.0, 2.4, 300)
    thread = np.vstack([tail, tail + np.cumsum(0.019 / 300 * np.column_stack([np.cos(angle), np.sin(angle)]), axis=0)])
    aside = np.column_stack([np.sin(angle), -np.cos(angle)])
    posts = [Disc(tuple(thread[i] + 0.00142 * aside[i] * sign), 0.0013) for i, sign in ((90, 1.0), (190, -1.0))]
    seen = TRACKER.look(render(Pose(tail, -0.2), thread, obstacles=tuple(posts)))
    assert seen.reason == ""
    mean, share = line_error(VIEW.to_pixels(seen.centreline), VIEW.to_pixels(thread))
    assert mean < 1.0
    assert share > 0.95


def test_the_thread_is_followed_through_a_hot_spot_and_up_to_the_wall():
    tail = np.array([0.004, 0.0])
    thread = np.column_stack([np.linspace(0.004, 0.0235, 200), 0.002 * np.sin(np.linspace(0.0, 3.0, 200))])
    spot = blob(np.array([0.0105, 0.0016]), 4e-4, (255.0, 255.0, 255.0))
    seen = TRACKER.look(render(Pose(tail, np.pi), thread, covers=(spot,)))
    assert seen.reason == ""
    reach = np.linalg.norm(seen.centreline, axis=1)
    assert 0.0175 - 6.0 * PIXEL < reach.max() < 0.0175
    mean, _ = line_error(VIEW.to_pixels(seen.centreline), VIEW.to_pixels(thread))
    assert mean < 1.0


def test_a_crossing_is_doubtful_where_another_way_is_as_smooth():
    line = wave()
    middle, way = line[150], line[170] - line[150]
    alone = follow(drawn(line)).confidence
    found = {}
    for angle in (16.0, 60.0, 90.0):
        turn = np.radians(angle)
        turned = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ way
        ends = [np.round(middle + side * 70.0 * turned / np.linalg.norm(way)).astype(int) for side in (-1.0, 1.0)]
        image = drawn(line)
        cv2.line(image, ends[0].tolist(), ends[1].tolist(), 140, 1, cv2.LINE_AA)
        found[angle] = follow(image)
    assert found[16.0].confidence < 0.5
    assert min(found[60.0].confidence, found[90.0].confidence) > 0.99
    assert alone == 1.0
    assert found[16.0].doubtful_px is not None
    assert np.linalg.norm(found[16.0].doubtful_px - middle) < 15.0


def test_without_a_thread_there_is_no_confidence():
    nothing = follow(drawn(np.array([[0.0, 0.0], [5.0, 5.0]])))
    assert (len(nothing.points), nothing.confidence, nothing.doubtful_px) == (1, 0.0, None)


@pytest.mark.parametrize("level", [218, 232])
def test_a_thread_a_few_grey_levels_from_the_floor_is_followed(level: int):
    found = walk(drawn(wave(), noise=1.5, level=level, width=2), max_length=180.0)
    mean, share = line_error(found, wave())
    assert mean < 1.0
    assert share > 0.9


@pytest.mark.parametrize(
    ("begin", "turn", "loose"),
    [((300.0, 240.0), np.pi, False), ((300.0, 230.0), -1.7, False), ((300.0, 180.0), np.pi, True)],
)
def test_a_thread_is_loose_where_it_does_not_leave_the_needle(begin: tuple[float, float], turn: float, loose: bool):
    line = winding(np.full(100, turn), 150.0, begin)
    picture = prepare(drawn(line, width=2, level=80), 2)
    assert has_loose_thread(picture, NEEDLE, Wall((320.0, 240.0), 230.0), 100.0) == loose


@pytest.mark.parametrize("side", [np.s_[:, :30], np.s_[:, -30:], np.s_[:30], np.s_[-30:]])
def test_the_noise_that_a_ridge_is_held_to_is_that_away_from_a_windows_borders(side: tuple[slice, ...]):
    random = np.random.default_rng(3)
    window = np.clip(random.normal(200.0, 3.0, (240, 320)), 0.0, 255.0).astype(np.uint8)
    usual = darker_than_around(window)[1]
    window[side] = random.integers(0, 256, window[side].shape)
    assert darker_than_around(window)[1] == pytest.approx(usual, rel=0.06)


@pytest.mark.parametrize("pale", [False, True])
def test_a_faint_ridge_shows_what_is_darker_or_what_is_paler_by_units_of_noise(pale: bool):
    difference = np.array([[-2.0, -1.0, 0.0, 1.0, 2.0]], np.float32)  # positive where it is darker
    ridge = faint_ridge(difference, 4.0, np.zeros((1, 5), np.uint8), 1, 1, pale=pale)
    above = ridge.strength[0].astype(float) - ZERO
    assert above[2] == pytest.approx(0.0, abs=0.5)
    np.testing.assert_allclose(above[[0, 1, 3]], -above[4] * np.array([1.0, 0.5, -0.5]), atol=1.0)
    assert (above[4] < 0.0) == pale


def test_a_thread_is_measured_up_to_the_first_ambiguous_crossing():
    points, path = np.column_stack([np.arange(101.0), np.zeros(101)]), np.zeros((51, 6))
    path[:, 5] = np.arange(51.0)  # in an image of half the size
    no_ridge: Any = None
    for confidences, length in (((0.95, 0.99), 100.0), ((0.95, 0.5), 60.0), ((0.5, 0.5), 40.0)):
        crossings = tuple(Crossing(first, first + 3, each) for first, each in zip((20, 30), confidences, strict=True))
        walk = Walk(points, 100.0, 50.0, no_ridge, path, np.ones(51, np.bool_), crossings)
        assert arc_lengths(certain_points(walk))[-1] == pytest.approx(length, abs=2.0)


def test_a_tail_at_the_border_of_the_frame_is_walked_from():
    for tail, angle in (((639.0, 240.0), np.pi), ((0.0, 240.0), 0.0), ((320.0, 479.0), -0.5 * np.pi)):
        needle = MeasuredNeedle(Arc(np.array(tail), angle, 0.0), 87.0, 5.0)
        search = ThreadSearch(
            prepare(drawn(np.array([[0.0, 0.0], [1.0, 0.0]])), 2), needle, 400.0, (320.0, 240.0), 400.0
        )
        assert len(search.wide().points) >= 1


def ridge_along(*lines: Points, width: float = 1.2) -> np.ndarray:
    """Return a ridge of 100 above nothing along lines, shape (160, 200)."""
    image = np.zeros((160, 200), np.uint8)
    for line in lines:
        cv2.polylines(image, [np.round(line * 16.0).astype(np.int32)], False, 255, 1, cv2.LINE_AA, 4)
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), width)
    return np.rint(100.0 * smooth / smooth.max()).astype(np.uint8)


BARE = np.zeros((160, 200), np.uint8)
DISH = (100.0, 80.0, 200.0)


def walked(ridge: np.ndarray, hidden: np.ndarray, factor: int, dish: tuple[float, float, float]) -> np.ndarray:
    """Return the vertices of a walk to the right from (20, 80), shape (m, 2)."""
    path, strong = np.zeros((200, 6)), np.zeros(200, np.bool_)
    path[0] = 20.0, 80.0, 0.0, 0.0, 80.0, 0.0
    count, _ = walk_on(ridge, hidden, factor, 0.0, 10.0, 1.0, dish, 300.0, path, strong, 1, 9.0, np.empty((0, 3)))
    return path[:count, :2]


def test_a_walk_ends_where_the_thread_ends_and_goes_farther_below_what_hides_it():
    gap = ridge_along(np.array([[10.0, 80.0], [90.0, 80.0]]), np.array([[120.0, 80.0], [170.0, 80.0]]))
    hidden = np.zeros((80, 100), np.uint8)
    assert walked(gap, hidden, 2, DISH)[-1] == pytest.approx((91.0, 80.0), abs=2.0)
    hidden[:, 45:60] = 255
    assert walked(gap, hidden, 2, DISH)[-1] == pytest.approx((171.0, 80.0), abs=2.0)


def test_a_walk_ends_at_the_wall_but_may_come_in_from_beyond_it():
    ridge = ridge_along(np.array([[10.0, 80.0], [190.0, 80.0]]))
    assert walked(ridge, BARE, 1, (100.0, 80.0, 60.0))[-1, 0] == pytest.approx(160.0, abs=2.0)
    assert walked(ridge, BARE, 1, (120.0, 80.0, 60.0))[-1, 0] == pytest.approx(180.0, abs=2.0)


def test_a_pixel_of_what_hides_is_about_the_middle_of_those_that_it_is_shrunk_from():
    hidden = np.zeros((4, 5), np.uint8)
    hidden[2, 1] = 255
    for u, v, expected in ((2.6, 5.6, True), (5.4, 8.4, True), (2.4, 7.0, False), (5.6, 7.0, False), (4.0, 5.4, False)):
        assert is_hidden(hidden, 3, u, v) == expected
    hidden[:] = 255
    for u, v in ((-0.6, 5.0), (14.6, 5.0), (5.0, -0.6), (5.0, 11.6)):
        assert not is_hidden(hidden, 3, u, v)


@pytest.mark.parametrize("half", [0, 2])
def test_vertices_beside_a_thread_are_moved_onto_it(half: int):
    line, along = np.array([[20.0, 30.0], [160.0, 120.0]]), np.array([0.841, 0.541])
    ridge = ridge_along(line)
    on = line[0] + np.arange(10.0, 150.0, 2.0)[:, None] * along
    points = on + 0.8 * np.array([-along[1], along[0]])
    strong = np.ones(len(points), np.bool_)
    refine(ridge, 0.0, points, strong, half)
    aside = (points - line[0]) @ (-along[1], along[0])
    assert aside[0] == pytest.approx(0.8, abs=0.05)
    assert np.abs(aside[3:-3]).max() < 0.3


@pytest.mark.parametrize("bend", [0.0, 0.1, -0.1])
@pytest.mark.parametrize("angle", [0.5, 2.4, -1.2])
def test_a_way_out_of_the_tail_leads_along_what_leaves_it_also_from_below_the_needle(angle: float, bend: float):
    line = winding(angle + bend * np.linspace(0.0, 40.0, 100), 40.0, (100.0, 80.0))
    ridge, ways = ridge_along(line), np.empty((5, 6))
    start, hidden = np.array([100.0, 80.0, 3.0]), BARE.copy()
    assert ways_out(ridge, hidden, 1, 0.0, 20.0, start, 0.0, False, ways, 20.0) > 0
    assert np.cos(ways[0, 0] - angle) > np.cos(0.2)
    assert ways[0, 1:3] == pytest.approx((bend, 3.0), abs=0.03)
    assert ways[0, 3] > 50.0
    assert ways_out(ridge, hidden, 1, 0.0, 20.0, start, 0.0, True, ways, 20.0) > 0
    cv2.circle(hidden, (100, 80), 12, 255, -1)
    assert ways_out(ridge, hidden, 1, 0.0, 20.0, start, 20.0, False, ways, 20.0) > 0
    assert 11.0 < ways[0, 2] < 20.0
    assert ways_out(ridge, hidden, 1, 0.0, 20.0, start, 6.0, False, ways, 20.0) == 0


def test_a_path_begins_along_its_way_out():
    path, strong = np.zeros((50, 6)), np.zeros(50, np.bool_)
    start, way = np.array([100.0, 80.0, 3.0]), np.array([0.5, 0.02, 20.0, 70.0, 60.0, np.pi])
    count = begin_path(BARE, 0.0, start, way, 20.0, path, strong)
    assert path[count - 1, 5] == pytest.approx(20.0, abs=2.0)
    assert (path[0, :2] == start[:2]).all()
    np.testing.assert_allclose(path[1:count, 2], 0.5 + 0.02 * path[1:count, 5])
    np.testing.assert_allclose(path[1:count, 3], 0.02)
    np.testing.assert_allclose(path[:count, :2], Arc(start[:2], 0.5, 0.02).at(path[:count, 5]), atol=0.01)


def test_a_path_is_worth_what_it_shows_of_the_thread_once_and_less_where_it_is_unsteady():
    there = np.column_stack([np.arange(0.0, 41.0, 2.0), np.zeros(21)])
    path, strong = np.zeros((41, 6)), np.ones(41, np.bool_)
    path[:, :2], path[:, 5] = np.vstack([there, np.add(there[-2::-1], (0.0, 0.5))]), 2.0 * np.arange(41)
    assert worth(path, strong, 21) == pytest.approx(40.0)
    assert worth(path, strong, 41) == pytest.approx(46.0, abs=4.0)
    assert worth_of_whole(path, strong, 21, 30.0, 2.0) == pytest.approx(40.0 - 2.0 * (40.0 - 0.975 * 30.0))
    strong[5:10] = False
    path[15:, 3] = 0.1
    assert worth(path, strong, 21) == pytest.approx(40.0 - 10.0 - 12.0 * 0.1)


def test_strands_meet_where_more_than_two_cross_a_ring_of_which_nothing_is_hidden():
    line, across = np.array([[10.0, 80.0], [190.0, 80.0]]), np.array([[100.0, 20.0], [100.0, 140.0]])
    path = np.zeros((80, 6))
    path[:, 0], path[:, 1], path[:, 4] = np.arange(20.0, 180.0, 2.0), 80.0, 100.0
    near, meets = np.abs(path[:, 0] - 100.0), np.empty(80, np.bool_)
    fork = across.copy()
    fork[0, 1] = 80.0
    for other, expected in ((across, True), (fork, True), (line, False)):
        strands_meet(ridge_along(line, other), BARE, 1, 0.0, 10.0, path, meets)
        assert meets[near < 3.0].all() == expected
        assert not meets[near > 10.0].any()
    hidden = BARE.copy()
    hidden[70, 100] = 255
    strands_meet(ridge_along(line, across), hidden[::2, ::2].copy(), 2, 0.0, 10.0, path, meets)
    assert meets.any()
    hidden[72:76, 96:104] = 255
    strands_meet(ridge_along(line, across), hidden, 1, 0.0, 10.0, path, meets)
    assert not meets[near < 3.0].any()


EAST, WEST = np.array([[100.0, 90.0], [180.0, 90.0]]), np.array([[100.0, 90.0], [40.0, 90.0]])
TURNS = np.linspace(0.0, np.pi, 40)
BEND = 35.0 * np.column_stack([np.sin(TURNS), np.cos(TURNS)])
RETURN = np.vstack([EAST[0], np.add((140.0, 55.0), BEND), (60.0, 55.0) - BEND, (99.0, 90.0)])


@pytest.mark.parametrize(
    ("walk", "seen", "hides", "passes"),
    [
        (EAST, (EAST,), False, False),
        (EAST, (EAST, WEST), False, True),
        (EAST, (EAST, WEST), True, False),
        (RETURN, (RETURN,), False, False),
    ],
    ids=["leaves", "passes", "hidden", "returns"],
)
def test_a_line_passes_the_tail_where_it_goes_on_behind_it_unless_the_walk_came_back_there(
    walk: Points, seen: tuple[Points, ...], hides: bool, passes: bool
):
    hidden = BARE.copy()
    hidden[:, :97] = 255 * hides
    ridge = Ridge(ridge_along(*seen), hidden, 1, 1, 0.0, 10.0, 10.0, signed=False)
    assert joins_passing_line(respaced(walk, 2.0), ridge, (0, 0)) == passes
