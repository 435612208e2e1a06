"""The wall of the dish: nothing passes it, and what slides along it is where a finer rod is."""

from __future__ import annotations

import math

import numpy as np
import pytest

from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import arc_lengths, points_at
from magnetosuture_thread.model.formulations import StepResult
from magnetosuture_thread.model.prediction import NeedlePose
from magnetosuture_thread.model.predictor import ThreadPredictor
from magnetosuture_thread.model.thread import MATERIALS, Attachment, Thread
from magnetosuture_thread.rig.mechanics.dynamics import NeedleJoint, RigDynamics, Surface, ThreadProperties
from magnetosuture_thread.rig.mechanics.needle import NeedleBody
from test.model.formulations.scenes import DT, TOLERANCE, east, followed, formulated, polyamide, straight

RADIUS = 0.0175
OUTSIDE = 1e-6  # m; farther outside of the dish no node may be


def outside(thread: Thread, steps: list[StepResult], radius: float = RADIUS) -> float:
    """Return how far a node behind the needle's tail ever is outside, negative if none is [m]."""
    distance = max(float(np.linalg.norm(done.state.positions[1:, :2], axis=1).max()) for done in steps)
    return distance + 0.5 * thread.diameter - radius


@pytest.mark.parametrize("attachment", Attachment)
@pytest.mark.parametrize("name", ["rod", "paper"])
@pytest.mark.parametrize("speed", [0.005, 0.1])
def test_a_thread_pushed_sideways_into_the_wall_slides_along_it(name: str, attachment: Attachment, speed: float):
    thread = polyamide(attachment)
    formulation = formulated(thread, name=name, wall=RADIUS)
    begin = straight(thread) + np.array([0.004, 0.012])
    steps = followed(formulation, begin, lambda k: begin[0] + min(k * speed * DT, 0.0045) * np.array([0.2, 1.0]), 100)
    assert -2e-5 < outside(thread, steps) < OUTSIDE
    assert all(done.converged for done in steps)
    wall = formulation.margins(steps[-1].state.positions, east())[-1]
    assert wall.name == "wall"
    assert wall.clearance[wall.nodes[:, 0] > 0].min() > -OUTSIDE


@pytest.mark.parametrize("name", ["rod", "paper"])
def test_a_thread_longer_than_the_dish_is_wide_stays_in_it(name: str):
    """A coil of stiff thread opens until the wall holds it; then its needle is prescribed about fast."""
    thread = Thread.of(MATERIALS["polyamide_7_0"], length=0.12, segments=60, attachment=Attachment.CLAMPED)
    formulation = formulated(thread, name=name, wall=RADIUS)
    around = -np.arange(61) * 2.0 * math.asin(0.5 * thread.segment_length / 0.016) + 0.5 * math.pi
    begin = 0.016 * np.column_stack([np.cos(around), np.sin(around)])
    west = np.array([-1.0, 0.0])
    resting = followed(formulation, begin, lambda k: begin[0], 60, heading=west)
    assert outside(thread, resting) < OUTSIDE
    last = resting[-1].state.positions
    prescribed = followed(formulation, last, lambda k: begin[0] * math.cos(0.1 * k), 120, heading=west)
    assert outside(thread, prescribed) < OUTSIDE
    assert name == "paper" or outside(thread, prescribed) > -1e-5  # which presses on nothing


@pytest.mark.parametrize("name", ["rod", "paper"])
def test_the_wall_is_a_cylinder_in_space(name: str):
    thread = polyamide(segments=20)
    formulation = formulated(thread, name=name, dimension=3, wall=RADIUS)
    begin = straight(thread, 3) + np.array([0.009, 0.014, 0.002])
    steps = followed(formulation, begin, lambda k: begin[0] + 5e-5 * min(k, 50) * np.array([0.0, 1.0, 2.0]), 60)
    assert -2e-5 < outside(thread, steps) < OUTSIDE
    assert np.ptp(steps[-1].state.positions[:, 2]) > 1e-3  # along the wall it goes as it likes


@pytest.mark.parametrize("name", ["rod", "paper"])
def test_a_wall_that_is_far_away_changes_nothing(name: str):
    thread = polyamide()
    with_wall, without = (formulated(thread, name=name, wall=radius) for radius in (0.1, math.inf))
    one, other = (
        followed(formulation, straight(thread), lambda k: 2e-4 * np.array([0.0, k]), 30)
        for formulation in (with_wall, without)
    )
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.state.positions, b.state.positions)


def rim_way(time: float, speed: float, start: float) -> tuple[np.ndarray, float]:
    """Return the tail and heading of a needle that goes around half a millimetre from the rim."""
    radius = RADIUS - 5e-4
    angle = start + speed * time / radius
    return radius * np.array([math.cos(angle), math.sin(angle)]), angle + 0.5 * math.pi


@pytest.mark.parametrize("attachment", Attachment)
def test_polyamide_along_the_rim_is_where_the_rig_has_it(attachment: Attachment):
    """1 to 3.5 % of its length is a thread off on average that knows no wall."""
    thread, speed, rate = polyamide(attachment), 0.005, 33.0
    tail, heading = rim_way(0.0, speed, 0.0)
    behind = -np.linspace(0.0, 1.05 * thread.length / (RADIUS - 7e-4), 200)
    start = (RADIUS - 5e-4) * np.column_stack([np.cos(behind), np.sin(behind)])
    material = MATERIALS[thread.material]
    rig = RigDynamics(
        NeedleBody(length=7e-3, diameter=4e-4, curvature=0.0, magnetisation=0.0, viscosity=1.0),
        ThreadProperties(
            length=thread.length,
            segments=80,
            bending_stiffness=thread.bending_stiffness,
            stretching_stiffness=material.elastic_modulus * 0.25 * math.pi * thread.diameter**2,
            drag_across=thread.medium.drag_across,
            drag_along=thread.medium.drag_along,
            attachment=NeedleJoint(attachment.value),
            diameter=thread.diameter,
        ),
        Surface(wall_radius=RADIUS),
        None,
        tail,
        heading,
        start,
    )
    errors: dict[float, list[float]] = {RADIUS: [], math.inf: []}
    predictors = {}
    for wall in errors:
        predictors[wall] = ThreadPredictor(thread, Workspace((), 5e-3, 2, wall), residual_tolerance=TOLERANCE)
    furthest = 0.0
    for frame in range(int(6.0 * rate)):
        tail, heading = rim_way(frame / rate, speed, 0.0)
        if frame:
            rig.drive(tail, heading, 1.0 / rate)
        pose = NeedlePose(frame / rate, tail, np.array([math.cos(heading), math.sin(heading)]))
        at = arc_lengths(rig.thread)[-1] * np.linspace(0.0, 1.0, thread.segments + 1)
        truth = points_at(rig.thread, at)
        for wall, predictor in predictors.items():
            predicted = predictor.step(pose) if frame else predictor.start(pose, rig.thread)
            off = np.linalg.norm(predicted.positions - truth, axis=1)[1:].mean() / thread.length
            errors[wall].append(float(off))
            if wall == RADIUS:
                furthest = max(furthest, float(np.linalg.norm(predicted.positions[1:], axis=1).max()))
    assert furthest < RADIUS - 0.5 * thread.diameter + OUTSIDE
    assert np.mean(errors[RADIUS]) < 0.0005
    assert max(errors[RADIUS]) < 0.0015
    assert max(errors[math.inf]) > 5.0 * max(errors[RADIUS])
