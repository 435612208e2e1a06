"""Where the needle's blunt end is measured along its axis, at random places between pixels and headings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.vision.cases import SIZES, usual_case
from benchmarks.vision.frames import DISH_RADIUS, ROWS, render
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.scene.scene import Dish
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import VisionTracker

FRAMES = 24
DRAWN_LARGER_PX = 0.12  # by which the rig's camera draws all solids too large, on each side; in its own pixels


@pytest.mark.parametrize("columns", [640, 1280])
def test_the_tail_is_neither_too_far_back_nor_too_far_ahead(columns: int):
    ahead = []
    for number in range(FRAMES):
        random = np.random.default_rng([columns, number])
        size = SIZES[columns]
        case = replace(
            usual_case(random), size=size, thread_px=0.975 * size[1] / ROWS, shift=tuple(random.uniform(-1.0, 1.0, 2))
        )
        settings = VisionTrackerSettings(
            needle_length=case.needle.length,
            needle_width=case.needle.width,
            thread_length=0.019,
            metres_per_pixel=case.view.metres_per_pixel,
            dish_centre_px=case.view.centre_px,
        )
        track = VisionTracker(settings, Scene(dish=Dish(2.0 * DISH_RADIUS))).look(render(case, number))
        assert len(track.tail), track.reason
        along = np.array([np.cos(case.needle.heading), np.sin(case.needle.heading)])
        ahead.append(float((track.tail - case.needle.tail) @ along) / case.working_scale)
    assert abs(np.mean(ahead) + DRAWN_LARGER_PX) < 0.05
    assert np.std(ahead) < 0.12
