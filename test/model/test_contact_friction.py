"""Coulomb friction of the thread at contacts: closed forms, stick and slip."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.friction import DIAMETER, DRAG, EAST, POST, RATE, SPEED, capstan
from magnetosuture_thread import ConfigurationError, Disc, NeedlePose, Polygon, Scene, ThreadPredictor, Workspace
from magnetosuture_thread.model.margins import FrictionState
from magnetosuture_thread.model.thread import Attachment, Medium, Thread
from magnetosuture_thread.scene import Dish, SceneShape


def thread_of(length: float, segments: int, medium: Medium, bending_stiffness: float = 0.0) -> Thread:
    return Thread("thread", length, segments, DIAMETER, bending_stiffness, medium, Attachment.PINNED)


@pytest.mark.parametrize("angle", [0.5 * math.pi, 2.0 * math.pi])
@pytest.mark.parametrize("friction", [0.1, 0.3, 0.5])
def test_a_flexible_thread_around_a_post_has_the_tensions_of_a_capstan(friction: float, angle: float):
    """T_2 = T_1 exp(mu theta) + f r (exp(mu theta) - 1) / mu, with the drag f per length of the part on the post."""
    predictor, nodes = capstan(friction, angle, 120)
    radius, ratios = POST + 0.5 * DIAMETER, []
    for k in range(1, 26):
        prediction = predictor.step(NeedlePose(k / RATE, nodes[0] + SPEED * k / RATE * EAST, EAST))
        assert prediction.converged
        assert prediction.residual < 1e-6
        forces, along = prediction.forces, np.diff(prediction.positions, axis=0)
        assert forces is not None
        touching = np.flatnonzero(forces.friction_use > 0.0)
        first, last = touching[0] - 1, touching[-1]  # segments before and behind the post
        theta = np.ptp(np.unwrap(np.arctan2(along[:, 1], along[:, 0]))[first : last + 1])
        gain = math.exp(friction * theta)
        wanted = forces.tension[last] * gain + DRAG * SPEED * radius * (gain - 1.0) / friction
        ratios.append(forces.tension[first] / wanted)
        if k > 15:
            assert {forces.friction_states[node] for node in touching} == {FrictionState.SLIDING}
    assert np.mean(ratios[15:]) == pytest.approx(1.0, abs=0.02)


def test_a_thread_that_a_flow_presses_on_a_wall_is_pulled_against_drag_and_friction():
    """T(s) = (zeta_par v + mu zeta_perp w) s from the loose end on; once the needle rests it stays."""
    block = Polygon(((-0.03, -0.01), (0.01, -0.01), (0.01, -0.5 * DIAMETER), (-0.03, -0.5 * DIAMETER)))
    medium, friction, speed, flow = Medium(1.0, 0.5, flow=(0.0, -2e-3)), 0.4, 1e-3, 2e-3
    predictor = ThreadPredictor(thread_of(0.015, 30, medium, 1e-12), Workspace((block,), 2e-3, friction=(friction,)))
    east = np.array([1.0, 0.0])
    predictor.start(NeedlePose(0.0, np.zeros(2), east))
    for k in range(1, 31):
        prediction = predictor.step(NeedlePose(k / RATE, speed * k / RATE * east, east))
    forces = prediction.forces
    assert forces is not None
    assert set(forces.friction_states[1:]) == {FrictionState.SLIDING}
    middles = (np.arange(30) + 0.5) * 0.0005
    wanted = (0.5 * speed + friction * flow) * (0.015 - middles)
    assert forces.tension[:-1] == pytest.approx(wanted[:-1], rel=0.02)  # the last has the end correction of the drag
    for k in range(31, 61):
        rests = predictor.step(NeedlePose(k / RATE, speed * 30 / RATE * east, east))
    assert np.abs(rests.positions - prediction.positions).max() < 1e-7


@pytest.mark.parametrize(("friction", "held"), [(0.0, False), (0.5, True)])
def test_a_thread_held_by_friction_does_not_creep(friction: float, held: bool):
    """A flow draws at both ends of a thread around a post, harder at the longer one."""
    medium = Medium(1.0, 0.5, flow=(1e-3, 0.0))
    predictor = ThreadPredictor(
        thread_of(0.0195, 90, medium, 1e-13), Workspace((Disc((0.0, 0.0), 1e-3),), 2e-3, friction=(friction,))
    )
    turned, radius = np.linspace(math.pi / 2, 1.5 * math.pi, 40), 1e-3 + 0.5 * DIAMETER
    around = radius * np.column_stack([np.cos(turned), np.sin(turned)])
    path = np.vstack([[(4e-3, 3e-3), (5e-3, 2.5e-3), (5e-3, 1.6e-3)], around, [(0.03, -radius)]])
    rest = NeedlePose(0.0, path[0], np.array([-1.0, 0.0]))
    predictor.start(rest, path)
    along = [predictor.step(NeedlePose(0.1 * k, rest.tail, rest.heading)).positions[-1, 0] for k in range(1, 151)]
    assert (abs(along[-1] - along[75]) < 1e-7) == held


def test_the_scene_gives_each_shape_and_the_wall_its_friction():
    shapes = (
        SceneShape("smooth", "tissue", Disc((0.005, 0.0), 1e-3)),
        SceneShape("rough", "tissue", Disc((-0.005, 0.0), 1e-3), friction=0.3),
    )
    predictor = ThreadPredictor.create(
        "silk_6_0", length=0.01, segments=20, scene=Scene(Dish(wall_friction=0.2), shapes)
    )
    assert predictor.formulation.workspace.friction == (0.0, 0.3)
    assert predictor.formulation.workspace.wall_friction == 0.2
    paper = ThreadPredictor.create(
        "silk_6_0", length=0.01, segments=20, scene=Scene(Dish(), shapes), formulation="paper"
    )
    assert paper.formulation.workspace.friction == (0.0, 0.0)  # as printed, it has none


@pytest.mark.parametrize("value", [-0.1, 2.1, math.nan, math.inf])
def test_a_coefficient_out_of_bounds_is_refused(value: float):
    with pytest.raises(ConfigurationError, match=r"friction\[0\]"):
        Workspace((Disc((0.0, 0.0), 1e-3),), 1e-3, friction=(value,))
    with pytest.raises(ConfigurationError, match="wall_friction"):
        Workspace((), 1e-3, wall_friction=value)


def test_friction_is_of_the_plane_and_has_a_value_for_each_shape():
    with pytest.raises(ConfigurationError, match="plane"):
        Workspace((Disc((0.0, 0.0, 0.0), 1e-3),), 1e-3, 3, friction=(0.1,))
    with pytest.raises(ConfigurationError, match="one for each"):
        Workspace((), 1e-3, friction=(0.1,))
