"""The simulated camera beside frames of another renderer: figures, and a picture for a person to look at."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.rig.camera import CameraScene, DishCamera

SAMPLES = Path(__file__).parents[1] / "vision" / "samples"
TRUTH = json.loads((SAMPLES / "truth.json").read_text())
VIEW = DishView((TRUTH["u0"], TRUTH["v0"]), TRUTH["mm_per_px"] * 1e-3)


def rendered(frame: dict, camera: DishCamera) -> np.ndarray:
    """Render what a sample frame shows."""
    thread = VIEW.to_dish(np.array(frame["thread_px"]))
    return camera.render(VIEW.to_dish(np.array(frame["tail_px"])), frame["heading_rad"], thread)


def sample(frame: dict) -> np.ndarray:
    """Read a sample frame."""
    image = cv2.imread(str(SAMPLES / frame["file"]))
    assert image is not None
    return image


@pytest.fixture(scope="module")
def camera() -> DishCamera:
    """A camera that looks where that of the samples does."""
    return DishCamera(CameraScene(), VIEW, seed=4)


@pytest.mark.parametrize("frame", TRUTH["frames"], ids=lambda frame: frame["file"])
def test_light_noise_needle_and_thread_are_those_of_the_samples(frame: dict, camera: DishCamera):
    theirs, ours = sample(frame).astype(float), rendered(frame, camera).astype(float)
    places = {"floor": np.s_[190:290, 230:270], "left of the floor": np.s_[220:260, 130:150], "table": np.s_[:15, :40]}
    for name, place in places.items():
        assert np.median(ours[place]) == pytest.approx(np.median(theirs[place]), abs=18.0), name
    noise = [np.std(image[150:180, 250:290] - cv2.blur(image[150:180, 250:290], (3, 3))) for image in (theirs, ours)]
    assert noise[1] == pytest.approx(noise[0], rel=0.7)
    tail, tip = np.array(frame["tail_px"]), np.array(frame["tip_px"])
    column, row = np.round(tail + 0.5 * (tip - tail)).astype(int)
    body = [image[row, column, 1] for image in (theirs, ours)]
    assert body[1] == pytest.approx(body[0], abs=25.0)
    depths = [thread_depth(image[:, :, 1], np.array(frame["thread_px"])) for image in (theirs, ours)]
    assert depths[1] == pytest.approx(depths[0], rel=0.35)


def thread_depth(gray: np.ndarray, line: np.ndarray) -> float:
    """Return by how much the thread is darker than what is 5 px beside it, the mean along it."""
    along = np.gradient(line[5:-5], axis=0)
    across = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]

    def at(points: np.ndarray) -> np.ndarray:
        return cv2.remap(gray.astype(np.float32), points.astype(np.float32)[:, None], None, cv2.INTER_LINEAR)[:, 0]

    return float(np.median(0.5 * (at(line[5:-5] + 5 * across) + at(line[5:-5] - 5 * across)) - at(line[5:-5])))
