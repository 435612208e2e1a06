"""The picture of a replayed bag."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from magnetosuture_thread.evaluation.frames import FrameResult
from magnetosuture_thread.evaluation.metrics import RunMetrics
from magnetosuture_thread.evaluation.plots import MARGIN_COLOURS, Photo, draw_summary
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.thread.margins import BarrierMargins, Margins
from test.evaluation.runs import replay_summary

NODES = np.column_stack([0.004 - 0.00076 * np.arange(26), np.zeros(26)])


def run(clearance: float) -> RunMetrics:
    """Return two frames with all nodes at one distance from an obstacle."""
    metrics, count = RunMetrics(0.019), len(NODES) if np.isfinite(clearance) else 0
    distances = np.full(count, clearance)
    nodes, obstacles = np.arange(count, dtype=np.uint32), np.zeros(count, np.int32)
    margins = Margins((BarrierMargins("obstacle", nodes, obstacles, distances, distances),))
    for k in (1, 2):
        seen = NODES + np.array([0.0, 0.0004 * k])
        frame = FrameResult(k * 10**9, vertices=NODES, strain=1e-6, margins=margins, measured=seen)
        metrics.add(frame)
    return metrics


def draw(path: Path, view, clearance: float, discs: tuple[Disc, ...] = (), name: str = "bag") -> np.ndarray:
    """Draw a picture and return its pixels, red, green, blue."""
    found = run(clearance)
    chosen = found.worst_measured
    assert chosen is not None
    assert chosen.stamp == 2 * 10**9
    summary = replay_summary(bag=name, frames=2, tracked=2, predicted=2)
    photo = Photo(np.full((480, 640, 3), 225, np.uint8), view)
    draw_summary(path, photo, replace(chosen, obstacles=discs), 2.0, summary)
    image = cv2.imread(str(path))
    assert image is not None
    return image[:, :, ::-1]


def share(image: np.ndarray, colour: tuple[float, ...]) -> float:
    """Return the share of the dish's pixels that are near a colour, in 0 to 1."""
    dish = image[90:600, 60:660].astype(float) / 255.0
    return float((np.abs(dish - np.asarray(colour[:3])).max(axis=2) < 0.06).mean())


@pytest.mark.parametrize("clearance", [0.0, 0.5e-3, 5e-3])
def test_the_predicted_thread_has_the_colour_of_its_margin(tmp_path: Path, view, clearance: float):
    obstacles = (Disc((0.0, 0.009), 0.002),)
    image = draw(
        tmp_path / "a.png", view, clearance, obstacles, name="a$\\x$b\x1b[31m"
    )  # neither mathematics nor codes
    shares = [share(image, MARGIN_COLOURS(c)) for c in (0.0, 0.5, 1.0)]
    assert int(np.argmax(shares)) == {0.0: 0, 0.5e-3: 1, 5e-3: 2}[clearance]
    assert max(shares) > 5e-4
