"""The job that tracks frames, and the one that calibrates the camera."""

from __future__ import annotations

import json
import shutil
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from benchmarks.vision.measurements import frame_of
from magnetosuture_thread import cli
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.evaluation.recorded import read_image
from magnetosuture_thread.settings.interface import COMPRESSED_IMAGE
from test.bags.bags import copy_with_notes
from test.shared import known
from test.vision.scenes import rod
from test.vision.test_images import oriented_jpeg

SAMPLES = Path(__file__).parents[1] / "vision" / "samples"


def error_of(capsys: pytest.CaptureFixture[str]) -> str:
    """Return what went to stderr, which must be one line."""
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    return text


def test_pictures_give_one_entry_each(tmp_path: Path):
    folder = tmp_path / "frames"
    folder.mkdir()
    for index in (0, 3):
        shutil.copy(SAMPLES / f"frame_0{index}.png", folder)
    (folder / "frame_01.png").write_bytes(b"no picture")
    (folder / "notes.txt").write_text("not a frame")
    cv2.imwrite(str(folder / "frame_09.jpg"), np.full((480, 640, 3), 90, np.uint8))
    file, overlay = tmp_path / "seen.json", tmp_path / "drawn"
    given = ["--metres-per-pixel", "8e-5", "--centre", "322", "238", "--overlay", str(overlay)]
    pictures = sorted(str(path) for path in folder.glob("frame_*"))
    assert cli.main(["track", *pictures, "--json", str(file), *given]) == 0
    rows = json.loads(file.read_text())
    assert [row["file"] for row in rows] == ["frame_00.png", "frame_01.png", "frame_03.png", "frame_09.jpg"]
    assert [row["status"] for row in rows] == ["tracked", "lost", "tracked", "lost"]
    truth = json.loads((SAMPLES / "truth.json").read_text())["frames"]
    np.testing.assert_allclose(rows[0]["tail_m"], np.array(truth[0]["tail_mm"]) * 1e-3, atol=5e-5)
    assert rows[0]["heading_rad"] == pytest.approx(truth[0]["heading_rad"], abs=0.02)
    assert len(rows[0]["thread_m"]) > 50
    assert rows[0]["reason"] is rows[0]["stamp_s"] is None
    assert "a JPEG or PNG image" in rows[1]["reason"]
    assert rows[1]["tail_m"] is rows[1]["heading_rad"] is rows[1]["tip_m"] is rows[1]["thread_m"] is None
    assert sorted(picture.name for picture in overlay.iterdir()) == ["frame_00.png", "frame_03.png", "frame_09.png"]


def test_in_a_folder_of_pictures_that_do_not_follow_each_other_each_is_searched(tmp_path: Path):
    """The needle jumps by more than it can go, and comes back."""
    truth = json.loads((SAMPLES / "truth.json").read_text())["frames"]
    (tmp_path / "frames").mkdir()
    order = [0, 2, 0, 3, 1, 3, 0]
    for number, index in enumerate(order):
        shutil.copy(SAMPLES / f"frame_0{index}.png", tmp_path / "frames" / f"{number}.png")
    assert cli.main(["track", str(tmp_path / "frames"), "--json", str(tmp_path / "found.json")]) == 0
    rows = json.loads((tmp_path / "found.json").read_text())
    tails = np.array([truth[index]["tail_mm"] for index in order])
    np.testing.assert_allclose(1e3 * np.array([row["tail_m"] for row in rows]), tails, atol=0.05)


def test_a_needle_without_a_thread_has_an_axis_and_a_pose_once_its_tip_is_given(tmp_path: Path):
    picture = tmp_path / "rod.png"
    cv2.imwrite(str(picture), rod(ENDS))
    for tip, tail in ((None, None), (ENDS[1], ENDS[0]), (ENDS[0], ENDS[1]), (np.array([0.012, 0.002]), None)):
        given = [] if tip is None else ["--tip", *map(str, tip)]
        (row,) = seen_in([picture], tmp_path / "seen.json", *given)
        assert np.array(sorted(row["axis_m"])) == pytest.approx(ENDS, abs=2e-4)
        assert row["dish_centre_px"] == pytest.approx([322.0, 238.0], abs=0.5)
        if tail is None:
            assert row["status"] == "lost"
            assert "the needle's axis is found, but not which end is the tip" in row["reason"]
            assert row["tail_m"] is None
        else:
            assert row["status"] == "tracked"
            assert row["tail_m"] == pytest.approx(tail, abs=2e-4)
            assert row["tip_m"] == pytest.approx(tip, abs=2e-4)


ENDS = np.array([[-0.004, 0.002], [0.003, 0.002]])


def seen_in(pictures: list[Path], file: Path, *given: str) -> list[dict[str, Any]]:
    """Return what `track` writes of pictures."""
    assert cli.main(["track", *map(str, pictures), "--json", str(file), *given]) in (0, 1)
    return list(json.loads(file.read_text()))


def test_who_gets_no_needle_is_told_what_would_admit_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    picture, drawn = tmp_path / "rod.png", tmp_path / "drawn"
    cv2.imwrite(str(picture), rod(ENDS))
    (row,) = seen_in([picture], tmp_path / "seen.json", "--needle", "0.011", "0.0004", "--overlay", str(drawn))
    assert row["axis_m"] is None
    assert len(row["refused"]) == 1
    assert "if it is the needle, set needle_length 0.00" in row["refused"][0]
    assert "needle_width" not in row["refused"][0]
    assert "if it is the needle, set needle_length" in capsys.readouterr().out
    red, green = (np.asarray(cv2.imread(str(drawn / "rod.png")))[200:225, :, channel].astype(int) for channel in (2, 1))
    assert (red - green > 60).sum() > 50  # its outline
    length = row["refused"][0].split("needle_length ")[1]
    (row,) = seen_in([picture], tmp_path / "seen.json", "--needle", length, "0.0004")
    assert row["axis_m"] is not None
    assert row["refused"] == []
    cv2.imwrite(str(picture), rod(ENDS, level=150))
    (row,) = seen_in([picture], tmp_path / "seen.json")
    share = row["refused"][0].split("max_needle_brightness ")[1]
    (row,) = seen_in([picture], tmp_path / "seen.json", "--needle-brightness", share)
    assert row["axis_m"] is not None


def test_the_tip_is_kept_until_it_is_used_and_its_loss_is_said(tmp_path: Path):
    files = [tmp_path / "frames" / f"{index}.png" for index in range(6)]
    files[0].parent.mkdir()
    for index, file in enumerate(files):
        frame = rod(np.add(ENDS, (0.0, 0.0001 * index)))
        if index in (0, 2):  # nothing to see, and before the pose is confirmed
            cv2.circle(frame, (322, 213), 110, (200, 200, 200), -1)
        cv2.imwrite(str(file), frame)
    for given in (["--tip", "0.003", "0.002"], ["--tip-px", "359.5", "213"]):
        rows = seen_in([files[0].parent], tmp_path / "seen.json", *given)
        assert rows[-1]["status"] == "tracked"
        assert rows[-1]["tip_m"] == pytest.approx([0.003, 0.0025], abs=2e-4)
    rows = seen_in([files[0].parent], tmp_path / "seen.json", "--tip", "0.012", "-0.002")
    lost = ["the point at the tip is too old, or farther" in (row["warning"] or "") for row in rows]
    assert lost == [False, True, False, False, False, False]
    assert rows[-1]["tip_m"] is None


def test_what_calibrate_camera_writes_suffices_to_track(tmp_path: Path):
    files = [tmp_path / "frames" / f"{index}.png" for index in range(10)]
    files[0].parent.mkdir()
    for index, file in enumerate(files):
        ends = np.array([[-0.004, 0.004 - 0.001 * index], [0.001, 0.004 - 0.001 * index]])
        cv2.imwrite(str(file), np.hstack([np.full((480, 200, 3), 120, np.uint8), rod(ends)]))
    camera = tmp_path / "camera.yaml"
    command = ["calibrate-camera", str(files[0].parent), "--dish-diameter", "0.035", "--needle", "0.005", "0.0004"]
    assert cli.main([*command, "--region", "200", "0", "840", "480", "--output", str(camera)]) == 0
    rows = seen_in(files, tmp_path / "seen.json", "--setup", str(camera), "--dish-diameter", "0.035")
    assert all(row["axis_m"] is not None for row in rows)


def test_a_setup_is_read_for_what_the_tracker_needs_of_it_alone(tmp_path: Path):
    setup, picture = tmp_path / "thick.yaml", tmp_path / "rod.png"
    setup.write_text("/**: {ros__parameters: {scene: dish_35mm, needle_width: 0.0012}}\n")  # more than twice keep_out
    cv2.imwrite(str(picture), rod(ENDS))
    assert len(seen_in([picture], tmp_path / "seen.json", "--setup", str(setup))) == 1


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_pictures_are_seen_and_drawn_as_viewers_show_them(orientation: int, tmp_path: Path):
    stored = {1: None, 3: cv2.ROTATE_180, 6: cv2.ROTATE_90_COUNTERCLOCKWISE, 8: cv2.ROTATE_90_CLOCKWISE}[orientation]
    frame = rod(ENDS)
    picture, drawn = tmp_path / "phone.jpg", tmp_path / "drawn"
    picture.write_bytes(oriented_jpeg(frame if stored is None else cv2.rotate(frame, stored), orientation))
    (row,) = seen_in([picture], tmp_path / "seen.json", "--tip-px", "359.5", "213", "--overlay", str(drawn))
    assert row["dish_centre_px"] == pytest.approx([322.0, 238.0], abs=0.5)
    assert row["tip_m"] == pytest.approx(ENDS[1], abs=2e-4)
    assert np.asarray(cv2.imread(str(drawn / "phone.png"))).shape == frame.shape


def test_a_part_of_a_frame_is_looked_at_and_a_bright_needle_is_found(tmp_path: Path):
    cv2.imwrite(str(tmp_path / "pair.png"), np.hstack([rod(ENDS, level=150)] * 2))
    file = tmp_path / "seen.json"
    given = ["--region", "640", "0", "1280", "480", "--tip", *map(str, ENDS[1]), "--json", str(file)]
    for options, status in ((["--needle-brightness", "0.9"], "tracked"), ([], "lost")):
        assert cli.main(["track", str(tmp_path / "pair.png"), *given, *options]) == (status != "tracked")
        (row,) = json.loads(file.read_text())
        assert row["dish_centre_px"] == pytest.approx([962.0, 238.0], abs=0.5)
        assert row["status"] == status
    camera = tmp_path / "camera.yaml"
    calibrated = ["calibrate-camera", str(tmp_path / "pair.png"), *given[:5], "--dish-diameter", "0.035"]
    assert cli.main([*calibrated, "--output", str(camera)]) == 0
    again = ["--setup", str(camera), "--scene", "dish_35mm", "--json", str(file)]
    assert cli.main(["track", str(tmp_path / "pair.png"), *again]) == 1  # the needle is bright
    assert json.loads(file.read_text())[0]["dish_centre_px"] == pytest.approx([962.0, 238.0], abs=0.5)


def test_a_bag_is_followed_over_time(short_bag: Path, tmp_path: Path):
    video, file = tmp_path / "seen.mp4", tmp_path / "seen.json"
    assert cli.main(["track", str(short_bag), "--overlay", str(video), "--json", str(file)]) == 0
    rows = json.loads(file.read_text())
    assert [row["status"] for row in rows] == ["searching"] * 2 + ["tracked"] * 28
    row = rows[5]
    assert row["file"].startswith("/camera/image_raw/compressed ")
    assert row["stamp_s"] == pytest.approx(1.0 + 5 / 30.0, abs=1e-6)
    np.testing.assert_allclose(row["tail_m"], [0.003 + 0.003 * 5 / 30.0, 0.002], atol=8e-5)
    assert video.stat().st_size > 1000
    capture = cv2.VideoCapture(str(video))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(30.0, abs=0.01)
    capture.release()


def images_of(bag: Path, count: int) -> list[np.ndarray]:
    """Return the first camera frames of a bag."""
    records = Recording(Bag(bag)).records([COMPRESSED_IMAGE])
    return [read_image(record) for record in islice(records, count)]


def tracked_over_time(given: list[str], file: Path) -> list[dict[str, Any]]:
    """Return the rows of 12 frames of a needle that moves, which must be followed at 15 frames a second."""
    assert cli.main(["track", *given, "--json", str(file)]) == 0
    rows: list[dict[str, Any]] = json.loads(file.read_text())
    assert [row["status"] for row in rows] == ["searching"] * 2 + ["tracked"] * 10
    assert [row["stamp_s"] for row in rows] == pytest.approx(np.arange(12) / 15.0)
    tails = np.array([row["tail_m"] for row in rows[2:]])
    np.testing.assert_allclose(tails, [(0.003 + 0.003 * index / 30.0, 0.002) for index in range(2, 12)], atol=8e-5)
    return rows


def test_a_folder_is_followed_over_time_in_the_order_of_its_numbers(
    short_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "frames").mkdir()
    for number, image in enumerate(images_of(short_bag, 12), 1):
        cv2.imwrite(str(tmp_path / "frames" / f"frame_{number}.png"), image)
    rows = tracked_over_time([str(tmp_path / "frames"), "--rate", "15"], tmp_path / "seen.json")
    assert [row["file"] for row in rows] == [f"frame_{number}.png" for number in range(1, 13)]
    assert "is read as a video of 15 frames/s" in " ".join(capsys.readouterr().out.split())
    assert cli.main(["track", str(tmp_path / "frames" / "frame_1.png"), "--rate", "15"]) == 1
    assert "--rate has no meaning" in error_of(capsys)
    # Pictures of several sizes are of no one camera: each is searched for itself.
    cv2.imwrite(str(tmp_path / "frames" / "frame_2.png"), np.full((720, 960, 3), 90, np.uint8))
    assert cli.main(["track", str(tmp_path / "frames"), "--json", str(tmp_path / "seen.json")]) == 0
    assert {row["stamp_s"] for row in json.loads((tmp_path / "seen.json").read_text())} == {None}


def test_a_folder_of_pictures_that_do_not_follow_one_another_is_searched_one_by_one(tmp_path: Path, capsys):
    shutil.copytree(SAMPLES, tmp_path / "frames")
    rows = seen_in([tmp_path / "frames"], tmp_path / "seen.json")
    assert [(row["status"], row["stamp_s"]) for row in rows] == [("tracked", None)] * 5
    truth = json.loads((SAMPLES / "truth.json").read_text())["frames"]
    for row, true in zip(rows, truth, strict=True):
        np.testing.assert_allclose(row["tail_m"], np.array(true["tail_mm"]) * 1e-3, atol=1e-4)
    assert "is no video, as its needle jumps" in " ".join(capsys.readouterr().out.split())


def test_a_video_is_followed_over_time_and_one_that_is_cut_off_is_reported(
    short_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    film = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter.fourcc(*"MJPG"), 15.0, (640, 480))
    for image in images_of(short_bag, 12):
        writer.write(image)
    writer.release()
    rows = tracked_over_time([str(film)], tmp_path / "seen.json")
    assert [row["file"] for row in rows[:2]] == ["film.avi 0.000000", "film.avi 0.066667"]
    film.write_bytes(film.read_bytes()[: film.stat().st_size * 2 // 3])
    assert cli.main(["track", str(film)]) == 0
    assert "film.avi is damaged" in capsys.readouterr().out.replace("\n", "")


def test_paths_without_frames_are_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file.mcap").write_bytes(b"")
    cases = {"nowhere": "does not exist", "empty": "holds no pictures", "file.mcap": "is empty, expected an mcap file"}
    cases["film.mp4"] = "cannot be read as a video"
    (tmp_path / "film.mp4").write_bytes(b"no film")
    for name, words in cases.items():
        assert cli.main(["track", str(tmp_path / name)]) == 1
        assert words in error_of(capsys)


def test_a_lens_from_a_file_is_undone_before_the_camera_is_calibrated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    case, image = frame_of("distortion", 2, 31)
    seen = known(case.lens)
    values = {"rows": 3, "cols": 3, "data": list(seen.matrix)}
    coefficients = {"rows": 1, "cols": 5, "data": list(seen.coefficients)}
    info = {"image_width": case.size[0], "image_height": case.size[1], "camera_matrix": values}
    info |= {"distortion_model": seen.model, "distortion_coefficients": coefficients}
    frame, lens, output = tmp_path / "frame.png", tmp_path / "lens.yaml", tmp_path / "camera.yaml"
    cv2.imwrite(str(frame), image)
    lens.write_text(yaml.safe_dump(info))
    given = ["--dish-diameter", "0.035", "--output", str(output)]
    for options, error in ((["--camera-info", str(lens)], 3e-3), ([], 0.1)):
        assert cli.main(["calibrate-camera", str(frame), *given, *options]) == 0
        scale = yaml.safe_load(output.read_text())["/**/vision_tracker"]["ros__parameters"]["metres_per_pixel"]
        assert scale == pytest.approx(case.view.metres_per_pixel, rel=error)
    assert scale != pytest.approx(case.view.metres_per_pixel, rel=6e-3)
    lens.write_text(yaml.safe_dump(info | {"image_width": 1280}))
    assert cli.main(["calibrate-camera", str(frame), *given, "--camera-info", str(lens)]) == 1
    assert "camera_info.width" in error_of(capsys)


def test_what_is_wrong_with_a_bag_is_said_and_stands_in_the_files_made_from_it(
    short_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    copy_with_notes(short_bag, tmp_path / "bag", unverified="salvaged without checksums")
    file, camera = tmp_path / "seen.json", tmp_path / "camera.yaml"
    renamed = ["--remap", "/camera/image_raw/compressed:=/camera/image_raw"]
    assert cli.main(["track", str(tmp_path / "bag"), "--json", str(file), *renamed]) == 0
    assert {row["unverified"] for row in json.loads(file.read_text())} == {"salvaged without checksums"}
    given = [str(tmp_path / "bag"), "--dish-diameter", "0.035", "--output", str(camera)]
    assert cli.main(["calibrate-camera", *given]) == 0
    assert camera.read_text().startswith("# UNVERIFIED: salvaged without checksums\n/**")
    assert "is unverified: salvaged without checksums" in " ".join(capsys.readouterr().out.split())
