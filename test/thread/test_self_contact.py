"""A thread that may not pass through itself, in the plane."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely

from benchmarks.self_contact import move_model
from magnetosuture_thread import InvalidInputError, NeedlePose, Scene, ThreadPredictor
from magnetosuture_thread.geometry.scene import Dish
from magnetosuture_thread.thread.barriers import SelfContact
from magnetosuture_thread.thread.material import Attachment, Medium, Thread

EAST = np.array([1.0, 0.0])
DIAMETER = 60e-6
RATE = 60.0


def soft(segments: int = 40, length: float = 0.019) -> Thread:
    return Thread("soft", length, segments, DIAMETER, 2e-12, Medium(1.0, 0.5), Attachment.PINNED)


def predictor_of(self_contact: bool | None, thread: Thread | None = None, depth: float = 0.003) -> ThreadPredictor:
    return ThreadPredictor(thread or soft(), Scene(Dish(0.035, depth, self_contact=self_contact)))


def loop_behind(length: float, gap: float) -> np.ndarray:
    """Return a thread that goes round a circle and ends beside its beginning, a gap outside of the circle [m]."""
    radius = length / (2.0 * math.pi + 1.5)
    turn = np.linspace(0.0, length / radius, 400)
    away = radius + gap * np.clip(turn - 2.0 * math.pi + 0.5, 0.0, 1.0)
    return np.column_stack([-away * np.sin(turn), away * np.cos(turn) - radius])


def test_the_rows_are_the_distances_of_nodes_from_segments():
    """The closest places of segments that do not cross are a node of one and a place of the other."""
    random = np.random.default_rng(3)
    thread = soft(30)
    rows_of = SelfContact(thread)
    for _ in range(20):
        turns = np.cumsum(0.6 * random.standard_normal(30))
        steps = thread.segment_length * np.column_stack([np.cos(turns), np.sin(turns)])
        nodes = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
        if not shapely.LineString(nodes).is_simple:
            continue
        near = []
        for i in range(30):
            for j in range(i + 2, 30):
                gap = shapely.LineString(nodes[i : i + 2]).distance(shapely.LineString(nodes[j : j + 2]))
                near.append(gap - DIAMETER)
        rows = rows_of.rows(nodes)
        wanted = min(near)
        if wanted < 0.4 * thread.segment_length:
            assert rows.value.min() == pytest.approx(wanted, abs=1e-12)
        for row in range(len(rows.value)):
            for place, node in enumerate(rows.nodes[row]):
                moved = nodes.copy()
                moved[node] += (1e-9, 2e-9)
                again = rows_of.rows(moved)
                same = np.flatnonzero((again.nodes == rows.nodes[row]).all(axis=1))
                slope = rows.gradient[row, place] @ (1e-9, 2e-9)
                assert again.value[same] - rows.value[row] == pytest.approx(slope, abs=1e-13)


@pytest.mark.parametrize(("seed", "steps"), [(0, 200), (1, 200), (92, 300), (106, 300)])
def test_no_random_motion_takes_a_thread_through_itself(seed: int, steps: int):
    """`python -m benchmarks contact` does a thousand of them."""
    done = move_model(seed, True, steps)
    assert done.crossed == 0
    assert done.unconverged + done.refused <= 0.1 * done.steps


def test_a_loop_closes_and_opens_again():
    """The needle draws its end of a loop against the other, farther, and back: crossed in between if it may."""
    clearances, crossings, ends = {}, {}, {}
    for may_touch in (True, False):
        predictor = predictor_of(may_touch)
        nodes = loop_behind(0.0195, 1.2e-3)
        predictor.start(NeedlePose(0.0, nodes[0], EAST), nodes, strict=False)
        simple, clearance = [], []
        for k in range(1, 161):
            out = 2.4e-3 * math.sin(math.pi * k / 160) ** 2
            prediction = predictor.step(NeedlePose(k / RATE, nodes[0] + (0.0, out), EAST))
            assert prediction.converged
            assert prediction.residual < 1e-6
            simple.append(shapely.LineString(prediction.positions).is_simple)
            clearance.append(prediction.margins["self_contact"].minimum_clearance if may_touch else math.inf)
        clearances[may_touch], crossings[may_touch] = np.array(clearance), simple.count(False)
        ends[may_touch] = prediction.positions
    assert crossings[True] == 0
    assert crossings[False] > 40
    touching = clearances[True] < 1e-6
    assert touching[80]
    assert clearances[True].min() > -2e-7
    assert not touching[0]
    assert not touching[-1]


def test_the_depth_decides_where_the_scene_says_nothing():
    assert predictor_of(None, depth=1e-4).formulation.touches_itself
    assert not predictor_of(None, depth=2e-4).formulation.touches_itself
    assert not predictor_of(False, depth=1e-5).formulation.touches_itself


def test_a_thread_that_starts_across_itself_is_refused_where_it_may_not():
    turn = np.linspace(0.0, 1.9 * math.pi, 200)
    nodes = 4e-3 * np.column_stack([np.sin(turn), 0.5 * np.sin(2.0 * turn)])  # an eight
    predictor_of(False).start(NeedlePose(0.0, nodes[0], EAST), nodes, strict=False)
    predictor = predictor_of(True)
    with pytest.raises(InvalidInputError, match=r"1 crossings, the first at .* mm"):
        predictor.start(NeedlePose(0.0, nodes[0], EAST), nodes, strict=False)
    assert not predictor.started
