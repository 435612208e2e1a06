"""The public API: what the package offers from its root."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import magnetosuture_thread
from magnetosuture_thread import Disc, NeedlePose, Scene, ThreadPredictor


def test_every_name_that_is_offered_can_be_imported():
    for name in magnetosuture_thread.__all__:
        assert getattr(magnetosuture_thread, name).__doc__
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = magnetosuture_thread.no_such_name


def test_nothing_is_imported_before_it_is_used():
    code = "import sys, magnetosuture_thread; print(sorted({'numpy', 'numba', 'osqp', 'rclpy'} & set(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", code], check=True, timeout=300, capture_output=True, text=True)
    assert found.stdout.strip() == "[]"


def test_a_thread_is_predicted_around_a_post_in_a_few_lines():
    scene = Scene.create(dish_diameter=0.035, shapes={"post": Disc((-0.006, 0.003), 0.0025)})
    predictor = ThreadPredictor.create("polyamide_7_0", length=0.012, segments=25, scene=scene)
    east = np.array([1.0, 0.0])
    predictor.start(NeedlePose(0.0, np.zeros(2), east))
    for k in range(1, 100):
        prediction = predictor.step(NeedlePose(k / 30.0, np.array([0.0, 8e-5 * k]), east))
    assert prediction.margins["obstacle"].minimum > -1e-7
    assert prediction.margins["obstacle"].minimum < 1e-5
    assert prediction.margins.in_contact
    assert prediction.margins["wall"].minimum > 0.0
    assert prediction.margins.scene_version == scene.version
