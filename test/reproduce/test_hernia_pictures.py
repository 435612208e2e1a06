"""The pictures of a steered run."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from magnetosuture_thread.configuration import from_mapping
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.reproduce.hernia import (
    HerniaRun,
    RecordedCommands,
    draw_animation,
    draw_hernia,
    point_filter,
    replay_steering,
)
from magnetosuture_thread.scene import Dish, Scene, SceneShape
from magnetosuture_thread.thread_model.settings import ThreadModelSettings


def run() -> HerniaRun:
    """Draw a needle through a gate."""
    settings = from_mapping(ThreadModelSettings, {"friction_threshold": 1.2e-3})
    line = np.column_stack([-np.linspace(0.0, 0.019, 50), np.zeros(50)])
    times = np.arange(60) / 20.0
    posts = tuple(SceneShape(f"post_{k}", "tissue", Disc((0.004, y), 0.001)) for k, y in enumerate((0.0018, -0.0018)))
    needle = point_filter(Scene(Dish(0.05), posts), 5e-4, 10.0)
    return replay_steering(settings, line, RecordedCommands(times, np.tile([3e-3, 0.0], (60, 1))), needle)


def test_picture_and_animation_show_the_run(tmp_path: Path):
    made = run()
    draw_hernia(tmp_path / "hernia.png", made)
    picture = cv2.imread(str(tmp_path / "hernia.png"))
    assert picture is not None
    assert min(picture.shape[:2]) > 1000
    for blue, green, red in ((84, 158, 31), (80, 166, 240)):  # a free thread, and one under friction, in BGR
        assert (np.abs(picture.astype(int) - (blue, green, red)).max(axis=2) < 40).sum() > 50
    draw_animation(tmp_path / "hernia.gif", made)
    frames = cv2.VideoCapture(str(tmp_path / "hernia.gif"))
    first, second = frames.read(), frames.read()
    assert first[0]
    assert second[0]
    assert np.abs(first[1].astype(int) - second[1]).max() > 100
