"""The job that tracks frames, and the one that calibrates the camera."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from magnetosuture_thread import cli
from magnetosuture_thread.errors import BagError, InvalidInputError
from magnetosuture_thread.jobs.calibrate_camera import calibrate_camera
from magnetosuture_thread.jobs.track import settings_with, track
from magnetosuture_thread.vision.look import State
from magnetosuture_thread.vision.settings import VisionTrackerSettings

SAMPLES = Path(__file__).parents[1] / "vision" / "samples"
KEYS = {
    *("file", "status", "reason", "tail_m", "heading_rad", "tip_m", "curvature_per_m", "thread_m"),
    *("confidence", "time_s", "stamp_s"),
}


def error_of(capsys: pytest.CaptureFixture[str]) -> str:
    """Return what went to stderr, which must be one line."""
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    return text


def test_a_folder_of_pictures_gives_one_entry_each(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    frames = tmp_path / "frames"
    frames.mkdir()
    for index in (0, 3):
        shutil.copy(SAMPLES / f"frame_0{index}.png", frames)
    (frames / "frame_01.png").write_bytes(b"no picture")
    (frames / "notes.txt").write_text("not a frame")
    cv2.imwrite(str(frames / "frame_09.jpg"), np.full((480, 640, 3), 90, np.uint8))
    file, overlay = tmp_path / "seen.json", tmp_path / "drawn"
    given = ["--metres-per-pixel", "8e-5", "--centre", "322", "238", "--overlay", str(overlay)]
    assert cli.main(["track", str(frames), "--json", str(file), *given]) == 0
    rows = json.loads(file.read_text())
    assert [row["file"] for row in rows] == ["frame_00.png", "frame_01.png", "frame_03.png", "frame_09.jpg"]
    assert [row["status"] for row in rows] == ["tracked", "lost", "tracked", "lost"]
    assert all(set(row) == KEYS for row in rows)
    truth = json.loads((SAMPLES / "truth.json").read_text())["frames"]
    np.testing.assert_allclose(rows[0]["tail_m"], np.array(truth[0]["tail_mm"]) * 1e-3, atol=5e-5)
    assert rows[0]["heading_rad"] == pytest.approx(truth[0]["heading_rad"], abs=0.02)
    assert len(rows[0]["thread_m"]) > 50
    assert rows[0]["time_s"] > 0.0
    assert rows[0]["reason"] is rows[0]["stamp_s"] is None
    assert "a JPEG or PNG image" in rows[1]["reason"]
    assert rows[1]["tail_m"] is rows[1]["heading_rad"] is rows[1]["tip_m"] is rows[1]["thread_m"] is None
    assert sorted(picture.name for picture in overlay.iterdir()) == ["frame_00.png", "frame_03.png", "frame_09.png"]
    assert "2 tracked, 2 lost" in capsys.readouterr().out


def test_single_files_are_taken_in_their_order():
    seen = track([SAMPLES / "frame_03.png", SAMPLES / "frame_00.png"], VisionTrackerSettings())
    assert [frame.name for frame in seen] == ["frame_03.png", "frame_00.png"]
    assert all(frame.track.state is State.TRACKED for frame in seen)


def test_a_bag_is_followed_over_time(short_bag: Path, tmp_path: Path):
    video = tmp_path / "seen.mp4"
    seen = track([short_bag], VisionTrackerSettings(), overlay=video)
    assert [frame.track.state for frame in seen] == [State.SEARCHING] * 2 + [State.TRACKED] * 28
    row = seen[5].to_json()
    assert row["file"].startswith("/camera/image_raw/compressed ")
    assert row["stamp_s"] == pytest.approx(1.0 + 5 / 30.0, abs=1e-6)
    np.testing.assert_allclose(row["tail_m"], [0.003 + 0.003 * 5 / 30.0, 0.002], atol=8e-5)
    assert video.stat().st_size > 1000


@pytest.mark.parametrize(
    ("name", "words"),
    [("nowhere", "does not exist"), ("empty", "holds no pictures"), ("file.mcap", "is empty, expected an mcap file")],
)
def test_paths_without_frames_are_refused_in_one_line(
    name: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file.mcap").write_bytes(b"")
    assert cli.main(["track", str(tmp_path / name)]) == 1
    assert words in error_of(capsys)


def test_a_bag_among_pictures_is_refused(short_bag: Path):
    with pytest.raises(BagError, match="expected it alone"):
        track([SAMPLES / "frame_00.png", short_bag], VisionTrackerSettings())


def test_what_of_the_view_is_given_is_taken():
    settings = settings_with(VisionTrackerSettings(), 9e-5, (320.0, 240.0))
    assert (settings.metres_per_pixel, settings.dish_centre_px) == (9e-5, (320.0, 240.0))
    assert settings_with(settings, None, None) == settings


@pytest.mark.parametrize("wrong", [["--centre", "1"], ["--metres-per-pixel", "0"], ["--json", "/no/such/x.json"]])
def test_wrong_use_is_2(wrong: list[str], capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        cli.main(["track", str(SAMPLES), *wrong])
    assert ended.value.code == 2
    assert capsys.readouterr().err


def test_a_calibration_is_written_as_parameters(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "camera.yaml"
    assert cli.main(["calibrate-camera", str(SAMPLES), "--dish-diameter", "0.035", "--output", str(file)]) == 0
    assert "5 frames" in capsys.readouterr().out
    assert cli.main(["track", str(SAMPLES), "--setup", str(file), "--json", str(tmp_path / "seen.json")]) == 0
    assert {row["status"] for row in json.loads((tmp_path / "seen.json").read_text())} == {"tracked"}


def test_frames_that_show_no_dish_or_no_markers_calibrate_nothing(tmp_path: Path):
    cv2.imwrite(str(tmp_path / "plain.png"), np.full((480, 640, 3), 90, np.uint8))
    with pytest.raises(InvalidInputError, match="with a dish"):
        calibrate_camera([tmp_path / "plain.png"], 0.035, tmp_path / "camera.yaml")
    with pytest.raises(InvalidInputError, match="no marker 0, 1, 2, 3"):
        calibrate_camera([tmp_path / "plain.png"], 0.035, tmp_path / "camera.yaml", (0.05, 0.005))
    (tmp_path / "broken.png").write_bytes(b"")
    with pytest.raises(BagError, match="no frame that can be read"):
        calibrate_camera([tmp_path / "broken.png"], 0.035, tmp_path / "camera.yaml")
    assert not (tmp_path / "camera.yaml").exists()
