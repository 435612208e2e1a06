"""The test for disturbances: relaxation by bending, and errors of the needle's pose, which are no disturbance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from magnetosuture_thread.estimator import Disturbance, ThreadEstimator
from magnetosuture_thread.estimator.disturbance import BendingRelaxation, DisturbanceTest
from magnetosuture_thread.thread.material import MATERIALS, Attachment, Thread
from magnetosuture_thread.thread.prediction import NeedlePose
from magnetosuture_thread.thread.predictor import ThreadPredictor
from magnetosuture_thread.thread_observation import ThreadObservation
from test.estimator.threads import RATE, piece_of, true_shapes

TAIL_ERROR, HEADING_ERROR = 3e-5, 5e-3


@pytest.mark.parametrize("clamped", [False, True])
def test_relaxation_solves_its_equation(clamped: bool) -> None:
    rng, amount = np.random.default_rng(2), 3.7
    displacement, slope = rng.normal(size=(12, 2)), rng.normal(size=2)
    curvature = np.zeros((12, 12))
    for node in range(1, 11):
        curvature[node, node - 1 : node + 2] = 1.0, -2.0, 1.0
    curvature[0, :2] = (-np.sqrt(2.0), np.sqrt(2.0)) if clamped else 0.0
    relaxed = BendingRelaxation(11, clamped).relaxed(amount, displacement, slope)
    moment = curvature @ relaxed
    moment[0] -= np.sqrt(2.0) * slope if clamped else 0.0
    residual = relaxed - displacement + amount * curvature.T @ moment
    assert np.abs(residual[1:]).max() < 1e-12
    assert np.array_equal(relaxed[0], displacement[0])


@pytest.mark.parametrize(("material", "attachment"), [("silk_6_0", "pinned"), ("polyamide_7_0", "clamped")])
def test_a_pose_that_is_a_little_off_is_no_disturbance(material: str, attachment: str) -> None:
    thread = Thread.of(MATERIALS[material], length=0.019, segments=25, attachment=Attachment(attachment))
    angles = 0.4 * np.sin(np.arange(120) / RATE)
    headings = np.column_stack([np.cos(angles), np.sin(angles)])
    tails = np.array([-5e-3, 0.0]) + 2e-3 * np.cumsum(headings, axis=0) / RATE
    way = [NeedlePose(k / RATE, tails[k], headings[k]) for k in range(len(tails))]
    truth = true_shapes(thread, way)
    estimator = ThreadEstimator(ThreadPredictor(thread))
    found: list[Disturbance] = []
    for k, pose in enumerate(way):
        turned = angles[k] + HEADING_ERROR
        measured = replace(
            pose,
            tail=pose.tail + TAIL_ERROR * np.array([-np.sin(angles[k]), np.cos(angles[k])]),
            heading=np.array([np.cos(turned), np.sin(turned)]),
            deviation=(TAIL_ERROR, HEADING_ERROR),
        )
        seen = ThreadObservation((piece_of(truth[k], k, deviation=5e-6),), complete=True)
        estimate = estimator.start(measured, truth[0]) if k == 0 else estimator.step(measured, seen)
        found += estimate.disturbances
    assert not found


def test_a_bent_thread_that_is_held_is_estimated_where_it_is_and_the_hold_is_reported() -> None:
    """As in `hernia_ring` before the first current: left alone the thread would straighten, and the model's does."""
    pinned = Attachment.PINNED
    thread = Thread.of(MATERIALS["silk_6_0"], length=0.05, segments=40, attachment=pinned, viscosity=0.3)
    turn = np.cumsum(np.full(40, 60.0 * thread.segment_length))
    along = -thread.segment_length * np.column_stack([np.cos(turn), np.sin(turn)])
    held = np.vstack([np.zeros(2), np.cumsum(along, axis=0)])
    estimator, alone = ThreadEstimator(ThreadPredictor(thread)), ThreadPredictor(thread)
    way = [NeedlePose(k / RATE, np.zeros(2), np.array([1.0, 0.0])) for k in range(round(4.0 * RATE))]
    alone.start_at(way[0], held)
    shown = [ThreadObservation((piece_of(held, k, end=thread.length),), complete=True) for k in range(len(way))]
    estimator.start_observed(way[0], shown[0])
    reported = []
    for k, pose in enumerate(way[1:], 1):
        estimate, predicted = estimator.step(pose, shown[k]), alone.step(pose).positions
        off = np.linalg.norm(estimate.positions - held, axis=1) / thread.length
        assert off.mean() < 1e-3
        assert off.max() < 3e-3
        reported.append(bool(estimate.disturbances))
    assert np.linalg.norm(predicted - held, axis=1).max() > 0.05 * thread.length
    assert any(reported[: round(0.5 * RATE)])
    assert all(reported[round(RATE) :])


def pushed(thread: Thread, node: int, size: float) -> np.ndarray:
    """Return by how much a force at a node displaces a straight thread across it in a frame, at most by a size [m]."""
    aside = np.zeros((thread.segments + 1, 2))
    aside[node, 1] = 1.0
    stiffness = thread.bending_stiffness / (thread.medium.drag_across * thread.segment_length**4)
    aside = BendingRelaxation(thread.segments, False).relaxed(stiffness / RATE, aside)
    return np.asarray(size / np.abs(aside).max() * aside)


def forces_found(contact: int | None, held: int, first_interval: float = 1.0 / RATE) -> list[tuple[Disturbance, ...]]:
    """Return what is found of a thread held at a node, where the model knows of a contact of the node `contact`."""
    thread = Thread.of(MATERIALS["polyamide_7_0"], length=0.019, segments=25, attachment=Attachment.PINNED)
    positions = np.column_stack([-thread.segment_length * np.arange(26.0), np.zeros(26)])
    normals = np.tile([0.0, -1.0], (26, 1))
    touched = np.zeros(26, dtype=np.bool_)
    touched[[] if contact is None else contact] = True
    test, found = DisturbanceTest(thread), []
    for k in range(15):
        test.decay(first_interval if k == 0 else 1.0 / RATE, touched)
        stamp, moved = k / RATE, pushed(thread, held, 4e-5)
        test.add(moved, normals, np.full(16, 1e-11), stamp, np.array([1e-5, 1e-3]))
        found.append(test.found(stamp, positions))
    return found


def test_what_a_known_contact_could_push_with_is_no_disturbance() -> None:
    assert any(forces_found(None, 25))
    assert not any(forces_found(25, 25))


def test_a_force_elsewhere_than_at_a_known_contact_is_found_where_it_is() -> None:
    (found,) = forces_found(25, 12)[-1]
    assert found.arc_length == pytest.approx(12 / 25 * 0.019, abs=2e-3)
