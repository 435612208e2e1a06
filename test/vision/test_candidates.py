"""The matched filter in a dish with dimples and reflections: the axis of a rod, and nothing where there is none."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from magnetosuture_thread.vision.tracker import State
from test.shared import known
from test.vision.test_rods import Rod, is_along, tracker_of

pytestmark = pytest.mark.slow

SEEDS = range(16)


def dimpled(image: np.ndarray, seed: int, rod: np.ndarray | None = None) -> np.ndarray:
    """Return a picture with dark dimples all over the dish, and a bright bump over a rod's side, ends (u, v) [px]."""
    random, drawn = np.random.default_rng(seed), np.full(image.shape, 1.0, np.float32)
    for place in random.uniform(-0.6, 0.6, (30, 2)) * 200.0 + (320.0, 240.0):
        cv2.circle(drawn, tuple(np.round(place).astype(int).tolist()), 11, 0.78, -1, cv2.LINE_AA)
    steel = np.where(image < 80, 1.0, drawn)  # a dimple lies under it
    result = image * cv2.GaussianBlur(steel, (0, 0), 0.8)
    if rod is not None:
        ahead = (rod[1] - rod[0]) / math.dist(*rod)
        place = rod[0] + random.uniform(0.3, 0.7) * (rod[1] - rod[0]) + 7.0 * np.array([-ahead[1], ahead[0]])
        bump = np.zeros(image.shape, np.float32)
        cv2.circle(bump, tuple(np.round(place).astype(int).tolist()), 8, 1.0, -1, cv2.LINE_AA)
        result += cv2.GaussianBlur(bump, (0, 0), 0.8) * (235.0 - result)
    return np.clip(result, 0.0, 255.0).astype(np.uint8)


@pytest.mark.parametrize(("bend", "share"), [(0.0, 0.06), (0.4, 0.1), (-0.8, 0.1), (1.5, 0.1)])
def test_the_axis_is_found_among_dimples_and_beside_a_bump_that_hides_a_part(bend: float, share: float):
    found = 0
    for seed in SEEDS:
        image, ends, told = Rod(seed, share=0.03, bend=bend).drawn()
        seen = tracker_of(told).look(dimpled(image, seed, ends))
        assert seen.state is not State.TRACKED
        if len(seen.axis):
            found += 1
            assert is_along(seen, ends, share) or is_along(seen, ends[::-1], share)
    assert found >= 14


@pytest.mark.parametrize("what", ["dimples", "line", "bubbles", "glare"])
def test_a_dish_without_a_needle_gives_nothing(what: str):
    for seed in SEEDS:
        image, ends, told = Rod(seed, share=0.03).drawn()
        view = known(tracker_of(told).look(image).view)
        # The rod is painted out.
        bare, width = np.median(image), told.needle_width / view.metres_per_pixel
        cover = np.zeros(image.shape, np.uint8)
        first, last = (tuple(np.round(end).astype(int).tolist()) for end in ends)
        cv2.line(cover, first, last, 255, int(width) + 26)
        noise = np.random.default_rng(seed).normal(0.0, 2.5, image.shape)
        empty = np.clip(np.where(cover > 0, bare + noise, image), 0.0, 255.0).astype(np.uint8)
        random = np.random.default_rng(seed)
        if what == "line":  # as dark as the needle, longer, and thinner, as a thread is
            angle = np.cumsum(random.normal(0.0, 0.02, 220)) + random.uniform(-np.pi, np.pi)
            line = np.array(view.centre_px) + np.cumsum(np.column_stack([np.cos(angle), np.sin(angle)]), axis=0)
            line -= line.mean(axis=0) - view.centre_px
            cv2.polylines(empty, [np.round(line).astype(np.int32)], False, 40, max(1, int(0.3 * width)), cv2.LINE_AA)
        elif what == "bubbles":
            for place in random.uniform(-90.0, 90.0, (6, 2)) + view.centre_px:
                centre, size = tuple(np.round(place).astype(int).tolist()), int(random.uniform(6.0, 30.0))
                cv2.circle(empty, centre, size, 60, max(1, round(0.6 * width)), cv2.LINE_AA)
        elif what == "glare":
            for place in random.uniform(-100.0, 100.0, (6, 2)) + view.centre_px:
                cv2.ellipse(empty, (tuple(place.tolist()), (70.0, 9.0), float(random.uniform(0, 180))), 250, -1)
        else:
            empty = dimpled(empty, seed)
        for off in (0.95, 1.0, 1.05):
            assert not len(tracker_of(told, needle_length=off * told.needle_length).look(empty).axis), seed
