"""A simulated rig that is not as its setup says, against physics of the test's own."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from magnetosuture_thread.geometry.scene import Dish, Scene
from magnetosuture_thread.planning.executor import ThreadCondition
from magnetosuture_thread.rig.closed_loop import ClosedLoop
from magnetosuture_thread.rig.rig import Rig
from magnetosuture_thread.rig.settings import RigSettings
from magnetosuture_thread.rig.setups import Setup, read_setup
from magnetosuture_thread.rig.truth import draw_rig, with_rig
from magnetosuture_thread.settings.errors import ConfigurationError

MU_0 = 4e-7 * math.pi
SLIGHT = {  # a thread that is hardly there
    "thread_length": 1e-3,
    "thread_segments": 8,
    "thread_diameter": 2e-5,
    "thread_drag_across": 1e-4,
    "thread_drag_along": 5e-5,
    "thread_bending_stiffness": 1e-14,
    "thread_stretching_stiffness": 0.1,
}
LENGTH = 7e-3
CURRENTS = np.array([0.8, -0.3, 0.0, 0.5])


def rig(start: tuple[float, float, float] = (-0.5 * LENGTH, 0.0, 0.0), **changes: Any) -> Rig:
    """Return a rig without a thread to speak of, whose needle is free."""
    made = Rig(RigSettings(needle_start=start, **{**SLIGHT, **changes}), Scene(Dish(0.035)))
    made.apply(np.full(4, 1e-12), 0.0)
    return made


def motion(made: Rig, currents: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return middle and heading of a needle under constant currents, shape (k, 3)."""
    poses = []
    for time in times:
        made.apply(currents, float(time))
        frame = made.look(float(time), rendered=False)
        along = 0.5 * LENGTH * np.array([math.cos(frame.heading), math.sin(frame.heading)])
        poses.append([*(frame.tail + along), frame.heading])
    return np.array(poses)


def loop_field(point: np.ndarray, angle: float, distance: float, radius: float, turns: float) -> np.ndarray:
    """Return the field of a loop for one ampere by the law of Biot and Savart, summed over its length, shape (2,)."""
    along, across = (
        np.array([math.cos(angle), math.sin(angle), 0.0]),
        np.array([-math.sin(angle), math.cos(angle), 0.0]),
    )
    turn = np.linspace(0.0, 2.0 * math.pi, 2000, endpoint=False)
    around = np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * [0.0, 0.0, 1.0]
    step = np.cross(along, around) * radius * 2.0 * math.pi / len(turn)
    away = np.array([*point, 0.0]) - (distance * along + radius * around)
    field = np.cross(step, away) / np.linalg.norm(away, axis=1)[:, None] ** 3
    return np.asarray(turns * MU_0 / (4.0 * math.pi) * field.sum(axis=0)[:2])


def test_the_field_is_that_of_windings_times_gains_and_the_residual_one():
    gains, residual, at = (0.5, -2.0, 0.0, 1.0), (3e-5, -8e-5), np.array([0.004, -0.006])
    settings = RigSettings(coil_gains=gains, residual_field=residual, coil_length=0.0)
    coils = zip(settings.coil_angles, gains, CURRENTS, strict=True)
    windings = settings.coil_distance, settings.coil_radius, settings.coil_turns
    expected = np.array(residual) + sum(g * i * loop_field(at, angle, *windings) for angle, g, i in coils)
    np.testing.assert_allclose(settings.coil_field().at(at, CURRENTS), expected, rtol=1e-6)


@pytest.mark.parametrize("magnetisation", [1e6, -7e5])
def test_a_residual_field_turns_a_needle_at_rest_which_way_its_magnet_points(magnetisation: float):
    field, angle = 1e-4, 1.2
    made = rig((-0.5 * LENGTH, 0.0, 0.0), needle_magnetisation=magnetisation, residual_field=(0.0, field))
    times = np.arange(0.0, 2.0, 0.1)
    found = motion(made, np.full(4, 1e-12), times)
    moment, slender = magnetisation * math.pi * 4e-4**2 / 4.0 * LENGTH, LENGTH / 4e-4
    drag = math.pi * LENGTH**3 / 3.0 / (math.log(slender) - 0.662 + 0.917 / slender - 0.050 / slender**2)
    # c dx/dt = m B cos x from x = 0 is the gudermannian of m B t / c.
    expected = 2.0 * np.arctan(np.tanh(0.5 * moment * field * times / drag))
    np.testing.assert_allclose(found[:, 2], expected, atol=2e-3 * angle)
    np.testing.assert_allclose(found[:, :2], 0.0, atol=1e-6)


def test_currents_that_come_late_give_the_same_motion_later():
    times = np.arange(0.0, 0.6, 0.01)
    prompt, late = motion(rig(), CURRENTS, times), motion(rig(current_delay=0.05), CURRENTS, times)
    assert np.ptp(prompt[:, 2]) > 0.5
    np.testing.assert_allclose(late[5:], prompt[:-5], atol=2e-5)
    np.testing.assert_allclose(late[:5], np.tile(prompt[0], (5, 1)), atol=1e-9)


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_turned_and_mirrored_camera_shows_the_same_motion_turned_and_mirrored(mirrored: bool):
    rotation, side = 0.7, -1.0 if mirrored else 1.0
    turn = np.array([[math.cos(rotation), -math.sin(rotation)], [math.sin(rotation), math.cos(rotation)]])
    seen = turn @ np.diag([1.0, side])
    tail, heading, times = np.array([-0.002, 0.003]), 0.4, np.arange(0.0, 0.5, 0.05)
    bench = motion(rig((*tail, heading)), CURRENTS, times)
    start = (*(seen @ tail).tolist(), side * heading + rotation)
    camera = motion(rig(start, camera_rotation=rotation, camera_mirrored=mirrored), CURRENTS, times)
    assert np.linalg.norm(bench[-1, :2] - bench[0, :2]) > 1e-3
    np.testing.assert_allclose(camera[:, :2], bench[:, :2] @ seen.T, atol=2e-6)
    np.testing.assert_allclose(camera[:, 2], side * bench[:, 2] + rotation, atol=2e-4)


def test_frames_that_are_stamped_late_come_late_with_the_pose_of_before():
    setup, delay = read_setup("petri_35mm_polyamide"), 0.04
    truth = replace(setup.rig, stamp_delay=delay)
    known: list[tuple[float, float]] = []

    def command(stamp: float, tail: np.ndarray, heading: np.ndarray, thread: ThreadCondition) -> np.ndarray:
        known.append((stamp, float(tail[0])))
        return np.array([0.005, 0.0, 0.0])

    loop = ClosedLoop(setup, Rig(truth, setup.scene), command)
    true: list[tuple[float, float]] = []
    while loop.now < 2.5:
        if (frame := loop.step()) is not None:
            true.append((frame.time + 1.0, float(frame.tail[0])))
        if known:
            assert known[-1][0] < loop.now
    at, x = np.array(true).T
    stamps, measured = np.array(known).T
    assert np.ptp(x) > 2e-3
    shown = np.interp(stamps - delay, at, x)
    assert np.abs(measured - shown).max() < 5e-5  # five deviations of the noise
    assert np.abs(measured - np.interp(stamps, at, x)).max() > 1e-4


@pytest.fixture
def setup() -> Setup:
    """Return what nodes believe."""
    return read_setup("petri_35mm_polyamide")


def test_a_file_changes_the_rig_alone_and_what_it_does_not_name_stays(setup: Setup, tmp_path: Path):
    file = tmp_path / "truth.yaml"
    values = {"coil_gains": [1.0, -1.0, 0.5, 1.0], "needle_length": 0.0065}
    sections = {"/**": {"ros__parameters": {"viscosity": 0.5, "scene": "dish_35mm"}}}
    sections |= {"/**/rig_simulator": {"ros__parameters": values}, "/**/vision_tracker": {"ros__parameters": {}}}
    file.write_text(yaml.safe_dump(sections))
    true = with_rig(setup, str(file))
    changed = {"coil_gains": (1.0, -1.0, 0.5, 1.0), "needle_length": 0.0065, "viscosity": 0.5}
    assert true.rig == replace(setup.rig, **changed)  # type: ignore[arg-type]
    assert (true.coils, true.vision, true.model, true.scene) == (setup.coils, setup.vision, setup.model, setup.scene)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("/**/coil_bridge: {ros__parameters: {rate: 100.0}}", "a section /\\*\\*/rig_simulator"),
        ("/**/rig_simulator: {ros__parameters: {coil_gain: [1.0]}}", "did you mean coil_gains"),
        ("/**/rig_simulator: {ros__parameters: {coil_gains: [1.0, 1.0]}}", "one for each of the 4 coils"),
        ("/**/rig_simulator: {ros__parameters: {coil_angles: [0.0, 2.0, 4.0]}}", "4 of them, as in petri_35mm"),
        ("/**/rig_simulator: {ros__parameters: {needle_magnetisation: 0.0}}", "1000 A/m or more"),
    ],
)
def test_a_truth_that_cannot_be_is_refused(setup: Setup, tmp_path: Path, content: str, words: str):
    file = tmp_path / "truth.yaml"
    file.write_text(content)
    with pytest.raises(ConfigurationError, match=words):
        with_rig(setup, str(file))


@pytest.mark.parametrize("name", ["random:", "random:-1", "random:1.5", "random:9999999999999", "nowhere.yaml"])
def test_what_is_neither_file_nor_seed_is_refused(setup: Setup, name: str):
    with pytest.raises(ConfigurationError):
        with_rig(setup, name)


def test_drawn_rigs_are_of_all_kinds_and_the_same_by_their_seed(setup: Setup):
    drawn = [draw_rig(setup.rig, seed) for seed in range(200)]
    assert drawn[7] == with_rig(setup, "random:7").rig
    gains = np.array([each.coil_gains for each in drawn])
    assert 0.5 <= np.abs(gains).min() < 0.52 < 1.9 < np.abs(gains).max() <= 2.0
    assert ((gains < 0.0).sum(axis=1) == 1).all()
    turned = np.array([each.coil_angles for each in drawn]) - setup.rig.coil_angles
    assert ((np.abs(np.cos(turned) - 1.0) > 0.02).sum(axis=1) == 2).all()  # two cables
    assert 2.3e-3 < min(each.needle_length for each in drawn) < 2.7e-3
    assert 6.5e-3 < max(each.needle_length for each in drawn) < 7.4e-3
    assert {each.camera_mirrored for each in drawn} == {False, True}
    assert {each.needle_magnetisation > 0.0 for each in drawn} == {False, True}
    assert 0.3 <= min(each.viscosity for each in drawn) < 0.33 < 2.7 < max(each.viscosity for each in drawn) <= 3.0
    assert 0.07 < max(each.current_delay for each in drawn) <= 0.08
    assert 0.8e-4 < max(math.hypot(*each.residual_field) for each in drawn) <= 1e-4
