"""The picture of a run."""

from __future__ import annotations

import io
import subprocess
import sys

import numpy as np
import pytest
from matplotlib.image import imread

from magnetosuture_thread.evaluation.frames import FrameResult
from magnetosuture_thread.evaluation.metrics import RunMetrics
from magnetosuture_thread.evaluation.plots import MARGIN_COLOURS, Photo, draw_metrics
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.thread.margins import BarrierMargins, Margins
from test.evaluation.runs import EVIL, LENGTH, NODES, made_metrics

DISH = np.s_[170:840, 30:700]  # pixels of the dish in the picture


def pixels(metrics: RunMetrics, photo: Photo | None = None, title: str = "bag") -> np.ndarray:
    """Draw a picture and return its pixels, red, green, blue, 0 to 1."""
    return imread(io.BytesIO(draw_metrics(metrics, title, 0.035, photo, "all of it")), format="png")[..., :3]


@pytest.mark.parametrize("clearance", [0.0, 0.5e-3, 5e-3])
def test_the_predicted_thread_has_the_colour_of_its_margin(view, clearance: float):
    metrics = RunMetrics(LENGTH)
    distances, nodes = np.full(26, clearance), np.arange(26, dtype=np.uint32)
    margins = Margins((BarrierMargins("obstacle", nodes, np.zeros(26, np.int32), distances, distances),))
    for k in (1, 2):
        seen, discs = NODES + np.array([0.0, 0.0004 * k]), (Disc((0.0, 0.009), 0.002),)
        metrics.add(FrameResult(k * 10**9, vertices=NODES, margins=margins, measured=seen, obstacles=discs))
    # Of a name neither mathematics nor codes are drawn.
    dish = pixels(metrics, Photo(np.full((480, 640, 3), 225, np.uint8), view), "a$\\x$b\x1b[31m")[DISH]
    shares = [(np.abs(dish - MARGIN_COLOURS(c)[:3]).max(axis=2) < 0.06).mean() for c in (0.0, 0.5, 1.0)]
    assert int(np.argmax(shares)) == {0.0: 0, 0.5e-3: 1, 5e-3: 2}[clearance]
    assert max(shares) > 5e-4


def test_a_run_without_a_camera_is_drawn_on_a_plan():
    metrics = made_metrics(100)
    picture = pixels(metrics, title=EVIL)
    assert np.median(picture[DISH]) == pytest.approx(244 / 255, abs=0.01)
    nothing = RunMetrics(LENGTH)
    nothing.add(FrameResult(0, vertices=NODES))
    assert pixels(nothing).shape == picture.shape


def test_a_command_draws_whatever_backend_a_notebook_asks_for(tmp_path):
    code = "from magnetosuture_thread import cli; cli.main(['scene', 'draw', 'dish_35mm', '--output', 'dish.png'])"
    environment = {"MPLBACKEND": "module://there_is.none", "HOME": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300, cwd=tmp_path, env=environment)
    assert (tmp_path / "dish.png").read_bytes().startswith(b"\x89PNG")
