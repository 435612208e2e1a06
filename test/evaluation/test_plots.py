"""The picture of a run."""

from __future__ import annotations

import io

import numpy as np
import pytest
from matplotlib.image import imread

from magnetosuture_thread.evaluation.frames import FrameResult
from magnetosuture_thread.evaluation.metrics import RunMetrics
from magnetosuture_thread.evaluation.plots import draw_metrics
from test.evaluation.runs import EVIL, LENGTH, NODES, made_metrics
from test.shared import run_python


def test_a_run_without_a_camera_is_drawn_on_a_plan():
    """Whatever its name is: neither mathematics nor codes are drawn of it."""
    empty = RunMetrics(LENGTH)
    empty.add(FrameResult(0, vertices=NODES))
    drawn = [
        draw_metrics(each, EVIL + "a$\\x$b\x1b[31m", 0.035, None, "all of it") for each in (made_metrics(100), empty)
    ]
    picture, nothing = (imread(io.BytesIO(each), format="png")[..., :3] for each in drawn)
    assert np.median(picture[170:840, 30:700]) == pytest.approx(244 / 255, abs=0.01)  # where the dish is
    assert nothing.shape == picture.shape


def test_a_command_draws_whatever_backend_a_notebook_asks_for(tmp_path):
    code = "from magnetosuture_thread import cli; cli.main(['scene', 'draw', 'dish_35mm', '--output', 'dish.png'])"
    run_python("-c", code, cwd=tmp_path, environment={"MPLBACKEND": "module://there_is.none", "HOME": str(tmp_path)})
    assert (tmp_path / "dish.png").read_bytes().startswith(b"\x89PNG")
