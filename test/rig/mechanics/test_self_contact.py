"""Contact of the simulated rig's thread with itself, and the thread model held against it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.self_contact import move_rig
from magnetosuture_thread import ConfigurationError, NeedlePose, Scene, ThreadPredictor
from magnetosuture_thread.geometry.scene import Dish
from magnetosuture_thread.rig.dynamics import NeedleBody, NeedleJoint, RigDynamics, Surface, ThreadProperties
from magnetosuture_thread.rig.settings import RigSettings
from magnetosuture_thread.thread.material import Attachment, Medium, Thread
from test.thread.test_self_contact import loop_behind

RATE, DIAMETER, EAST = 60.0, 60e-6, np.array([1.0, 0.0])
LENGTH, SEGMENTS = 0.0195, 60
SOFT = ThreadProperties(LENGTH, SEGMENTS, 2e-12, 5.65, 1.0, 0.5, NeedleJoint.PINNED, diameter=DIAMETER)


def rig_of(nodes: np.ndarray, surface: Surface) -> RigDynamics:
    return RigDynamics(NeedleBody(2e-4, 5e-5, 0.0, 0.0, 1.0), SOFT, surface, None, nodes[0], 0.0, nodes)


def pull_out(rig: RigDynamics, nodes: np.ndarray) -> list[np.ndarray]:
    """Draw the needle across the thread's other end and back."""
    shapes = []
    for k in range(1, 161):
        out = 2.4e-3 * math.sin(math.pi * k / 160) ** 2
        rig.drive(nodes[0] + np.array([0.0, out]), 0.0, 1.0 / RATE)
        shapes.append(rig.thread)
    return shapes


@pytest.mark.slow
def test_the_model_predicts_the_rigs_loop():
    """Both keep strands a diameter apart, by code of their own."""
    nodes = loop_behind(LENGTH, 1.2e-3)
    shapes = pull_out(rig_of(nodes, Surface(self_contact=True)), nodes)
    thread = Thread("soft", LENGTH, SEGMENTS, DIAMETER, 2e-12, Medium(1.0, 0.5), Attachment.PINNED)
    predictor = ThreadPredictor(thread, Scene(Dish(self_contact=True)))
    predictor.start(NeedlePose(0.0, nodes[0], EAST), nodes, strict=False)
    errors = []
    for k, shape in enumerate(shapes, 1):
        out = 2.4e-3 * math.sin(math.pi * k / 160) ** 2
        prediction = predictor.step(NeedlePose(k / RATE, nodes[0] + (0.0, out), EAST))
        errors.append(float(np.linalg.norm(prediction.positions - shape, axis=1).mean()) / LENGTH)
    assert np.mean(errors) < 0.005


@pytest.mark.parametrize("seed", range(3))
def test_no_random_motion_takes_the_rigs_thread_through_itself(seed: int):
    done = move_rig(seed, True, 150)
    assert done.crossed == 0
    assert done.refused == 0


def test_the_scene_decides_for_the_rig_too():
    settings, deep, thin = RigSettings(), Scene(Dish()), Scene(Dish(depth=1e-4))
    assert [settings.surface(scene).self_contact for scene in (deep, thin)] == [False, True]
    coiled = replace(settings, thread_start_curvature=1.1 * 2.0 * math.pi / settings.thread_length)
    coiled.check_scene(deep)
    with pytest.raises(ConfigurationError, match="lie on itself"):
        coiled.check_scene(thin)
