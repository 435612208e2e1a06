"""Settings of the coil bridge: what fits together, and where the needle may be."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape
from magnetosuture_thread.settings.errors import ConfigurationError


@pytest.mark.parametrize(("keep_out", "pose_margin"), [(0.001, 0.0), (0.0007, 0.0003)])
def test_the_filter_has_dish_shapes_keep_out_and_pose_margin(keep_out: float, pose_margin: float):
    settings = CoilBridgeSettings(keep_out=keep_out, pose_margin=pose_margin, approach_rate=2.0)
    post = SceneShape("post", "instrument", Disc((-0.006, 0.0), 0.001))
    safety, east = settings.safety_filter(Scene(Dish(0.035), (post,))), np.array([1.0, 0.0])
    assert safety.clearance(np.array([0.0, 0.0]), east) == pytest.approx(0.005)
    assert safety.hold_time == pytest.approx(0.205)
    found = safety.filter(np.array([0.02, 0.0]), np.array([0.0085, 0.0]), east).filtered
    np.testing.assert_allclose(found, [2.0 * 0.001, 0.0], atol=1e-5)


def test_scene_too_narrow_for_the_needle_is_rejected():
    with pytest.raises(ConfigurationError, match=r"scene\.dish\.diameter: .* more than 0\.008 m, room for the needle"):
        CoilBridgeSettings().safety_filter(Scene(Dish(0.0079)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"keep_out": 0.00015},
            r"coil_bridge\.keep_out: got 0\.00015, .* 0\.0002 m, half of coil_bridge\.needle_width",
        ),
        ({"max_speed": 0.5}, r"coil_bridge\.max_speed: got 0\.5, .* max_speed x \(driver_timeout \+ 1 / rate\)"),
        ({"driver_timeout": 1.0}, r"coil_bridge\.max_speed: got 0\.02, expected at most 0\.0124 m/s"),
        (
            {"rate": 15.0, "driver_timeout": 0.1, "command_timeout": 0.5, "pose_timeout": 0.5},
            r"coil_bridge\.driver_timeout: got 0\.1, expected at least 0\.133333 s, 2 periods",
        ),
        ({"approach_rate": 250.0}, r"coil_bridge\.approach_rate: got 250\.0, expected at most .* 200 1/s"),
        ({"coil_angles": (0.0, 1.0)}, "at least 3 coils"),
        ({"calibration": "nowhere.yaml"}, r"coil_bridge\.calibration, nowhere\.yaml: coil calibration: .*No such file"),
        ({"rate": 10.0}, "4 periods of the loop"),
        ({"roboclaw_answer_timeout": 0.02}, r"coil_bridge\.roboclaw_answer_timeout"),
    ],
)
def test_what_does_not_fit_together_is_refused(change: dict, words: str):
    with pytest.raises(ConfigurationError, match=words):
        CoilBridgeSettings(**change)


def test_where_its_motion_is_compensated_a_needle_has_drag_beside_that_of_the_thread():
    CoilBridgeSettings(motion_compensation=True, needle_drag=0.02, thread_drag=0.0179)
    with pytest.raises(ConfigurationError, match=r"thread_drag: got 0\.0181, expected at most 0\.018 N s/m, 0\.9 of"):
        CoilBridgeSettings(motion_compensation=True, needle_drag=0.02, thread_drag=0.0181)
