"""The simulated rig: currents in, frames out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape
from magnetosuture_thread.rig.rig import Rig
from magnetosuture_thread.rig.settings import RigSettings
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError
from test.shared import known

EASTWARDS = np.array([4.0, 0.0, -2.0, 0.0])


def scene(*geometries: Disc | Polygon, diameter: float = 0.035) -> Scene:
    """Return a dish with shapes."""
    return Scene(Dish(diameter), tuple(SceneShape(f"shape_{n}", "instrument", one) for n, one in enumerate(geometries)))


def rig(*geometries: Disc | Polygon, diameter: float = 0.035, **changes: Any) -> Rig:
    """Return a rig whose needle points east, with a straight thread behind it, among shapes."""
    settings = RigSettings(**{"needle_start": (0.003, 0.0, 0.0), "thread_segments": 20, **changes})
    return Rig(settings, scene(*geometries, diameter=diameter))


def test_currents_move_the_needle_and_the_frame_shows_where_it_is():
    made = rig()
    before = made.look(0.0)
    made.apply(EASTWARDS, 0.1)
    for time in np.arange(0.2, 0.7, 0.1):
        made.apply(EASTWARDS, time)
    after = made.look(0.7)
    assert after.tail[0] > before.tail[0] + 1e-3
    assert abs(after.tail[1]) < 1e-5
    np.testing.assert_allclose(after.thread[0], after.tail)
    where = made.camera.view.to_pixels(after.tail + 0.0035 * np.array([np.cos(after.heading), np.sin(after.heading)]))
    assert known(after.image)[round(where[1]), round(where[0])].max() < 120
    assert known(before.image)[round(where[1]), round(where[0])].max() < 255


def test_a_bent_thread_straightens_behind_a_needle_that_is_held_until_the_first_current_and_pulled_then():
    made = rig(thread_start_curvature=-60.0)
    made.is_watched = False
    np.testing.assert_array_equal(made.look(0.1).thread, made.look(0.0).thread)
    made = rig(thread_start_curvature=-60.0)
    before, after = made.look(0.0), made.look(0.5)
    ends = [float(np.linalg.norm(frame.thread[-1] - frame.thread[0])) for frame in (before, after)]
    assert ends[1] > ends[0] + 1e-4
    np.testing.assert_allclose([*after.tail, after.heading], [*before.tail, before.heading], atol=1e-12)
    assert after.time == 0.5
    made.apply(1e-9 * EASTWARDS, 0.5)
    assert np.abs(made.look(1.5).tail - after.tail).max() > 1e-6


def test_a_stuck_coil_keeps_its_current_whatever_it_is_told():
    made = rig(faults=("coil_stuck 0.1 1.0",))
    made.apply(EASTWARDS, 0.4)
    made.apply(np.zeros(4), 0.6)
    assert made.currents.tolist() == [4.0, 0.0, 0.0, 0.0]
    made.advance(1.4)
    assert made.currents[0] == 4.0
    made.apply(np.zeros(4), 1.6)
    assert made.currents.tolist() == [0.0] * 4


def test_the_power_stage_has_a_limit():
    made = rig(coil_max_current=5.0)
    made.apply(np.array([1e160, -80.0, 3.0, 0.0]), 0.0)
    assert made.currents.tolist() == [5.0, -5.0, 3.0, 0.0]
    assert np.all(np.isfinite(made.look(0.05).tail))


def test_a_stopped_camera_gives_no_image_but_the_truth():
    made = rig(faults=("camera_stopped 0 1",))
    made.apply(EASTWARDS, 0.0)
    frame = made.look(0.5)
    assert frame.image is None
    assert frame.tail.shape == (2,)
    assert made.look(1.5).image is not None


@pytest.mark.parametrize(
    "currents", [np.zeros(3), np.array([np.nan, 0.0, 0.0, 0.0]), np.array([0.0, np.inf, 0.0, 0.0])]
)
def test_bad_currents_are_refused_and_the_last_stay(currents: np.ndarray):
    made = rig()
    made.apply(EASTWARDS, 0.0)
    with pytest.raises(InvalidInputError, match="4 finite numbers"):
        made.apply(currents, 0.1)
    assert made.currents.tolist() == EASTWARDS.tolist()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"needle_start": (0.0, 0.0)}, "a multiple of 3"),
        ({"needle_curvature": 500.0}, "a half circle"),
        ({"needle_length": 1.5e-3, "needle_width": 1e-3}, "at least two widths"),
        ({"obstacle_looks": ("gold",)}, "one of silicone, tissue, hernia"),
        ({"thread_attachment": "sewn"}, "pinned, clamped"),
        ({"power_stage": "roboclaw", "power_stage_ports": ("/tmp/a",)}, "a path for two of the 4 coils"),
    ],
)
def test_settings_that_make_no_rig_are_refused(changes: dict[str, Any], words: str):
    with pytest.raises(ConfigurationError, match=words):
        RigSettings(**changes)


@pytest.mark.parametrize(
    ("shapes", "changes", "words"),
    [
        ((), {"needle_start": (0.012, 0.0, 0.0)}, "a needle in the dish, off the obstacles: it would be in wall"),
        ((), {"needle_start": (0.0, 0.0, 0.0)}, "a thread in the dish, off the obstacles: it would be in wall"),
        ((Disc((-0.005, 0.0), 0.002),), {}, "a thread in the dish, off the obstacles: it would be in shape_0"),
        ((Disc((-0.00501, 0.0), 1e-6),), {}, "a thread in the dish"),  # between two points of the thread
        ((Polygon(((0.005, -0.01), (0.007, -0.01), (0.006, 0.001))),), {}, "a needle in the dish, off the obstacles"),
        ((), {"obstacle_looks": ("tissue",)}, "one for each of the scene's 0 shapes"),
    ],
)
def test_a_start_or_looks_that_do_not_fit_the_scene_are_refused(
    shapes: tuple[Disc | Polygon, ...], changes: dict[str, Any], words: str
):
    with pytest.raises(ConfigurationError, match=words):
        rig(*shapes, **changes)


def push(made: Rig, begin: float, end: float) -> np.ndarray:
    """Push the needle east for a while; return its tip."""
    for time in np.arange(begin, end, 0.1):
        made.apply(EASTWARDS, float(time))
    frame = made.look(end)
    return np.asarray(frame.tail + 0.007 * np.array([np.cos(frame.heading), np.sin(frame.heading)]))


def test_new_scene_changes_contact_camera_image_and_dish():
    made = rig()
    plain = known(made.look(0.0).image)
    made.set_scene(scene(Disc((0.0135, 0.0), 0.001), diameter=0.04))
    assert push(made, 0.1, 3.0)[0] == pytest.approx(0.0125, abs=3e-4)  # 0.0175 m without the post
    drawn = known(made.look(3.0).image)
    u, v = made.camera.view.to_pixels(np.array([0.0135, 0.0])).round().astype(int)
    assert drawn[v, u].sum() < plain[v, u].sum() - 15
    assert made.camera.view.metres_per_pixel == pytest.approx(0.04 / (0.9115 * 480))
    assert made.faults.lifted(0.0).tolist() == [0.0, 0.0]
    made.set_scene(scene(diameter=0.04))
    assert push(made, 3.1, 8.0)[0] > 0.0190


def test_a_power_stage_that_hears_nothing_switches_off():
    made = rig(driver_timeout=0.2)
    made.apply(EASTWARDS, 0.0)
    made.advance(0.2)
    there = made.look(0.2).tail
    made.advance(0.21)
    assert made.currents.tolist() == [0.0] * 4
    np.testing.assert_allclose(made.look(2.0).tail, there, atol=2e-5)
