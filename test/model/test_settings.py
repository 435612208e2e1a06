"""Settings of the thread model: what they make, and what they refuse."""

from __future__ import annotations

import gc
from typing import Any

import numpy as np
import pytest
from numba.core.registry import CPUDispatcher

from magnetosuture_thread.configuration import from_mapping
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.model import predictor
from magnetosuture_thread.model.formulations import PaperOptions, make_formulation
from magnetosuture_thread.model.margins import SOLID
from magnetosuture_thread.model.prediction import NeedleMotion, NeedlePose
from magnetosuture_thread.model.predictor import ThreadPredictor
from magnetosuture_thread.model.session import ThreadSession
from magnetosuture_thread.model.settings import ThreadModelSettings
from magnetosuture_thread.scene import Scene
from test.model.worlds import polygon, scene_with

SQUARE = polygon(0.0, 0.0, 0.01, 0.0, 0.01, 0.01, 0.0, 0.01)


def made(**values: Any) -> ThreadModelSettings:
    """Return settings from what a setup file would hold."""
    return from_mapping(ThreadModelSettings, values)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"fixed_nodes": [26]}, "nodes from 1 to 25"),
        ({"fixed_nodes": [0]}, "from 1 to"),
        ({"formulation": "magic"}, "one of rod, paper"),
        ({"solver": "magic"}, "one of banded, osqp"),
        ({"medium": "honey"}, "one of liquid, air"),
        ({"gravity": [9.81]}, "multiple of 2"),
        ({"medium": "air", "gravity": [0.0, -9.8, 1.0, 2.0]}, "two numbers"),
        ({"gravity": [0.0, -9.81]}, "gravity.*medium: air only"),
        ({"medium": "air", "viscosity": 0.5}, "viscosity.*medium: liquid only"),
        ({"rest_curvature": 900.0}, "half a radian"),
        ({"drag_anisotropy": 0.0}, "from 0.05 to 1"),
        ({"drag_anisotropy": float("nan")}, "from 0.05 to 1"),
        ({"medium": "air", "drag_anisotropy": 0.7}, "drag_anisotropy.*medium: liquid only"),
        ({"attachment_offset": [1e-3]}, "multiple of 2"),
        ({"attachment_offset": [1e-3, 0.0, 1e-3, 0.0]}, "attachment_offset.*two numbers, along and to the left"),
        ({"attachment_offset": [1e-3, float("nan")]}, "from -0.01 to 0.01 m"),
        ({"attachment_offset": [1.0, 0.0]}, "from -0.01 to 0.01 m"),
        ({"paper_damping": 1.0}, "from 0 to 0.999"),
        ({"paper_stiffness_weight": -1.0}, "from 0 to"),
        ({"formulation": "paper", "medium": "air"}, "paper has no inertia"),
        ({"formulation": "paper", "flow": [1e-3, 0.0]}, "paper has no drag"),
        ({"flow": [1e-3]}, "multiple of 2"),
        ({"flow": [1e-3, 1.0]}, "from -0.1 to 0.1 m/s"),
        ({"segments": 400}, "longer than thick"),
    ],
)
def test_what_cannot_be_is_refused_by_name(values: dict[str, Any], words: str):
    with pytest.raises(ConfigurationError, match=words) as caught:
        made(**values)
    assert "thread_model." in str(caught.value)


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"formulation": "paper"},
        {"solver": "osqp", "attachment": "clamped"},
        {"medium": "air", "mass_per_length": 1e-5, "gravity": [0.0, -9.81], "bending_damping": 0.01},
        {"fixed_nodes": [20], "rest_curvature": 30.0},
        {"drag_anisotropy": 1.0, "attachment_offset": [1e-3, 5e-4]},
        {"formulation": "paper", "paper_damping": 0.0, "paper_stiffness_weight": 2.0},
        {"margin_range": 0.02},
        {"flow": [1e-3, -2e-3]},
    ],
)
def test_every_choice_makes_a_predictor_that_steps(values: dict[str, Any]):
    predictor = made(**values).predictor(scene_with(SQUARE, diameter=0.06))
    assert not predictor.started
    east = np.array([1.0, 0.0])
    tail = np.array([-0.005, -0.005])
    predictor.start(NeedlePose(0.0, tail, east), np.array([tail, tail - 0.019 * east]))
    for k in range(1, 6):
        prediction = predictor.step(NeedlePose(k / 60.0, tail + k * 5e-5 * east, east))
    assert prediction.formulation == values.get("formulation", "rod")
    assert prediction.solver == values.get("solver", "banded")
    assert np.isfinite(prediction.positions).all()
    assert prediction.residual < 1e-6


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        (
            scene_with(Disc((0.0, 0.0), 1e-3), Disc((0.01, 0.0), 1e-4)),
            r"scene\.shape_1: got 0\.0001, .* half of a segment",
        ),
        (scene_with(polygon(0.0, 0.0, 0.01, 0.0, 0.01, 3e-4, 0.0, 3e-4)), r"scene\.shape_0: .* half of a segment"),
        (scene_with(diameter=0.005), r"scene\.dish\.diameter: got 0\.005, .*more than 0\.00633333 m, two segments"),
    ],
)
def test_a_scene_that_the_segments_do_not_resolve_is_refused(scene: Scene, words: str):
    settings = made(segments=25 if scene.shapes else 6)
    with pytest.raises(ConfigurationError, match=words):
        ThreadPredictor(settings.thread(), scene)
    with pytest.raises(ConfigurationError, match=words):
        settings.predictor(scene)
    ThreadPredictor(made(segments=100).thread(), scene)


def test_a_material_can_be_another_than_those_that_are_known():
    known, other = made().thread(), made(diameter=1.2e-4, elastic_modulus=1e9).thread()
    assert other.diameter == 1.2e-4
    assert other.bending_stiffness == pytest.approx(8.0 * known.bending_stiffness)
    assert other.medium.drag_across > known.medium.drag_across


@pytest.mark.parametrize("anisotropy", [0.3, 0.5, 1.0])
def test_the_drag_along_the_thread_is_a_part_of_that_across(anisotropy: float):
    across = made().thread().medium.drag_across
    medium = made(drag_anisotropy=anisotropy).thread().medium
    assert (medium.drag_across, medium.drag_along) == (across, anisotropy * across)


@pytest.mark.parametrize(
    ("values", "damping", "weight"),
    [
        ({}, 0.95, 0.01),
        ({"material": "silk_6_0"}, 0.95, 100.0),
        ({"paper_damping": 0.5}, 0.5, 0.01),
        ({"material": "silk_6_0", "paper_stiffness_weight": 7.0}, 0.95, 7.0),
    ],
)
def test_the_papers_options_come_from_the_settings(monkeypatch, values: dict[str, Any], damping: float, weight: float):
    given = []

    def spied(*arguments: Any) -> Any:
        given.append(arguments[-2])
        return make_formulation(*arguments)

    monkeypatch.setattr(predictor, "make_formulation", spied)
    made(formulation="paper", **values).predictor(None)
    assert (given[0].damping, given[0].stiffness_weight) == (damping, weight)
    assert given[0] == PaperOptions.tuned(weight)._replace(damping=damping)


def test_barriers_of_a_user_come_from_the_settings():
    with pytest.raises(ConfigurationError, match=r"thread_model\.barriers: got 'no_such_module_of_barriers:KeepIn'"):
        made(barriers=["no_such_module_of_barriers:KeepIn"]).predictor(None)
    with pytest.raises(ConfigurationError, match=r"thread_model\.barriers"):
        made(barriers=[3])


def test_the_attachment_turns_with_the_needle():
    pose = NeedlePose(3.0, np.array([1.0, 2.0]), np.array([0.6, 0.8]))
    assert made().attachment_pose(pose) is pose
    found = made(attachment_offset=[0.01, -0.005]).attachment_pose(pose)
    np.testing.assert_allclose(found.tail, [1.0 + 0.006 + 0.004, 2.0 + 0.008 - 0.003], atol=1e-15)
    assert found.heading is pose.heading
    assert found.stamp == 3.0


def test_the_attachments_velocity_is_the_rate_of_its_place():
    settings, velocity, rate, step = made(attachment_offset=[0.01, -0.005]), np.array([2e-3, -1e-3]), 3.0, 1e-6

    def after(time: float) -> NeedlePose:
        heading = np.array([np.cos(0.4 + rate * time), np.sin(0.4 + rate * time)])
        return settings.attachment_pose(
            NeedlePose(1.0 + time, time * velocity, heading, motion=NeedleMotion(velocity, rate))
        )

    motion = after(0.0).motion
    assert motion is not None
    np.testing.assert_allclose(motion.velocity, (after(step).tail - after(-step).tail) / (2.0 * step), rtol=1e-6)


@pytest.mark.parametrize("formulation", ["rod", "paper"])
@pytest.mark.parametrize("disc", [Disc((0.0, 0.0), 0.005), Disc((-0.01, 0.0), 0.03), Disc((-0.01, 0.0), 0.0005)])
def test_a_predictor_can_be_made_wherever_obstacles_are(formulation: str, disc: Disc):
    """Where it is warmed up there may be one, which says nothing of where the thread will be."""
    assert not made(formulation=formulation).predictor(scene_with(disc)).started


def test_a_comb_around_the_needle_is_adopted_by_prediction_and_estimate():
    """A straight thread at the origin would not get through its 700 teeth, which says nothing of other threads."""
    turn, radius = np.linspace(0.0, 2.0 * np.pi, 1400, endpoint=False), np.where(np.arange(1400) % 2, 0.002, 0.012)
    scene = scene_with(
        polygon(*np.column_stack([radius * np.cos(turn), radius * np.sin(turn)]).ravel().tolist()), diameter=0.035
    )
    session = ThreadSession(made(), scene_with())
    session.change(session.settings, scene)
    assert session.scene == scene
    assert session.estimates


def test_what_cannot_be_solved_is_said_at_each_step_and_not_at_the_start():
    assert not made(residual_tolerance=1e-12, rest_curvature=329.2).predictor(None).started


def test_inertia_and_weight_come_from_the_settings():
    thread = made(medium="air", mass_per_length=1e-5, air_drag=2e-4, gravity=[0.0, -9.81]).thread()
    assert thread.medium.mass_per_length == 1e-5
    assert thread.medium.drag_across == thread.medium.drag_along == 2e-4
    assert thread.medium.gravity == (0.0, -9.81)
    assert made().thread().medium.mass_per_length == 0.0


@pytest.mark.parametrize("medium", ["liquid", "air"])
def test_the_flow_comes_from_the_settings(medium: str):
    assert made(medium=medium, flow=[1e-3, -2e-3]).thread().medium.flow == (1e-3, -2e-3)
    assert made(medium=medium).thread().medium.flow == ()


def kernels() -> int:
    """Return how many kernels of ours are compiled, or loaded from the cache, by now."""
    # By their types: to look at what a weak proxy stands for raises once that is gone.
    ours = (found for found in gc.get_objects() if issubclass(type(found), CPUDispatcher))
    return sum(len(found.signatures) for found in ours if found.py_func.__module__.startswith("magnetosuture_thread"))


@pytest.mark.parametrize("formulation", ["rod", "paper"])
def test_no_kernel_is_compiled_once_the_predictor_is_made(formulation: str):
    """Else the first callback, or the first contact in the middle of an operation, would wait for a compiler."""
    predictor = made(formulation=formulation).predictor(
        scene_with(SQUARE, Disc((-0.009, 0.002), 0.0015), diameter=0.05)
    )
    before = kernels()
    east, tail = np.array([1.0, 0.0]), np.array([-0.001, 0.0])
    predictor.start(NeedlePose(0.0, tail, east), np.array([tail, tail - 0.019 * east]))
    touched = False
    for k in range(1, 200):
        prediction = predictor.step(NeedlePose(k / 60.0, tail + k * np.array([0.0, 6e-5]), east))
        touched = touched or bool(any((prediction.margins[name].clearance < 1e-5).any() for name in SOLID))
    assert touched
    assert kernels() == before
