"""The thread's pull fed forward to the coils: what it adds, how far, for how long, and that the wall stays safe."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from magnetosuture_thread.coils.feedforward import ThreadFeedforward
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.errors import ConfigurationError, InvalidInputError
from magnetosuture_thread.scene import Scene
from test.coils.test_bridge import PERIOD, Plant

SETTINGS = CoilBridgeSettings(thread_feedforward=True, thread_drag=0.01)
NEEDLE = SETTINGS.needle()
EAST = np.array([1.0, 0.0])


def given(force: tuple[float, float], stamp: float = 1.0) -> ThreadFeedforward:
    """Return a feedforward that was told a force."""
    feedforward = ThreadFeedforward(NEEDLE, 0.01, timeout=0.5)
    feedforward.update(np.array(force), stamp, stamp)
    return feedforward


def test_a_straight_thread_behind_is_in_the_drag_already():
    speed = 4e-3
    added = given((-0.01 * speed, 0.0)).velocity(np.array([speed, 0.0]), EAST, 1.0, 1.0)
    assert added == pytest.approx([0.0, 0.0], abs=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1.0, -2.5])
def test_the_velocity_is_the_force_over_the_drag_in_the_needles_frame(angle: float):
    e = np.array([math.cos(angle), math.sin(angle)])
    n = np.array([-e[1], e[0]])
    force, speed = -1.7e-5 * e + 2e-5 * n, 5e-3
    added = given(tuple(force)).velocity(speed * e, e, 1.0, 1.0)
    assert added @ e == pytest.approx((-1.7e-5 + 0.01 * speed) / NEEDLE.drag)
    assert added @ n == pytest.approx(2e-5 / NEEDLE.drag_across)


def test_it_is_at_most_half_of_what_is_commanded():
    feedforward = given((-0.5, 0.3))
    for commanded in (np.array([1e-3, 0.0]), np.array([-2e-3, 4e-3])):
        added = feedforward.velocity(commanded, EAST, 1.0, 1.0)
        assert np.hypot(*added) == pytest.approx(0.5 * np.hypot(*commanded))
    assert not feedforward.velocity(np.zeros(2), EAST, 1.0, 1.0).any()


def test_an_old_or_unknown_force_adds_nothing():
    commanded = np.array([5e-3, 0.0])
    assert not ThreadFeedforward(NEEDLE, 0.0, 0.5).velocity(commanded, EAST, 1.0, 1.0).any()
    feedforward = given((-2e-5, 0.0))
    assert feedforward.velocity(commanded, EAST, 1.5, 1.5).any()
    assert not feedforward.velocity(commanded, EAST, 1.51, 1.0).any()  # by its stamp
    assert not feedforward.velocity(commanded, EAST, 1.0, 1.51).any()  # by its arrival
    feedforward.update(np.array([math.nan, math.nan]), 1.0, 1.0)
    assert not feedforward.velocity(commanded, EAST, 1.0, 1.0).any()


@pytest.mark.parametrize("force", [(math.inf, 0.0), (2.0, 0.0), (0.8, -0.8)])
def test_a_force_beyond_reason_is_refused_and_the_last_one_stays(force: tuple[float, float]):
    feedforward = given((-2e-5, 0.0))
    before = feedforward.velocity(EAST, EAST, 1.0, 1.0)
    with pytest.raises(InvalidInputError, match="at most 1 N"):
        feedforward.update(np.array(force), 1.0, 1.0)
    with pytest.raises(InvalidInputError, match="a time"):
        feedforward.update(np.array([0.0, 0.0]), math.nan, 1.0)
    assert feedforward.velocity(EAST, EAST, 1.0, 1.0).tolist() == before.tolist()


def driven(settings: CoilBridgeSettings, force: NDArray[np.float64], scene: Scene | None = None) -> Plant:
    """Return a plant after half a second of commands to the right, with a thread that pulls."""
    plant = Plant(settings, scene or Scene(), velocity=(4e-3, 0.0)).ready()
    for _ in range(round(0.5 / PERIOD)):
        if plant.bridge.feedforward is not None:
            plant.bridge.feedforward.update(force, plant.time, plant.time)
        plant.run(PERIOD)
    return plant


def test_the_coils_add_what_the_thread_takes():
    pull = np.array([-4e-5, 0.0])
    expected = 4e-3 - (-4e-5 + 0.01 * 4e-3) / NEEDLE.drag
    with_pull = driven(SETTINGS, pull).outputs[-1][1]
    assert with_pull.applied == pytest.approx([expected, 0.0], rel=0.02, abs=1e-4)
    stronger = driven(SETTINGS, 1.8 * pull).outputs[-1][1]
    assert stronger.applied[0] - with_pull.applied[0] == pytest.approx(0.8 * 4e-5 / NEEDLE.drag, rel=0.05)
    without = driven(replace(SETTINGS, thread_feedforward=False), 1.8 * pull).outputs[-1][1]
    assert without.applied == pytest.approx([4e-3, 0.0], rel=0.02, abs=1e-4)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_currents_are_certified_with_the_pull_and_without(sign: float):
    """Near the wall a needle neither leaves the dish by its currents alone nor with the thread's push."""
    plant, scene = Plant(SETTINGS, velocity=(4e-3, 0.0)).ready(), Scene()
    feedforward = plant.bridge.feedforward
    assert feedforward is not None
    wall, length = scene.dish.radius - SETTINGS.keep_out, NEEDLE.length
    plant.tail = np.array([wall - length - 2e-4, 0.0])
    room, pull = 2e-4, np.array([sign * 1e-4, 0.0])
    moved = []
    for _ in range(round(0.5 / PERIOD)):
        feedforward.update(pull, plant.time, plant.time)
        (output,) = plant.run(PERIOD)
        added = feedforward.velocity(output.filtered, EAST, plant.time, plant.time)
        moved += [output.applied[0], (output.applied + (added if output.applied.any() else 0.0))[0]]
    assert max(moved) > 0.0
    assert max(moved) * SETTINGS.hold_time <= room + 1e-9


def test_the_threads_part_of_the_drag_is_at_most_the_whole():
    with pytest.raises(ConfigurationError, match=r"at most coil_bridge\.needle_drag"):
        CoilBridgeSettings(thread_drag=0.03, needle_drag=0.0255)


def test_where_the_motion_is_compensated_the_needle_has_drag_of_its_own():
    with pytest.raises(ConfigurationError, match=r"0\.9 of needle_drag"):
        CoilBridgeSettings(thread_drag=0.024, needle_drag=0.0255, motion_compensation=True)


@pytest.mark.parametrize(("thread_drag", "drag"), [(0.0, 0.009), (0.004, 0.009), (0.0065, 0.005)])
def test_where_the_motion_is_compensated_the_model_has_at_most_twice_the_drag_without_a_thread(
    thread_drag: float, drag: float
):
    """The pull of a straight thread is in the model but for what is left, which is fed forward."""
    settings = CoilBridgeSettings(
        motion_compensation=True, needle_drag=0.009, thread_drag=thread_drag, thread_feedforward=True
    )
    assert settings.needle().drag == pytest.approx(drag)
    assert replace(settings, motion_compensation=False).needle().drag == 0.009
    feedforward = settings.feedforward()
    assert feedforward is not None
    commanded = np.array([0.002, 0.0])
    feedforward.update(-thread_drag * commanded, 1.0, 1.0)  # as a straight thread pulls
    pulled = (drag - (0.009 - thread_drag)) * commanded - thread_drag * commanded
    limited = np.clip(pulled / drag, -0.5 * commanded[0], 0.5 * commanded[0])
    np.testing.assert_allclose(feedforward.velocity(commanded, EAST, 1.0, 1.0), limited, atol=1e-12)
