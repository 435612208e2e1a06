"""Contact of the simulated rig's thread with itself, and the thread model held against it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.self_contact import move_rig
from magnetosuture_thread import ConfigurationError, NeedlePose, Scene, ThreadPredictor
from magnetosuture_thread.geometry.scene import Dish
from magnetosuture_thread.rig.mechanics.dynamics import NeedleJoint, RigDynamics, Surface, ThreadProperties
from magnetosuture_thread.rig.mechanics.needle import NeedleBody
from magnetosuture_thread.rig.mechanics.rod import Rod, add_pairs, couple, factor, find_pairs
from magnetosuture_thread.rig.settings import RigSettings
from magnetosuture_thread.thread.material import Attachment, Medium, Thread

RATE, DIAMETER, EAST = 60.0, 60e-6, np.array([1.0, 0.0])
LENGTH, SEGMENTS = 0.0195, 60
SOFT = ThreadProperties(LENGTH, SEGMENTS, 2e-12, 5.65, 1.0, 0.5, NeedleJoint.PINNED, diameter=DIAMETER)


def loop_behind(gap: float) -> np.ndarray:
    """Return a thread that goes round a circle and ends beside its beginning, a gap outside of the circle [m]."""
    radius = LENGTH / (2.0 * math.pi + 1.5)
    turn = np.linspace(0.0, LENGTH / radius, 400)
    away = radius + gap * np.clip(turn - 2.0 * math.pi + 0.5, 0.0, 1.0)
    return np.column_stack([-away * np.sin(turn), away * np.cos(turn) - radius])


def rig_of(nodes: np.ndarray, surface: Surface) -> RigDynamics:
    return RigDynamics(NeedleBody(2e-4, 5e-5, 0.0, 0.0, 1.0), SOFT, surface, None, nodes[0], 0.0, nodes)


def pull_out(rig: RigDynamics, nodes: np.ndarray, steps: int = 160) -> list[np.ndarray]:
    """Draw the needle across the thread's other end and back."""
    shapes = []
    for k in range(1, steps + 1):
        out = 2.4e-3 * math.sin(math.pi * k / 160) ** 2
        rig.drive(nodes[0] + np.array([0.0, out]), 0.0, 1.0 / RATE)
        shapes.append(rig.thread)
    return shapes


def test_the_model_predicts_the_rigs_loop():
    """Both keep strands a diameter apart, by code of their own."""
    nodes = loop_behind(1.2e-3)
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


def test_energy_gradient_and_step_of_pairs_agree():
    """The gradient is that of the energy, and the corrected step solves the whole system."""
    nodes = 1e-3 * np.array([(0, 0), (1, 0), (2, 0), (2.5, 0.5), (2, 1.0), (1.4, 0.5), (1.2, 0.05), (0.6, 0.04)])
    rod = Rod(1e-3, 5.65, 1e-12, 1.0, 0.5, 0.5 * 1e-4)
    shapes, q = Surface(self_contact=True, friction=0.3).packed(), np.concatenate([[0.0], nodes.ravel()])
    pairs = np.zeros((40, 6))
    count = find_pairs(q, rod, shapes, pairs)
    assert count >= 4
    pairs, second, size = pairs[:count], np.zeros(count), len(q)
    moved = q + 1e-6 * np.random.default_rng(1).standard_normal(size)

    def energy(at: np.ndarray) -> tuple[float, np.ndarray]:
        gradient = np.zeros(size)
        return add_pairs(at, q, 1e-6, 1e-4, shapes.stiffness, pairs, second, gradient), gradient

    _, gradient = energy(moved)
    for i in range(size):
        aside = np.zeros(size)
        aside[i] = 1e-10
        slope = (energy(moved + aside)[0] - energy(moved - aside)[0]) / 2e-10
        assert slope == pytest.approx(gradient[i], abs=1e-5 * np.abs(gradient).max())
    hessian = np.array([(energy(moved + d)[1] - energy(moved - d)[1]) / 2e-10 for d in 1e-10 * np.eye(size)])
    energy(moved)
    band = np.zeros((size, 6))
    band[:, 0] = 3.0
    assert factor(band)
    step = np.ones(size) / 3.0
    couple(band, pairs, second, 0, step)
    whole = np.linalg.solve(3.0 * np.eye(size) + hessian, np.ones(size))
    np.testing.assert_allclose(step, whole, rtol=1e-4, atol=1e-6)


def test_the_scene_decides_for_the_rig_too():
    settings, deep, thin = RigSettings(), Scene(Dish()), Scene(Dish(depth=1e-4))
    assert [settings.surface(scene).self_contact for scene in (deep, thin)] == [False, True]
    coiled = replace(settings, thread_start_curvature=1.1 * 2.0 * math.pi / settings.thread_length)
    coiled.check_scene(deep)
    with pytest.raises(ConfigurationError, match="lie on itself"):
        coiled.check_scene(thin)
