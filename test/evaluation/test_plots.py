"""The picture of a replayed bag."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from magnetosuture_thread.evaluation.frames import FrameResult
from magnetosuture_thread.evaluation.graph_outputs import ReplaySummary
from magnetosuture_thread.evaluation.metrics import RunMetrics
from magnetosuture_thread.evaluation.plots import MARGIN_COLOURS, Photo, draw_summary
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.thread.margins import BarrierMargins, Margins

NODES = np.column_stack([0.004 - 0.00076 * np.arange(26), np.zeros(26)])


def run(clearance: float) -> RunMetrics:
    """Return two frames with all nodes at one distance from an obstacle."""
    metrics, count = RunMetrics(0.019), len(NODES) if np.isfinite(clearance) else 0
    distances = np.full(count, clearance)
    nodes, obstacles = np.arange(count, dtype=np.uint32), np.zeros(count, np.int32)
    margins = Margins((BarrierMargins("obstacle", nodes, obstacles, distances, distances),))
    for k in (1, 2):
        seen = NODES + np.array([0.0, 0.0004 * k])
        frame = FrameResult(k * 10**9, NODES, strain=1e-6, margins=margins, measured=seen, tail=NODES[0], heading=0.0)
        metrics.add(frame)
    return metrics


def draw(path: Path, view, clearance: float, discs: tuple[Disc, ...] = (), name: str = "bag") -> np.ndarray:
    """Draw a picture and return its pixels, red, green, blue."""
    found = run(clearance)
    chosen = found.worst_measured
    assert chosen is not None
    assert chosen.stamp == 2 * 10**9
    summary = ReplaySummary(name, "petri", "all", 2, 2, 2, 0, 0, {}, None, [], 0, 1e-6, 1e-9, 1.0, None, None)
    photo = Photo(np.full((480, 640, 3), 225, np.uint8), view)
    draw_summary(path, photo, replace(chosen, obstacles=discs), 2.0, summary)
    image = cv2.imread(str(path))
    assert image is not None
    return image[:, :, ::-1]


def share(image: np.ndarray, colour: tuple[float, ...]) -> float:
    """Return the share of the dish's pixels that are near a colour, in 0 to 1."""
    dish = image[90:600, 60:660].astype(float) / 255.0
    return float((np.abs(dish - np.asarray(colour[:3])).max(axis=2) < 0.06).mean())


@pytest.mark.parametrize("name", ["a$\\x$b", "a\x1b[31mb"])
def test_a_bag_of_any_name_is_drawn(tmp_path: Path, view, name: str):
    assert draw(tmp_path / "a.png", view, 5e-3, name=name).size


@pytest.mark.parametrize("clearance", [0.0, 0.5e-3, 5e-3])
def test_the_predicted_thread_has_the_colour_of_its_margin(tmp_path: Path, view, clearance: float):
    image = draw(tmp_path / "a.png", view, clearance, (Disc((0.0, 0.009), 0.002),))
    shares = [share(image, MARGIN_COLOURS(c)) for c in (0.0, 0.5, 1.0)]
    assert int(np.argmax(shares)) == {0.0: 0, 0.5e-3: 1, 5e-3: 2}[clearance]
    assert max(shares) > 5e-4
