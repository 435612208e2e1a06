"""Tension, contact forces and the pull on the needle: closed forms, balance, and the simulated rig's own forces."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from magnetosuture_thread import Disc, NeedlePose, ThreadPredictor
from magnetosuture_thread.geometry.obstacles import Workspace
from test.shared import known

RATE = 66.0


def pose(stamp: float, tail: ArrayLike, heading: ArrayLike) -> NeedlePose:
    """Return a pose from sequences of numbers."""
    return NeedlePose(stamp, np.array(tail, dtype=float), np.array(heading, dtype=float))


@pytest.mark.parametrize("attachment", ["pinned", "clamped"])
@pytest.mark.parametrize("segments", [10, 25])
def test_a_straight_thread_pulled_along_itself(attachment: str, segments: int):
    predictor = ThreadPredictor.create("silk_6_0", length=0.019, segments=segments, attachment=attachment)
    predictor.start(pose(0.0, (0.0, 0.0), (1.0, 0.0)))
    assert predictor.start(pose(0.0, (0.0, 0.0), (1.0, 0.0))).forces is None
    speed = 2e-3
    for k in range(1, 40):
        forces = known(predictor.step(pose(k / RATE, (speed * k / RATE, 0.0), (1.0, 0.0))).forces)
    thread, middles = predictor.thread, (np.arange(segments) + 0.5) * predictor.thread.segment_length
    drag = thread.medium.drag_along * speed
    assert forces.tension == pytest.approx(drag * (thread.length - middles), rel=1e-5)
    assert forces.needle_force == pytest.approx([-drag * thread.length, 0.0], rel=1e-5, abs=1e-12)
    assert forces.needle_moment == pytest.approx(0.0, abs=1e-15)
    assert not forces.contact.any()


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_clamped_thread_in_a_cross_flow_turns_the_needle_as_a_beam_does(side: float):
    """M = -f L^2 / 2 with the drag f per length: the flow to the left of a needle to the east turns it to the right."""
    thread = ThreadPredictor.create("polyamide_7_0", length=0.01, segments=10, attachment="clamped").thread
    load = 0.02 * 8.0 * thread.bending_stiffness / thread.length**3  # bends it by 2 % of its length
    flow = (0.0, side * load / thread.medium.drag_across)
    predictor = ThreadPredictor(replace(thread, medium=replace(thread.medium, flow=flow)))
    predictor.start(pose(0.0, (0.0, 0.0), (1.0, 0.0)))
    for k in range(1, 11):
        forces = known(predictor.step(pose(20.0 * k, (0.0, 0.0), (1.0, 0.0))).forces)
    assert forces.needle_moment == pytest.approx(-0.5 * side * load * thread.length**2, rel=0.02)


def test_contact_drag_and_needle_are_in_balance():
    """All forces on a thread without inertia add up to nothing."""
    post = Disc((-6e-3, 1.2e-3), 1.2e-3)
    thread = ThreadPredictor.create("silk_6_0", length=0.019, segments=60).thread
    predictor = ThreadPredictor(thread, Workspace((post,), 2e-3, wall_radius=0.0175))
    predictor.start(pose(0.0, (0.0, 0.0), (1.0, 0.0)))
    for k in range(1, 150):
        angle = 0.012 * k
        tail = 6e-3 * math.sin(angle), 6e-3 - 6e-3 * math.cos(angle)
        before = known(predictor.state)
        prediction = predictor.step(pose(k / RATE, tail, (math.cos(angle), math.sin(angle))))
    forces, state = known(prediction.forces), known(predictor.state)
    pressed = np.linalg.norm(forces.contact, axis=1)
    assert pressed.max() > 1e-6
    touching = np.flatnonzero(pressed > 0.0)
    outward = prediction.positions[touching] - np.array(post.centre)
    # Whether at a node or between two, it points away from the centre: outwards, and without a moment about it but for
    # what the thread has moved since the last linearisation.
    moments = outward[:, 0] * forces.contact[touching, 1] - outward[:, 1] * forces.contact[touching, 0]
    assert (np.einsum("ij,ij->i", forces.contact[touching], outward) > 0.0).all()
    assert moments.sum() == pytest.approx(0.0, abs=1e-3 * post.radius * pressed.sum())
    tangents = np.gradient(prediction.positions, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    medium, weights = thread.medium, np.ones(thread.segments + 1)
    weights[[0, -2, -1]] = 0.5, 13.0 / 12.0, 5.0 / 12.0
    velocities = 1.5 * state.velocities - 0.5 * before.velocities  # at the step's end
    slip = np.einsum("ij,ij->i", velocities, tangents)[:, None] * tangents
    drag = medium.drag_across * (velocities - slip) + medium.drag_along * slip
    total = -(weights[:, None] * drag).sum(axis=0) * thread.segment_length + forces.contact.sum(axis=0)
    assert total == pytest.approx(forces.needle_force, abs=0.01 * np.linalg.norm(forces.needle_force))
