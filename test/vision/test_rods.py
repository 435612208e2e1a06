"""Needles that are blunt or rounded at both ends: their axis is found, their direction is never guessed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import pytest

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.scene import Dish, Scene
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import UNDIRECTED, State, Track, VisionTracker
from test.shared import known

DIAMETER = 0.05  # m
RATE = 30.0


@dataclass(frozen=True)
class Rod:
    """A rod in a drawn photograph of 640 x 480 pixels.

    Attributes:
        seed: of dish, light, place, size and noise.
        rounded: whether its ends are half discs.
        gleam: grey levels by which the lamp's line along it is brighter than the rod.
        share: of its width, of the dish's diameter.
        turned: by how much more it is turned [rad].
        bend: angle by which it turns from end to end, from u towards v [rad].
    """

    seed: int
    rounded: bool = False
    gleam: float = 0.0
    share: float = 0.02
    turned: float = 0.0
    bend: float = 0.0

    def drawn(self) -> tuple[np.ndarray, np.ndarray, VisionTrackerSettings]:
        """Return the picture, the rod's ends (u, v), shape (2, 2) [px], and what the tracker is told."""
        random = np.random.default_rng(self.seed)
        radius, centre = random.uniform(182.0, 220.0), np.array([320.0, 240.0]) + random.uniform(-8.0, 8.0, 2)
        u, v = np.meshgrid(np.arange(640) - centre[0], np.arange(480) - centre[1])
        away = np.hypot(u, v) / radius
        picture = random.uniform(150.0, 225.0) + random.uniform(-12.0, 12.0) * u / radius
        for ring, depth in ((1.02, random.uniform(40.0, 90.0)), (1.07, random.uniform(20.0, 70.0))):
            picture -= depth * np.exp(-(((away - ring) / 0.012) ** 2))
        width = self.share * 2.0 * radius * random.uniform(0.8, 1.2)
        length = width * random.uniform(8.0, 14.0)
        angle = random.uniform(-np.pi, np.pi) + self.turned
        ahead, place = np.array([math.cos(angle), math.sin(angle)]), random.uniform(-0.45, 0.45, 2) * radius
        x, y = (
            (u - place[0]) * ahead[0] + (v - place[1]) * ahead[1],
            (v - place[1]) * ahead[0] - (u - place[0]) * ahead[1],
        )
        if self.bend:  # along and aside of an arc through the middle
            k = self.bend / length
            x, y = np.arctan2(k * x, 1.0 - k * y) / k, (1.0 - np.hypot(k * x, 1.0 - k * y)) / k
        outside = np.maximum(np.abs(x) - 0.5 * length, np.abs(y) - 0.5 * width)
        if self.rounded:
            outside = np.hypot(np.maximum(np.abs(x) - 0.5 * (length - width), 0.0), y) - 0.5 * width
        picture *= 1.0 - 0.18 * np.clip(0.5 - (outside + 3.0) / 4.0, 0.0, 1.0)  # its shadow
        covered = np.clip(0.5 - outside, 0.0, 1.0)
        steel = 40.0 + self.gleam * np.exp(-(((y + 0.15 * width) / (0.18 * width)) ** 2))
        noise = np.random.default_rng([self.seed, int(1e6 * abs(self.turned))]).standard_normal(picture.shape)
        picture = cv2.GaussianBlur(picture + covered * (steel - picture), (0, 0), 0.9) + 2.5 * noise
        scale = 0.5 * DIAMETER / radius
        told = VisionTrackerSettings(needle_length=1.03 * length * scale, needle_width=0.95 * width * scale)
        half, aside = 0.5 * self.bend, np.array([-ahead[1], ahead[0]])
        chord = 0.5 * length * np.array([-ahead, ahead]) * np.sinc(half / np.pi)
        ends = centre + place + chord + 0.5 * length * math.sin(0.5 * half) * np.sinc(0.5 * half / np.pi) * aside
        return np.clip(picture, 0.0, 255.0).astype(np.uint8), ends, told


def is_along(seen: Track, ends: np.ndarray, share: float = 0.06) -> bool:
    """Say whether tail and tip lie at two ends (u, v), in this order, within 2 px and a share of their distance."""
    apart = np.abs(known(seen.view).to_pixels(seen.axis) - ends).max()
    return bool(apart < 2.0 + share * math.dist(*ends))


FOURTH = Rod(4)


@pytest.mark.slow
@pytest.mark.parametrize("rounded", [False, True])
@pytest.mark.parametrize(("gleam", "least"), [(0.0, 10), (40.0, 9), (90.0, 4)])
def test_the_axis_is_found_and_a_point_near_the_tip_gives_its_direction(rounded: bool, gleam: float, least: int):
    found = 0
    for seed in range(12):
        image, ends, told = Rod(seed, rounded, gleam, (0.012, 0.02, 0.04)[seed % 3]).drawn()
        tracker = tracker_of(told)
        seen = tracker.look(image)
        assert seen.state is not State.TRACKED
        if not len(seen.axis):
            continue
        found += 1
        assert seen.reason == UNDIRECTED
        assert seen.covariance[2, 2] > 1.0
        assert is_along(seen, ends) or is_along(seen, ends[::-1])
        for way in (ends, ends[::-1]):
            tracker.point_at_tip(known(seen.view).to_dish(way[1]))
            told_seen = tracker.look(image)
            assert told_seen.state is State.TRACKED
            assert is_along(told_seen, way)
            assert told_seen.covariance[2, 2] < 1.0
        assert tracker.look(image).reason == UNDIRECTED  # the next picture is another
    assert found >= least


def tracker_of(told: VisionTrackerSettings, **changes: Any) -> VisionTracker:
    """Return a tracker in the dish of the pictures."""
    return VisionTracker(replace(told, **changes), Scene(dish=Dish(DIAMETER)))


def rod_in_view(rod: Rod = FOURTH) -> tuple[np.ndarray, np.ndarray, VisionTracker, DishView]:
    """Return a picture of a rod, its ends (u, v) [px], a tracker that has looked at it, and its view."""
    image, ends, told = rod.drawn()
    tracker = tracker_of(told)
    return image, ends, tracker, known(tracker.look(image).view)


def with_thread(seed: int) -> tuple[np.ndarray, np.ndarray, VisionTracker]:
    """Return a picture of a rod, its ends, and a tracker that is told of a thread of 120 px."""
    image, ends, _, view = rod_in_view(Rod(seed))
    return image, ends, tracker_of(Rod(seed).drawn()[2], thread_length=120.0 * view.metres_per_pixel)


def test_a_direction_is_carried_over_while_the_rod_turns_round_and_not_over_a_gap_in_which_it_could():
    image, ends, tracker, view = rod_in_view()
    assert tracker.track(image, 0.0).reason == UNDIRECTED
    tracker.point_at_tip(view.to_dish(ends[1]))
    tracked = 0
    for index in range(1, 50):  # by 3.9 rad
        image, ends, _ = Rod(4, turned=0.08 * index).drawn()
        seen = tracker.track(image, index / RATE)
        tracked += seen.state is State.TRACKED
        assert seen.state is not State.TRACKED or is_along(seen, ends)
    assert tracked >= 46
    for index in range(4):  # whichever end comes first in such a frame, those after it do not follow from that
        after = 49 / RATE + 0.6 + index / RATE
        assert tracker.track(Rod(4, turned=0.01 + 0.08 * 49 + 1e-5 * index).drawn()[0], after).reason == UNDIRECTED


@pytest.mark.parametrize("turned", [0.0, 2.2, 3.1])
@pytest.mark.parametrize("seed", [4, 7])
def test_what_turned_in_a_gap_is_never_tracked_by_the_order_of_its_ends(seed: int, turned: float):
    _, ends, tracker, view = rod_in_view(Rod(seed))
    tracker.point_at_tip(view.to_dish(ends[1]))
    for index in range(5):
        seen = tracker.track(Rod(seed, turned=1e-5 * index).drawn()[0], index / RATE)
    assert seen.state is State.TRACKED
    for index in range(20, 24):
        seen = tracker.track(Rod(seed, turned=turned + 1e-5 * index).drawn()[0], 0.5 + index / RATE)
        assert seen.reason == UNDIRECTED


@pytest.mark.parametrize("bend", [-1.0, 1.0, 2.0, 3.2])
def test_a_bent_rod_whose_tip_was_pointed_at_is_tracked_that_way(bend: float):
    _, ends, tracker, view = rod_in_view(Rod(4, bend=bend))
    tracker.point_at_tip(view.to_dish(ends[1]))
    for index in range(8):
        seen = tracker.track(Rod(4, bend=bend, turned=1e-5 * index).drawn()[0], index / RATE)
        assert index < 3 or seen.state is State.TRACKED
        assert seen.state is not State.TRACKED or is_along(seen, ends)


def test_a_point_far_from_both_ends_and_one_that_was_used_tell_nothing():
    image, ends, tracker, view = rod_in_view()
    across = np.array([ends[0, 1] - ends[1, 1], ends[1, 0] - ends[0, 0]])
    for place, state in (
        (ends[1] + 0.8 * across, State.LOST),
        (ends[1], State.TRACKED),
        (ends.mean(axis=0), State.LOST),
    ):
        tracker.point_at_tip(view.to_dish(place))
        assert tracker.look(image).state is state
        assert tracker.look(image).reason == UNDIRECTED


def test_a_rod_elsewhere_may_have_turned_round_unseen_and_has_no_direction():
    image, ends, tracker, view = rod_in_view()
    tracker.point_at_tip(view.to_dish(ends[1]))
    frames = [tracker.track(Rod(4, turned=1e-6 * index).drawn()[0], index / RATE) for index in range(9)]
    assert frames[-1].state is State.TRACKED
    half_turn = cv2.getRotationMatrix2D(view.centre_px, 180.0, 1.0)
    turned = cv2.warpAffine(image, half_turn, image.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    after = [tracker.track(turned, index / RATE) for index in range(9, 20)]
    assert all(seen.state is not State.TRACKED for seen in after)
    assert after[-1].reason == UNDIRECTED


def test_a_point_is_of_its_time():
    image, ends, tracker, view = rod_in_view()
    for time, until, reason in ((2.0, 1.9, UNDIRECTED), (2.1, 2.2, "a needle seen in 1 of 3 frames")):
        tracker.point_at_tip(view.to_dish(ends[1]), until)
        assert tracker.track(image, time).reason == reason


def with_line(image: np.ndarray, ends: np.ndarray, length: float, *, beyond: float = 0.0) -> np.ndarray:
    """Return a picture with a winding dark line of a length that leaves the first end of a rod [px].

    `beyond` is how far it goes on under the rod and out of its other end, as a line drawn on the floor does.
    """
    back = (ends[0] - ends[1]) / math.dist(*ends)
    along = np.arange(0.0, length, 1.0)
    angle = math.atan2(back[1], back[0]) + 0.5 * np.sin(along / 25.0)
    line = ends[0] + np.cumsum(np.column_stack([np.cos(angle), np.sin(angle)]), axis=0)
    if beyond:
        line = np.vstack([(ends[1] - beyond * back)[None], ends[0][None], line])
    drawn = np.full_like(image, 255)
    cv2.polylines(drawn, [np.round(line * 16.0).astype(np.int32)], False, 110, 2, cv2.LINE_AA, 4)
    return np.minimum(image, cv2.GaussianBlur(drawn, (0, 0), 0.7))


@pytest.mark.parametrize("length", [60.0, 120.0])
@pytest.mark.parametrize("end", [0, 1])
def test_a_person_tells_the_tip_of_a_rod_that_a_line_leaves(length: float, end: int):
    image, ends, tracker, view = rod_in_view()
    way = ends if end else ends[::-1]
    tracker.point_at_tip(view.to_dish(way[1]))
    seen = [tracker.track(with_line(image, ends, length), 0.03 * index) for index in range(4)]
    assert seen[-1].state is State.TRACKED
    assert is_along(seen[-1], way)


def test_a_point_tells_no_direction_once_the_needle_is_forgotten():
    _, ends, tracker, view = rod_in_view()
    tracker.point_at_tip(view.to_dish(ends[1]))
    frames = [Rod(4, turned=1e-6 * index).drawn()[0] for index in range(4)]
    assert [tracker.track(frame, index / RATE) for index, frame in enumerate(frames)][-1].state is State.TRACKED
    assert [tracker.track(frame, 20.0 + index / RATE).reason for index, frame in enumerate(frames)] == [UNDIRECTED] * 4


@pytest.mark.parametrize("seed", [3, 5, 6])
def test_a_line_that_leaves_one_end_tells_the_direction_only_if_it_is_the_whole_thread(seed: int):
    image, ends, tracker = with_thread(seed)
    own = tracker.look(with_line(image, ends, 120.0))
    assert own.state is State.TRACKED
    assert is_along(own, ends)
    for length, beyond in ((170.0, 0.0), (70.0, 0.0), (120.0, 30.0)):
        seen = tracker.look(with_line(image, ends, length, beyond=beyond))
        assert seen.reason == UNDIRECTED
        assert is_along(seen, ends) or is_along(seen, ends[::-1])


def test_each_frame_that_confirms_a_direction_must_tell_it_itself():
    image, ends, tracker = with_thread(4)
    threaded = with_line(image, ends, 120.0)
    reasons = [
        tracker.track(frame, index / RATE).reason for index, frame in enumerate([threaded, image, image, threaded])
    ]
    assert reasons == ["a needle seen in 1 of 3 frames", UNDIRECTED, UNDIRECTED, "a needle seen in 2 of 3 frames"]
    assert tracker.track(threaded, 4 / RATE).state is State.TRACKED
    assert tracker.track(image, 5 / RATE).state is State.TRACKED  # the tracked past tells it from now on


def test_a_rod_of_which_a_bright_mark_hides_a_corner_has_no_direction_with_any_size_near_its_own():
    found = 0
    for seed in range(8):
        image, ends, told = Rod(seed, share=0.035).drawn()
        width = told.needle_width / 0.95 / DIAMETER * 400.0  # px, about
        ahead = (ends[1] - ends[0]) / math.dist(*ends)
        aside = np.array([-ahead[1], ahead[0]])
        corner = ends[1] + 0.5 * width * aside
        far, near = corner + 2.0 * (ahead + aside), corner - 0.6 * width * ahead
        mark = np.array([far, near + 2.0 * aside, near, corner - 0.35 * width * aside + 2.0 * ahead])
        cv2.fillPoly(image, [np.round(mark * 16.0).astype(np.int32)], float(np.median(image)), cv2.LINE_AA, 4)
        for off in (0.95, 1.05):
            size = {"needle_length": off * told.needle_length, "needle_width": (2.0 - off) * told.needle_width}
            seen = tracker_of(told, **size).look(image)
            assert seen.state is not State.TRACKED
            found += len(seen.axis) > 0
    assert found >= 14
