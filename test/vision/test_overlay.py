"""Pictures of what was seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.vision.overlay import OverlayWriter, draw_overlay
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import VisionTracker
from test.vision.scenes import SCENE, VIEW, Pose, render

TRACKER = VisionTracker(VisionTrackerSettings(), SCENE)


def test_needle_and_state_are_drawn_where_they_are():
    pose = Pose(np.array([0.002, 0.001]), 0.4, 110.0)
    frame = render(pose)
    drawn = draw_overlay(frame, TRACKER.look(frame), 0.007, "a frame")
    assert drawn.shape == frame.shape
    u, v = np.round(VIEW.to_pixels(pose.at(0.5))).astype(int)
    changed = np.abs(drawn.astype(int) - frame).sum(axis=2)
    assert changed[v - 2 : v + 3, u - 2 : u + 3].max() > 100
    assert changed[-20:].mean() > 20
    lost = draw_overlay(frame[:, :, 1], TRACKER.look(0 * frame), 0.007)
    assert lost.shape == frame.shape


def test_what_cannot_be_written_is_refused(tmp_path: Path):
    with pytest.raises(BagError, match="in no folder that exists"):
        OverlayWriter(tmp_path / "nowhere" / "seen.mp4")
    (tmp_path / "file").write_text("")
    with pytest.raises(BagError, match="cannot be made"):
        OverlayWriter(tmp_path / "file" / "folder")
