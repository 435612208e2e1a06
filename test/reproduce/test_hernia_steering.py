"""A steering replayed in the model."""

from __future__ import annotations

import numpy as np
import pytest

from magnetosuture_thread.configuration import from_mapping
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.reproduce.hernia import (
    HerniaRun,
    RecordedCommands,
    SteeredThread,
    point_filter,
    replay_steering,
)
from magnetosuture_thread.scene import Dish, Scene, SceneShape
from magnetosuture_thread.thread.margins import FrictionState
from magnetosuture_thread.thread_model.settings import ThreadModelSettings

# A gate of two discs with 1.6 mm between them, 4 mm ahead of the needle.
SETTINGS = from_mapping(
    ThreadModelSettings,
    {
        "friction_threshold": 1.2e-3,
        "friction_averaging": 0.0,
    },
)
POSTS = tuple(SceneShape(f"post_{k}", "instrument", Disc((0.004, y), 0.001)) for k, y in enumerate((0.0018, -0.0018)))
NEEDLE = point_filter(Scene(Dish(0.06), POSTS), 3e-4, 10.0)
LINE = np.column_stack([-np.linspace(0.0, 0.019, 50), np.zeros(50)])


def steering(*parts: tuple[float, float, float]) -> RecordedCommands:
    """Return commands at 20 Hz: for each part a duration [s] and a velocity [m/s]."""
    velocities = [(x, y) for duration, x, y in parts for _ in range(round(20 * duration))]
    return RecordedCommands(np.arange(len(velocities)) / 20.0, np.array(velocities))


@pytest.fixture(scope="module")
def through() -> HerniaRun:
    """A needle that is drawn through the gate, waits, and is pressed against a disc."""
    return replay_steering(SETTINGS, LINE, steering((3.0, 3e-3, 0.0), (1.0, 0.0, 0.0), (2.0, -3e-3, 2e-3)), NEEDLE)


def test_a_needle_goes_where_it_is_told_and_slower_under_friction(through: HerniaRun):
    states = [instant.margins.friction.state for instant in through.instants]
    assert states[0] is FrictionState.FREE
    assert states.index(FrictionState.SLIDING) < states.index(FrictionState.STUCK)
    for last, instant in zip(through.instants[:-1], through.instants[1:], strict=True):
        assert instant.command is not None
        before = last.margins.friction.slowdown
        assert instant.command.slowdown == before
        moved = (instant.prediction.positions[0] - last.prediction.positions[0]) * 33.0
        np.testing.assert_allclose(moved, instant.command.filtered, atol=1e-9)
        if set(instant.command.active) <= {"friction"}:
            np.testing.assert_allclose(instant.command.filtered, before * instant.command.commanded, atol=1e-9)
    assert min(instant.margins.friction.slowdown for instant in through.instants) < 0.9


def test_a_command_holds_for_a_tenth_of_a_second():
    given = RecordedCommands(np.array([1.0, 2.0]), np.array([[1.0, 0.0], [0.0, 2.0]]))
    found = [given.at(time).tolist() for time in (0.9, 1.0, 1.1, 1.11, 2.05, 2.2)]
    assert found == [[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [0.0, 0.0], [0.0, 2.0], [0.0, 0.0]]


def test_a_velocity_in_another_unit_is_refused():
    with pytest.raises(InvalidInputError, match="at most 1 m/s"):
        SteeredThread(SETTINGS, LINE, NEEDLE).step(0.03, np.array([3.0, 0.0]))
