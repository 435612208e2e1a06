"""Pictures of what was seen."""

from __future__ import annotations

from pathlib import Path

import cv2
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


def test_a_folder_gets_png_files(tmp_path: Path):
    with OverlayWriter(tmp_path / "new" / "folder") as writer:
        writer.write("one", np.zeros((60, 80, 3), np.uint8))
    written = cv2.imread(str(tmp_path / "new" / "folder" / "one.png"))
    assert written is not None
    assert written.shape == (60, 80, 3)


def test_a_video_gets_every_frame(tmp_path: Path):
    file = tmp_path / "seen.avi"
    with OverlayWriter(file) as writer:
        for _ in range(3):
            writer.write("frame", np.full((65, 81, 3), 90, np.uint8))
        writer.write("larger", np.full((130, 160, 3), 90, np.uint8))
    video = cv2.VideoCapture(str(file))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == 4
    video.release()


def test_what_cannot_be_written_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(BagError, match="in no folder that exists"):
        OverlayWriter(tmp_path / "nowhere" / "seen.mp4")
    (tmp_path / "file").write_text("")
    with pytest.raises(BagError, match="cannot be made"):
        OverlayWriter(tmp_path / "file" / "folder")
    monkeypatch.setattr(cv2.VideoWriter, "fourcc", lambda *letters: 0)
    monkeypatch.setattr("magnetosuture_thread.vision.overlay.cv2.VideoWriter.isOpened", lambda self: False)
    with pytest.raises(BagError, match="name a folder for PNG files"), OverlayWriter(tmp_path / "seen.mp4") as writer:
        writer.write("frame", np.zeros((64, 80, 3), np.uint8))
