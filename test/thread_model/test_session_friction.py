"""Friction as a session's margins tell it: what the coil bridge slows the needle by."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.configuration import from_mapping
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.thread.margins import Friction, FrictionState
from magnetosuture_thread.thread.prediction import NeedlePose
from magnetosuture_thread.thread_model.session import ThreadSession
from magnetosuture_thread.thread_model.settings import ThreadModelSettings
from test.thread.worlds import scene_with

SECOND = 1_000_000_000
PERIOD = SECOND // 30
EAST = np.array([1.0, 0.0])
# A gate of two discs, 0.8 mm from the thread on either side, 6 mm behind the needle.
GATE = scene_with(Disc((-0.006, 0.0018), 0.001), Disc((-0.006, -0.0018), 0.001))


def session(scene: Scene | None = None, **values: Any) -> ThreadSession:
    """Return a session whose thread begins straight behind a needle that points east."""
    return ThreadSession(from_mapping(ThreadModelSettings, {"initial_shape": "straight", **values}), scene)


def drive(session: ThreadSession, first: int, last: int, speed: float = 3e-3, x: float = 0.0) -> tuple[float, Friction]:
    """Show poses of a needle that goes east [m/s]; return where it is [m], and the friction there."""
    for k in range(first, last):
        at = x + speed * (k - first) / 30.0
        outcome = session.on_pose(SECOND + k * PERIOD, NeedlePose(1.0 + k * PERIOD * 1e-9, np.array([at, 0.0]), EAST))
        assert outcome.problem is None
        assert outcome.margins is not None
    assert outcome.margins is not None
    return at, outcome.margins.friction


def test_friction_slows_a_needle_that_pulls_and_no_other():
    model = session(GATE, friction_threshold=1.2e-3, friction_averaging=0.0)
    x, pulled = drive(model, 0, 5)
    assert pulled.state is FrictionState.SLIDING
    assert 0.5 < pulled.slowdown < 1.0
    _, resting = drive(model, 5, 10, speed=0.0, x=x)
    assert (resting.state, resting.slowdown) == (FrictionState.STUCK, 1.0)


def test_a_change_of_settings_does_not_bring_the_thread_to_rest():
    values = {"friction_threshold": 1.2e-3, "initial_shape": "straight"}
    model = session(GATE, **values)
    x, before = drive(model, 0, 9)
    assert before.slowdown < 1.0
    model.change(from_mapping(ThreadModelSettings, {**values, "contact_tolerance": 2e-5}), GATE)
    _, after = drive(model, 9, 10, speed=0.0, x=x)  # averaged, it still moves
    assert after.slowdown == pytest.approx(before.slowdown, rel=0.2)
