"""The predictor: stamps, starts and bad input."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from magnetosuture_thread.geometry.obstacles import Disc, Polygon, Workspace
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.thread.material import MATERIALS, Attachment, Thread
from magnetosuture_thread.thread.prediction import NeedleMotion, NeedlePose
from magnetosuture_thread.thread.predictor import ThreadPredictor
from test.shared import known

THREAD = Thread.of(MATERIALS["polyamide_7_0"], length=0.019, segments=25, attachment=Attachment.PINNED)


def pose(stamp: float, x: float = 0.0, y: float = 0.0, angle: float = 0.0) -> NeedlePose:
    """Return a needle pose."""
    return NeedlePose(stamp, np.array([x, y]), np.array([np.cos(angle), np.sin(angle)]))


def new(obstacles: tuple[Disc | Polygon, ...] = (), **options: Any) -> ThreadPredictor:
    """Return a predictor that has not started."""
    return ThreadPredictor(THREAD, Workspace(obstacles, 5e-3), **options)


def started(obstacles: tuple[Disc | Polygon, ...] = (), **options: Any) -> ThreadPredictor:
    """Return a predictor of a thread that lies straight behind the needle."""
    predictor = new(obstacles, **options)
    predictor.start(pose(0.0), np.array([[0.0, 0.0], [-0.019, 0.0]]))
    return predictor


@pytest.mark.slow
def test_space_is_refused_at_the_start_in_the_plane_and_works_in_a_workspace_of_three_dimensions():
    east = NeedlePose(0.0, np.zeros(3), np.eye(3)[0])
    with pytest.raises(InvalidInputError, match=r"expected shapes \(2,\); in space, with a Workspace of dimension=3"):
        ThreadPredictor.create("polyamide_7_0", length=0.019, segments=25).start(east)
    predictor = ThreadPredictor(THREAD, Workspace((), 5e-3, dimension=3))
    assert predictor.start(east).tension is None
    prediction = predictor.step(NeedlePose(0.02, np.array([1e-4, 0.0, 1e-4]), np.eye(3)[0]))
    assert prediction.converged
    assert prediction.tension is known(prediction.forces).tension
    moving = NeedlePose(0.04, np.zeros(3), np.eye(3)[0], motion=NeedleMotion(np.zeros(3), 0.0))
    with pytest.raises(InvalidInputError, match="expected None, as it turns in the plane only"):
        predictor.step(moving)


def test_steps_are_bounded_whatever_the_interval():
    predictor = started()
    assert predictor.step(pose(1.0 / 66.0)).substeps == 1
    assert predictor.step(pose(1.0 / 66.0 + 1.0 / 30.0, 1e-4)).substeps == 2
    late = predictor.step(pose(100.0, 2e-3))
    assert late.substeps == 200
    assert late.interval == pytest.approx(100.0 - 1.0 / 66.0 - 1.0 / 30.0)
    assert np.abs(late.strain).max() < 1e-3


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (pose(float("nan")), "a finite time"),
        (pose(1.0, float("nan")), "finite coordinates"),
        (pose(1.0, 5.0), "at most 1 m from the dish's centre; given in metres?"),
        (NeedlePose(1.0, np.zeros(2), np.array([2.0, 0.0])), "a unit vector"),
        (pose(-1.0), "later than"),
    ],
)
def test_a_bad_pose_is_refused_and_changes_nothing(bad: NeedlePose, words: str):
    predictor, untouched = started(), started()
    with pytest.raises(InvalidInputError, match=words):
        predictor.step(bad)
    after, expected = predictor.step(pose(0.1, 1e-4)), untouched.step(pose(0.1, 1e-4))
    np.testing.assert_array_equal(after.positions, expected.positions)


def test_a_start_needs_a_centreline():
    predictor = new()
    with pytest.raises(InvalidInputError, match="a centreline first"):
        predictor.step(pose(0.0))
    for centreline, words in (
        (np.zeros((1, 2)), "1 points"),
        (np.array([[0.0, 0.0], [np.nan, 0.0]]), "finite numbers"),
        (np.array([[0.0, 0.0], [1e-5, 0.0]]), "1.00e-05 m long"),
        (np.array([[0.005, 0.0], [0.02, 0.0]]), "5.00e-03 m from the needle's tail"),
    ):
        with pytest.raises(InvalidInputError, match=f"centreline.*{words}"):
            predictor.start(pose(0.0), centreline)
    assert not predictor.started


@pytest.mark.parametrize(
    ("prescribed", "words"),
    [
        ({0: np.zeros(2)}, "node 0 follows the needle"),
        ({26: np.zeros(2)}, "a node from 1 to 25"),
        ({25: np.array([np.nan, 0.0])}, "position of node 25"),
        ({25: np.array([11.0, 0.0])}, "numbers from -1.019 to 1.019 m"),
    ],
)
def test_driven_nodes_that_cannot_be_are_refused(prescribed: dict[int, np.ndarray], words: str):
    with pytest.raises(InvalidInputError, match=words):
        started().step(pose(0.1), prescribed)
    with pytest.raises(InvalidInputError, match="fixed node"):
        new(fixed_nodes=(26,))


def test_margins_do_not_depend_on_what_was_near_before():
    """The nearest edge of a polygon is looked for where it was in the margins before."""
    around = 2.0 * np.pi * np.arange(200) / 200
    star = 3e-3 * (1.0 + 0.3 * np.cos(9.0 * around))[:, None] * np.column_stack([np.cos(around), np.sin(around)])
    shapes = Polygon(tuple(map(tuple, star.tolist()))), Polygon(((5e-3, 0.0), (6e-3, -1e-3), (6e-3, 1e-3)))
    used = new(shapes)
    for k, angle in enumerate(np.linspace(0.0, 5.0, 12)):
        heading = np.array([np.cos(angle), np.sin(angle)])
        nodes = 5e-3 * heading[::-1] - THREAD.segment_length * np.arange(THREAD.segments + 1.0)[:, None] * heading
        at = NeedlePose(float(k), nodes[0], heading)
        known, fresh = (predictor.start_at(at, nodes).margins["obstacle"] for predictor in (used, new(shapes)))
        assert len(fresh) > 0
        for name in ("node", "obstacle", "value", "clearance", "normal"):
            np.testing.assert_array_equal(getattr(known, name), getattr(fresh, name))
        distance = Workspace(shapes, 5e-3).near(nodes)
        np.testing.assert_allclose(fresh.value, distance.distance[distance.nearest] - 0.5 * THREAD.diameter, atol=1e-15)


@pytest.mark.parametrize("formulation", ["rod", "paper"])
@pytest.mark.parametrize("segments", [3.0, 24.0])
def test_a_needle_that_jumps_by_many_segments_is_followed(segments: float, formulation: str):
    predictor = started(formulation=formulation)
    jump = segments * THREAD.segment_length
    prediction = predictor.step(pose(1.0 / 60.0, -jump, 0.2 * jump))
    assert prediction.substeps >= 2.0 * segments
    assert np.all(np.isfinite(prediction.positions))
    for k in range(2, 120):
        prediction = predictor.step(pose(k / 60.0, -jump, 0.2 * jump))
    assert prediction.strain.max() < 5e-3
    assert prediction.residual < 1e-6


@example(  # a disc that a segment's chord lies in, and not its arc
    turns=[0.5, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0],
    speed=0.015625,
    disc=(0.0, 0.004, 0.001953125),
    corners=[(0.0, 0.00390625), (1.0, 0.00390625), (2.0, 0.00390625)],
)
@settings(max_examples=40, deadline=None)
@given(
    turns=st.lists(st.floats(-0.6, 0.6), min_size=5, max_size=40),
    speed=st.floats(0.0, 0.03),
    disc=st.tuples(st.floats(-0.02, 0.02), st.floats(0.004, 0.012), st.floats(5e-4, 3e-3)),
    corners=st.lists(
        st.tuples(st.floats(0.0, 6.28), st.floats(1e-3, 4e-3)),
        min_size=3,
        max_size=9,
        unique_by=lambda c: round(c[0], 1),
    ),
)
def test_any_motion_keeps_the_promises(
    turns: list[float], speed: float, disc: tuple[float, float, float], corners: list[tuple[float, float]]
):
    """No NaN, no segment stretched by more than half a percent, no node in an obstacle, residuals proven."""
    outer = disc[2] + 0.5 * THREAD.diameter
    sagitta = outer * (1.0 - np.cos(0.5 * THREAD.segment_length / outer))
    obstacles: list[Disc | Polygon] = [Disc((disc[0], disc[1]), disc[2])]
    angles = np.sort([corner[0] for corner in corners])
    if np.diff(np.append(angles, angles[0] + 2.0 * np.pi)).max() < 3.0:  # else not around its middle
        star = tuple(
            (-0.009 + r * np.cos(a), -0.006 + r * np.sin(a)) for a, (_, r) in zip(angles, corners, strict=True)
        )
        polygon = Polygon(star)
        if polygon.can_contain(0.5 * THREAD.segment_length):
            obstacles.append(polygon.smoothed(1e-4))
    predictor = started(tuple(obstacles))
    around = Workspace(obstacles, 5e-3)
    where, angle = np.zeros(2), 0.0
    for k, turn in enumerate(turns, start=1):
        angle += turn
        ahead = where + speed / 30.0 * np.array([np.cos(angle), np.sin(angle)])
        if not (around.near(ahead[None]).distance < 2e-4).any():  # the needle itself must not enter
            where = ahead
        prediction = predictor.step(pose(k / 30.0, where[0], where[1], angle))
        assert np.all(np.isfinite(prediction.positions))
        assert prediction.converged
        assert np.abs(prediction.strain).max() < 5e-3
        assert prediction.residual < 1e-6
        obstacle = prediction.margins["obstacle"]
        free = obstacle.node > 0
        assert obstacle.value[free].min(initial=1.0) > -1e-6
        # Around a disc it is a segment's arc that touches, and its chord lies deeper; see `find_chord_contacts`.
        assert (obstacle.clearance + sagitta * (obstacle.obstacle == 0))[free].min(initial=1.0) > -1e-6


@settings(max_examples=40, deadline=None)
@given(
    stamps=st.lists(st.floats(-6.0, 1.0), min_size=3, max_size=15),
    seed=st.integers(0, 10_000),
    attachment=st.sampled_from(list(Attachment)),
    dimension=st.sampled_from([2, 3]),
    curvature=st.floats(-100.0, 100.0),
    fixed_nodes=st.sampled_from([(), (15,), (14, 15), (25,)]),
)
def test_any_thread_at_any_times_stays_whole(
    stamps: list[float],
    seed: int,
    attachment: Attachment,
    dimension: int,
    curvature: float,
    fixed_nodes: tuple[int, ...],
):
    """Intervals from a microsecond to ten seconds, in the plane and in space, curled, clamped, and fixed."""
    random = np.random.default_rng(seed)
    thread = Thread.of(
        MATERIALS["polyamide_7_0"], length=0.019, segments=25, attachment=attachment, rest_curvature=curvature
    )
    predictor = ThreadPredictor(thread, Workspace((), 5e-3, dimension), fixed_nodes=fixed_nodes)
    east = np.eye(dimension)[0]
    where, time = np.zeros(dimension), 0.0
    # Not quite straight: what is, in theory, can be pushed together and does not know to which side to bend.
    side = np.eye(dimension)[1]
    along = np.linspace(0.0, 0.019, 50)[:, None]
    predictor.start(NeedlePose(0.0, where, east), where - along * east + 20.0 * along**2 * side)
    for stamp in stamps:
        time += 10.0**stamp
        # Towards what is fixed, so that the thread is long enough.
        where = where + random.uniform(0.0, 1.0) * 2e-4 * (
            random.normal(size=dimension) * (not fixed_nodes) - 0.5 * east
        )
        heading = east + 0.3 * random.normal(size=dimension)
        prediction = predictor.step(NeedlePose(time, where, heading / np.linalg.norm(heading)))
        assert np.isfinite(prediction.positions).all()
        assert prediction.residual < 1e-6
        assert np.abs(prediction.strain).max() < 5e-3 or not prediction.converged
        assert np.abs(prediction.strain).max() < 5e-2


@pytest.mark.parametrize("twin", [copy.deepcopy, copy.copy, lambda predictor: pickle.loads(pickle.dumps(predictor))])
def test_a_copy_of_a_predictor_goes_on_alike_and_leaves_the_original_alone(twin: Callable[[Any], Any]):
    predictor, other = started((Disc((-0.005, 0.002), 0.0015),)), started((Disc((-0.005, 0.002), 0.0015),))
    for k in range(1, 20):
        prediction = predictor.step(pose(0.02 * k, 0.0, 1e-4 * k))
        other.step(pose(0.02 * k, 0.0, 1e-4 * k))
    copied, told = twin(predictor), twin(prediction)
    np.testing.assert_array_equal(told.margins["obstacle"].clearance, prediction.margins["obstacle"].clearance)
    np.testing.assert_array_equal(told.tension, prediction.tension)
    expected = [other.step(pose(0.02 * k, 0.0, 1e-4 * k)).positions for k in range(20, 24)]
    for original in (copied, predictor):
        found = [original.step(pose(0.02 * k, 0.0, 1e-4 * k)).positions for k in range(20, 24)]
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("stamp", [np.float32(0.5), np.longdouble(0.5), np.array(0.5), np.array(1), np.int64(1), 1])
def test_a_stamp_may_be_a_number_of_any_library(stamp: Any):
    assert ThreadPredictor(THREAD).start(replace(pose(0.0), stamp=stamp)).stamp == float(stamp)


@pytest.mark.parametrize("stamp", [True, np.array([0.5]), np.bool_(True), "0.5", None, np.float32("nan")])
def test_what_is_no_number_is_no_stamp(stamp: Any):
    with pytest.raises(InvalidInputError, match=r"needle pose stamp: got .+ a finite time"):
        ThreadPredictor(THREAD).start(replace(pose(0.0), stamp=stamp))


def test_a_heading_is_normalised_within_one_per_cent():
    exact = pose(0.0, angle=math.atan2(0.8, 0.6))
    for factor in (0.991, 1.0016, 1.009):
        np.testing.assert_allclose(replace(exact, heading=factor * exact.heading).heading, [0.6, 0.8], rtol=1e-15)
    assert replace(exact, heading=exact.heading).heading is exact.heading
    for factor in (0.98, 1.02, 0.0):
        with pytest.raises(InvalidInputError, match=f"norm {factor:g}, expected a unit vector"):
            ThreadPredictor(THREAD).start(replace(exact, heading=factor * exact.heading))
