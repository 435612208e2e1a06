"""What is compiled before the first frame."""

from __future__ import annotations

import pytest

from test.shared import run_python

SWEEP = """
import importlib, pkgutil
import numpy as np
import magnetosuture_thread.vision as vision
from benchmarks.vision.cases import CLASSES
from benchmarks.vision.frames import DISH_RADIUS
from benchmarks.vision.measurements import frame_of
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.geometry.scene import Dish
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import VisionTracker
from magnetosuture_thread.vision.tracker import warm_up

def signatures():
    found = {}
    for module in pkgutil.walk_packages(vision.__path__, vision.__name__ + "."):
        for value in vars(importlib.import_module(module.name)).values():
            if hasattr(value, "py_func"):
                found[value.py_func.__module__, value.py_func.__name__] = len(value.signatures)
    return found

assert warm_up()
before = signatures()
assert len(before) > 15
for number, name in enumerate(list(CLASSES)[::3]):
    case, image = frame_of(name, 0, 8)
    settings = VisionTrackerSettings(
        needle_length=case.needle.length, needle_width=case.needle.width, confirm_frames=1
    )
    tracker = VisionTracker(settings, Scene(dish=Dish(2.0 * DISH_RADIUS)))
    tracker.set_lens(case.lens)
    for at in (0.0, 0.04):  # the whole frame, and the part of it around the needle
        tracker.track(image if number % 5 else np.ascontiguousarray(image[:, :, 1]), at)
    after = signatures()
    gained = [key for key in after if after[key] != before[key]]
    assert not gained, f"{name}: {gained}"
"""


@pytest.mark.slow
def test_no_frame_compiles_anything_after_the_warm_up():
    # In a process of its own, as the other tests have compiled what they need.
    run_python("-c", SWEEP)
