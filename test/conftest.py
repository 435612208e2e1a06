"""What all tests share: a rendered scene, and a graph on this machine alone."""

from __future__ import annotations

import atexit
import os
import shutil
import signal
import tempfile
import uuid
from pathlib import Path

import hypothesis
import numpy as np
import pytest

from magnetosuture_thread.commands.render import render_bag
from magnetosuture_thread.evaluation.reference import ReferenceTrajectory
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.rig.camera import CameraScene, DishCamera
from magnetosuture_thread.rig.setups import read_setup

# The first example of a process may load compiled code, and other processes may have the cores.
hypothesis.settings.register_profile("without deadline", deadline=None)
hypothesis.settings.load_profile("without deadline")

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
# What a shell runs in the background ignores SIGINT, and hands that on to its children: no Ctrl-C would reach them.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

STATE = Path(tempfile.mkdtemp(prefix="magnetosuture_test_"))
atexit.register(shutil.rmtree, STATE, ignore_errors=True)
os.environ["XDG_STATE_HOME"] = str(STATE)

VIEW = DishView((322.0, 238.0), 8e-5)


def arc(tail: np.ndarray, angle: float, curvature: float, length: float = 0.019, points: int = 101) -> np.ndarray:
    """Return a circular arc of a thread that leaves a tail at an angle, shape (points, 2)."""
    s = np.linspace(0.0, length, points)
    turned = angle + curvature * s
    steps = np.diff(s)[:, None] * np.column_stack([np.cos(turned), np.sin(turned)])[:-1]
    return np.vstack([tail, tail + np.cumsum(steps, axis=0)])


@pytest.fixture(autouse=True)
def state_home(monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give each test a folder of its own for what nodes keep over a restart, and return it; made where it is used."""
    folder = STATE / uuid.uuid4().hex
    monkeypatch.setenv("XDG_STATE_HOME", str(folder))
    return folder


@pytest.fixture(scope="session")
def camera() -> DishCamera:
    """A camera over an empty dish."""
    return DishCamera(CameraScene(), VIEW, seed=5)


@pytest.fixture
def thread_arc():
    """Return the function that makes a thread's centreline."""
    return arc


@pytest.fixture(scope="session")
def straight_pull() -> ReferenceTrajectory:
    """Return a needle that pulls a straight thread east for two seconds."""
    times = np.linspace(0.0, 2.0, 133)
    tails = np.column_stack([0.003 + 0.003 * times, np.full(133, 0.002)])
    along = np.linspace(0.0, 0.019, 101)
    threads = np.stack([tails[:, None, 0] - along, tails[:, None, 1] + 0.0 * along], axis=2)
    return ReferenceTrajectory("straight_pull", times, tails, np.zeros(133), threads, (), {})


@pytest.fixture(scope="session")
def short_bag(tmp_path_factory: pytest.TempPathFactory, straight_pull: ReferenceTrajectory) -> Path:
    """Return a bag of one second."""
    path = tmp_path_factory.mktemp("short") / "pull"
    render_bag(straight_pull, read_setup("petri_35mm_polyamide"), path, duration=1.0)
    return path
