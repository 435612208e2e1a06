"""Packed messages are those that rclpy itself would make."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PoseWithCovarianceStamped, Vector3
from magnetosuture_msgs.msg import EstimatedThread, PredictedThread, SafetyMargins, ThreadDisturbance
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.messages import reading
from magnetosuture_thread.messages.markers import packed_markers
from magnetosuture_thread.messages.packing import (
    packed_estimate,
    packed_margins,
    packed_observation,
    packed_path,
    packed_pose,
    packed_prediction,
)
from magnetosuture_thread.model.estimator import Disturbance, ThreadEstimate
from magnetosuture_thread.model.forces import ThreadForces
from magnetosuture_thread.model.margins import (
    UNKNOWN,
    BarrierMargins,
    Friction,
    FrictionState,
    Margins,
    friction_colour,
)
from magnetosuture_thread.model.prediction import Prediction
from magnetosuture_thread.nodes.messages import MESSAGES
from magnetosuture_thread.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from test.model.estimator.threads import estimator_of, poses, thread_of, true_shapes, whole

WHEN, STAMP = (12, 345), Time(sec=12, nanosec=345)


def same(data: bytes, expected: Any) -> None:
    """Compare bytes with a message; what fills the places between fields is nobody's."""
    assert len(data) == len(serialize_message(expected))
    kind = type(expected)
    assert deserialize_message(data, kind) == deserialize_message(serialize_message(expected), kind)


@pytest.mark.parametrize("when", [WHEN, (-3, 999_999_999), (0, 4_000_000_000)])
@pytest.mark.parametrize("known", [True, False])
def test_a_pose_is_packed_as_rclpy_makes_it(when: tuple[int, int], known: bool):
    covariance = np.arange(1.0, 10.0).reshape(3, 3) if known else None
    tail, heading = np.array([1e-3, -2e-3]), np.array([-0.6, 0.8])
    expected = MESSAGES.pose_message(Time(sec=when[0], nanosec=when[1]), tail, heading, covariance)
    data = packed_pose(when, tail, heading, covariance)
    same(data, expected)


@pytest.mark.parametrize("count", [0, 1, 2, 64])
def test_a_path_is_packed_as_rclpy_makes_it(count: int):
    points = np.random.default_rng(count).normal(size=(count, 2))
    expected = MESSAGES.path_message(STAMP, points)
    data = packed_path(WHEN, points)
    same(data, expected)


@pytest.mark.parametrize("touching", [None, (), (1,), (0, 2, 3)])
@pytest.mark.parametrize("segments", [0, 3, 4])
def test_a_prediction_is_packed_as_rclpy_makes_it(touching: tuple[int, ...] | None, segments: int):
    random = np.random.default_rng(segments)
    positions, strain = random.normal(size=(segments + 1, 2)), random.normal(size=segments)
    tension = np.arange(float(segments))
    forces = None
    expected = PredictedThread(
        header=Header(stamp=STAMP, frame_id="dish"),
        formulation="rod",
        scene_version="a1",
        material="silk",
        positions=[Point(x=x, y=y) for x, y in positions.tolist()],
        strain=strain.tolist(),
        solver="banded",
        solver_status="solved",
        residual=1e-9,
        interval=0.015,
        substeps=2,
        step_time=1e-4,
    )
    if touching is not None:
        contact = np.zeros((segments + 1, 2))
        nodes = [node for node in touching if node <= segments]
        contact[nodes] = random.normal(size=(len(nodes), 2))
        use = np.linspace(0.0, 1.0, segments + 1) if len(touching) == 1 else np.zeros(segments + 1)
        forces = ThreadForces(1e-6 * tension, contact, np.array([1e-6, -2e-6]), 3e-9, 1e-7 * use, use)
        if use.any():
            free, sliding = PredictedThread.FRICTION_FREE, PredictedThread.FRICTION_SLIDING
            expected.friction_states = [free, *[PredictedThread.FRICTION_STUCK] * (segments - 1), sliding]
            expected.friction_use = use.tolist()
        expected.tension, expected.contact_nodes = (1e-6 * tension).tolist(), nodes
        expected.contact_forces = [Vector3(x=x, y=y) for x, y in contact[nodes].tolist()]
        expected.needle_force, expected.needle_moment = Vector3(x=1e-6, y=-2e-6), 3e-9
    prediction = Prediction(
        0.0,
        formulation="rod",
        scene_version="a1",
        solver="banded",
        status="solved",
        positions=positions,
        strain=strain,
        interval=0.015,
        substeps=2,
        residual=1e-9,
        converged=True,
        compute_margins=lambda: Margins(()),
        compute_forces=lambda: forces,
    )
    data = packed_prediction(WHEN, prediction, "silk", step_time=1e-4)
    read = deserialize_message(data, PredictedThread)
    assert read == deserialize_message(serialize_message(expected), PredictedThread)


def observation(*counts: int, outlines: int = 2) -> ThreadObservation:
    """Return an observation of pieces with so many points."""
    random = np.random.default_rng(sum(counts))
    pieces = tuple(
        ThreadPiece(
            random.normal(size=(count, 2)),
            random.uniform(1e-6, 1e-4, count),
            PieceEnd.COVERED,
            PieceEnd.UNKNOWN,
            (0.001, 0.002) if number % 2 else (math.nan, math.nan),
            direction_known=bool(number % 2),
            confidence=0.5,
        )
        for number, count in enumerate(counts)
    )
    return ThreadObservation(pieces, hidden=tuple(random.normal(size=(3 + k, 2)) for k in range(outlines)))


@pytest.mark.parametrize("counts", [(), (2,), (3, 64), (5, 2, 7)])
@pytest.mark.parametrize("outlines", [0, 1, 2])
def test_an_observation_is_packed_as_rclpy_makes_it_and_read_as_it_was(counts: tuple[int, ...], outlines: int):
    given = observation(*counts, outlines=outlines)
    expected, data = MESSAGES.observation_message(STAMP, given), packed_observation(WHEN, given)
    assert len(data) == len(serialize_message(expected))
    read = reading.thread_observation(deserialize_message(data, type(expected)))
    for found in (read, reading.thread_observation(expected)):
        assert len(found.pieces) == len(given.pieces)
        for one, other in zip(found.pieces, given.pieces, strict=True):
            np.testing.assert_array_equal(one.points, other.points)
            np.testing.assert_array_equal(one.deviation, other.deviation)
            np.testing.assert_array_equal(one.arc_length, other.arc_length)
            assert (one.first_end, one.last_end) == (other.first_end, other.last_end)
            assert (one.direction_known, one.confidence) == (other.direction_known, other.confidence)
        for outline, shape in zip(found.hidden, given.hidden, strict=True):
            np.testing.assert_array_equal(outline, shape)


def _broken(message: Any, name: str) -> None:
    """Make a message one that is refused."""
    piece = message.pieces[0]
    if name == "few points":
        piece.points = piece.points[:1]
    elif name == "other deviations":
        piece.deviation = piece.deviation[:-1]
    elif name == "a point that is none":
        piece.points[1].x = math.nan
    elif name == "a negative deviation":
        piece.deviation[0] = -1.0
    elif name == "an end that is none":
        piece.last_end = 9
    elif name == "an interval out of order":
        piece.arc_length_min, piece.arc_length_max = 0.003, 0.002
    elif name == "half an interval":
        piece.arc_length_min, piece.arc_length_max = 0.003, math.nan
    elif name == "no confidence":
        piece.confidence = math.nan
    elif name == "complete in two pieces":
        message.complete = True
    elif name == "too many pieces":
        message.pieces = [piece] * (reading.MAX_PIECES + 1)
    elif name == "an outline that is none":
        message.hidden[0].corners = message.hidden[0].corners[:2]
    else:
        message.header.frame_id = "camera"


@pytest.mark.parametrize(
    "name",
    [
        *("few points", "other deviations", "a point that is none", "a negative deviation", "an end that is none"),
        *("an interval out of order", "half an interval", "no confidence", "complete in two pieces"),
        *("too many pieces", "an outline that is none", "another frame"),
    ],
)
def test_an_observation_that_is_not_valid_is_refused(name: str):
    message = MESSAGES.observation_message(STAMP, observation(4, 5))
    reading.thread_observation(message)
    _broken(message, name)
    with pytest.raises(InvalidInputError, match="thread/observation"):
        reading.thread_observation(message)


def marker(number: int, kind: int, scale: Vector3, friction: Friction, points: np.ndarray) -> Marker:
    """Return what rclpy makes of a marker."""
    made = Marker(header=MESSAGES.header(STAMP), ns="thread", id=number, type=kind, action=Marker.ADD, scale=scale)
    made.pose = MESSAGES.flat_pose(np.zeros(2), 0.0)
    red, green, blue = friction_colour(friction)
    made.color = ColorRGBA(r=red, g=green, b=blue, a=1.0)
    made.points = [Point(x=x, y=y) for x, y in points.tolist()]
    return made


@pytest.mark.parametrize("segments", [3, 4, 25])
@pytest.mark.parametrize(
    "friction", [UNKNOWN, Friction(FrictionState.FREE, (), 1.0), Friction(FrictionState.SLIDING, (1, 3), 0.81)]
)
@pytest.mark.parametrize("diameter", [1e-5, 1e-3])
def test_markers_are_packed_as_rclpy_makes_them(segments: int, friction: Friction, diameter: float):
    vertices = np.random.default_rng(segments).normal(size=(segments + 1, 2))
    none: Any = None
    prediction = Prediction(1.0, "rod", "", vertices, np.zeros(segments), 0.0, 0, "", "", 0.0, True, none)
    width = max(4.0 * diameter, 2e-4)
    balls = Vector3(x=2.0 * width, y=2.0 * width, z=2.0 * width)
    expected = MarkerArray(
        markers=[
            marker(0, Marker.LINE_STRIP, Vector3(x=width), friction, vertices),
            marker(1, Marker.SPHERE_LIST, balls, friction, vertices[list(friction.nodes)]),
        ]
    )
    margins = None if friction is UNKNOWN else Margins((), friction=friction)
    same(packed_markers(WHEN, prediction, margins, diameter), expected)


def an_estimate(disturbances: int = 0) -> ThreadEstimate:
    """Return an estimate of a thread, measured in this frame, with so many forces that the model does not know."""
    way = poses(3)
    truth = true_shapes(thread_of(segments=6), way)
    estimator = estimator_of(thread_of(segments=6), discs=(Disc((-0.005, 0.0015), 1e-3),))
    estimator.start(way[0])
    estimate = estimator.correct(whole(truth[0], 1))
    found = [
        Disturbance(1e-3 * k, 2e-3, np.array([k, -0.5]), np.array([0.6, 0.8]), 2e-4, 5.0, 11.5 + k)
        for k in range(disturbances)
    ]
    return replace(estimate, disturbances=tuple(found), problems=("a", "of two words")[:disturbances])


@pytest.mark.parametrize("disturbances", [0, 1, 2])
def test_an_estimate_is_packed_as_rclpy_makes_it(disturbances: int):
    estimate = an_estimate(disturbances)
    assert estimate.innovations is not None
    squares = estimate.innovations.normalised_squared
    expected = EstimatedThread(
        header=MESSAGES.header(STAMP),
        positions=MESSAGES.points(estimate.positions),
        deviation=estimate.deviation.tolist(),
        covariance=estimate.covariance.ravel().tolist(),
        unmeasured_for=0.0,
        hidden=estimate.hidden,
        points=estimate.points,
        innovation_squared=float(np.nansum(squares)),
        innovation_degrees=int(np.isfinite(squares).sum()),
        problems=list(estimate.problems),
        converged=True,
        residual=estimate.residual,
        disturbances=[
            ThreadDisturbance(
                arc_length=1e-3 * k,
                extent=2e-3,
                position=Point(x=float(k), y=-0.5),
                direction=Vector3(x=0.6, y=0.8),
                force=2e-4,
                significance=5.0,
                since=Time(sec=11 + k, nanosec=500_000_000),
            )
            for k in range(disturbances)
        ],
    )
    same(packed_estimate(WHEN, estimate), expected)


def test_margins_of_an_estimate_have_bounds_and_go_there_and_back():
    margins = an_estimate().margins
    for of_estimate in (True, False):
        message: Any = deserialize_message(packed_margins(WHEN, margins, of_estimate=of_estimate), SafetyMargins)
        assert message.source == (SafetyMargins.OF_ESTIMATE if of_estimate else SafetyMargins.OF_PREDICTION)
        read = reading.margins_of(message)
        for name in margins:
            np.testing.assert_array_equal(read[name].bound, margins[name].bound)
            np.testing.assert_array_equal(read[name].clearance, margins[name].clearance)
        assert (read["obstacle"].bound <= read["obstacle"].clearance).all()
        least = {each.barrier: each.clearance_bound for each in message.minimum}
        assert least["obstacle"] == margins["obstacle"].bound.min()
        assert least["connectivity"] == -math.inf
    none: Any = deserialize_message(packed_margins(WHEN, None, "no pose"), SafetyMargins)
    assert (none.valid, none.source) == (False, SafetyMargins.OF_NOTHING)


def test_markers_show_the_estimate_beside_the_prediction():
    estimate = an_estimate(2)
    prediction = replace(estimate.prediction, positions=estimate.positions + 1e-3)
    data = packed_markers(WHEN, prediction, estimate.margins, 1e-4, estimate)
    shown: Any = deserialize_message(data, MarkerArray)
    assert len(data) == len(serialize_message(shown))
    lines = {each.ns: each for each in shown.markers if each.id == 0}
    for name, nodes in (("thread", estimate.positions), ("predicted", prediction.positions)):
        np.testing.assert_array_equal([[point.x, point.y] for point in lines[name].points], nodes)
    assert lines["thread"].color != lines["predicted"].color
    assert lines["deviation"].type == Marker.TRIANGLE_LIST
    assert len(lines["deviation"].points) == 6 * 6
    forces = [each for each in shown.markers if each.ns == "disturbances"]
    assert [each.type for each in forces] == [Marker.ARROW, Marker.TEXT_VIEW_FACING] * 2
    assert [each.text for each in forces[1::2]] == [
        f"held at {k} mm of the thread: 0.2 mN up and to the right" for k in range(2)
    ]
    assert (forces[0].points[1].x, forces[0].points[1].y) == (0.0, -0.5)
    assert all(each.lifetime.nanosec > 0 for each in forces)
    alone: Any = deserialize_message(packed_markers(WHEN, None, None, 1e-4, estimate), MarkerArray)
    assert {each.ns for each in alone.markers} == {"thread", "deviation", "disturbances"}


def test_the_minimum_of_every_barrier_is_written_beside_its_node():
    """Also of a barrier that a user added; not of those that hold the segments together, nor of one without rows."""

    def rows(barrier: str, *entries: tuple[int, float]) -> BarrierMargins:
        nodes, clearances = np.array([n for n, _ in entries], int), np.array([h for _, h in entries])
        return BarrierMargins(
            barrier, nodes.astype(np.uint32), -np.ones(len(entries), np.int32), clearances, clearances
        )

    barriers = (rows("connectivity", (1, 0.0)), rows("obstacle", (1, 2e-3), (3, -1e-6)), rows("wall"))
    added = rows("moving_disc", (2, 1.234e-3))
    vertices = np.random.default_rng(1).normal(size=(5, 2))
    none: Any = None
    prediction = Prediction(1.0, "rod", "", vertices, np.zeros(4), 0.0, 0, "", "", 0.0, True, none)
    data = packed_markers(WHEN, prediction, Margins((*barriers, added)), 1e-4)
    shown: Any = deserialize_message(data, MarkerArray)
    assert data == serialize_message(shown) or len(data) == len(serialize_message(shown))
    texts = [each for each in shown.markers if each.ns == "margins"]
    assert [(each.text, each.type) for each in texts] == [
        ("obstacle -0.00 mm", Marker.TEXT_VIEW_FACING),
        ("moving_disc 1.23 mm", Marker.TEXT_VIEW_FACING),
    ]
    assert [each.id for each in texts] == [0, 1]
    assert texts[0].color.r > texts[1].color.r  # red where it is touched
    for each, node in zip(texts, (3, 2), strict=True):
        assert each.pose.position.x == vertices[node, 0]
        assert abs(each.pose.position.y - vertices[node, 1]) <= 3e-3
        assert each.header == shown.markers[0].header
        assert each.lifetime.nanosec > 0  # it goes when the barrier has no row any more
        assert each.scale.z > 0.0


def test_a_pose_that_is_handed_over_is_that_of_its_message():
    for angle in np.random.default_rng(1).uniform(-np.pi, np.pi, 1000):
        tail, heading = np.array([angle * 1e-3, -angle]), np.array([np.cos(angle), np.sin(angle)])
        covariance = np.diag([2e-10, 3e-10, 1e-5]) * (1.0 + angle**2)
        message = packed_pose(WHEN, tail, heading, covariance)
        told = reading.needle_pose(deserialize_message(message, PoseWithCovarianceStamped))
        handed = reading.tracked_pose(STAMP, tail, heading, covariance)
        assert told.stamp == handed.stamp
        assert told.tail.tobytes() == handed.tail.tobytes()
        assert told.heading.tobytes() == handed.heading.tobytes()
        assert told.deviation == handed.deviation
        assert min(told.deviation) > 0.0
