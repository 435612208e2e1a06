"""Messages: packed as rclpy and rosbags have them, read back as they were, refused where they are not valid."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion
from hypothesis import given
from hypothesis import strategies as st
from magnetosuture_msgs.msg import BarrierMargin, SafetyMargins
from rclpy.serialization import serialize_message

from magnetosuture_thread.bags import packing, reading
from magnetosuture_thread.bags.message_types import typestore
from magnetosuture_thread.bags.packing import packed_scene
from magnetosuture_thread.estimator.disturbance import Disturbance
from magnetosuture_thread.estimator.estimator import ThreadEstimate
from magnetosuture_thread.geometry.barrier import BUILT_IN
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.topics import topic_of
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.thread.barriers import SelfContact
from magnetosuture_thread.thread.margins import BarrierMargins, Friction, FrictionState, Margins
from magnetosuture_thread.thread.mechanics import ThreadForces
from magnetosuture_thread.thread.prediction import Prediction
from magnetosuture_thread.vision.tracker import State, Track
from test.estimator.threads import estimator_of, poses, thread_of, true_shapes, whole
from test.geometry.scene.scenes import every_shape
from test.nodes import wire
from test.shared import run_python

STAMP = Time(sec=3, nanosec=500_000_000)
TAIL, HEADING = np.array([1e-3, -2e-3]), np.array([-0.6, 0.8])
POINTS = np.random.default_rng(0).normal(size=(5, 2))
VIEW = DishView((320.0, 240.0), 1e-4)


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


def prediction(touching: tuple[int, ...] | None = None, positions: np.ndarray = POINTS) -> Prediction:
    """Return a prediction whose thread is pushed at some nodes; without forces if None."""
    count, forces = len(positions), None
    if touching is not None:
        contact, use = np.zeros((count, 2)), np.linspace(0.0, 1.0, count)
        contact[list(touching)] = 1e-6
        forces = ThreadForces(np.arange(count - 1.0), contact, np.array([1e-6, -2e-6]), 3e-9, 1e-7 * use, use)
    return Prediction(
        0.0,
        formulation="rod",
        scene_version="a1",
        solver="banded",
        status="solved",
        positions=positions,
        strain=np.arange(count - 1.0),
        interval=0.015,
        substeps=2,
        residual=1e-9,
        converged=True,
        compute_margins=lambda: Margins(()),
        compute_forces=lambda: forces,
    )


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


def rows(barrier: str, *entries: tuple[int, float]) -> BarrierMargins:
    """Return margins of a barrier at nodes."""
    nodes, clearances = np.array([n for n, _ in entries], int), np.array([h for _, h in entries])
    return BarrierMargins(barrier, nodes.astype(np.uint32), -np.ones(len(entries), np.int32), clearances, clearances)


MARGINS = Margins(
    (rows("connectivity", (1, 0.0)), rows("obstacle", (1, 2e-3), (3, -1e-6)), rows("wall"), rows("own", (2, 1.2e-3))),
    friction=Friction(FrictionState.SLIDING, (2, 3), 0.729),
)
PACKED = {
    "pose": (interface.NEEDLE_POSE, packing.packed_pose(7, TAIL, HEADING, np.eye(3))),
    "setpoint": (interface.TIP_SETPOINT, packing.packed_pose_stamped(7, TAIL, 0.3)),
    "point": (interface.NEEDLE_TIP, packing.packed_point(7, TAIL)),
    "twist": (interface.NEEDLE_COMMAND, packing.packed_twist(7, TAIL)),
    "twist of the needle": (interface.NEEDLE_COMMAND, packing.packed_twist(7, np.array([1e-3, -2e-3, 0.5]))),
    "wrench": (interface.GROUND_TRUTH_PULL, packing.packed_wrench(7, TAIL, 1e-9)),
    "path": (interface.MEASURED_THREAD, packing.packed_path(7, POINTS)),
    "empty path": (interface.MEASURED_THREAD, packing.packed_path(7, POINTS[:0])),
    "jpeg": (interface.COMPRESSED_IMAGE, packing.packed_compressed_image(7, np.arange(9, dtype=np.uint8))),
    "image": (interface.IMAGE, packing.packed_image(7, np.arange(24, dtype=np.uint8).reshape(2, 4, 3))),
    "camera": (interface.CAMERA_INFO, packing.packed_camera_info(7, (640, 480), VIEW, 0.3)),
    "tracker": (interface.TRACKER_STATE, packing.packed_tracker_state(7, Track(State.LOST, "glare", VIEW))),
    "blind tracker": (interface.TRACKER_STATE, packing.packed_tracker_state(7, Track(State.LOST))),
    "observation": (interface.THREAD_OBSERVATION, packing.packed_observation(7, observation(3, 64))),
    "prediction": (interface.PREDICTED_THREAD, packing.packed_prediction(7, prediction((0, 3)), "silk")),
    "free prediction": (interface.PREDICTED_THREAD, packing.packed_prediction(7, prediction(), "")),
    "disturbed": (interface.ESTIMATED_THREAD, packing.packed_estimate(7, an_estimate(2))),
    "margins": (interface.MARGINS, packing.packed_margins(7, MARGINS)),
    "no margins": (interface.MARGINS, packing.packed_margins(7, None, "for a reason", "0123456789abcdef")),
    "scene": (interface.SCENE, packed_scene(7, every_shape())),
    "scene markers": (interface.SCENE_MARKERS, packing.packed_scene_markers(7, every_shape())),
    "thread markers": (
        interface.THREAD_MARKERS,
        packing.packed_thread_markers(7, prediction(), MARGINS, 1e-4, an_estimate(2)),
    ),
}


@pytest.mark.parametrize("name", PACKED)
def test_what_is_packed_is_what_rosbags_and_rclpy_make_of_the_same_message(name: str):
    channel, data = PACKED[name]
    store = typestore()
    theirs = store.serialize_cdr(store.deserialize_cdr(data, channel.type_name), channel.type_name)
    assert bytes(theirs) == data
    message = topic_of(channel).decode(data)
    assert str(topic_of(channel).decode(serialize_message(message))) == str(message)  # NaN is not equal to itself


def test_a_command_is_of_the_tip_or_in_the_needle_s_own_frame_and_nothing_else():
    for velocity in (np.array([1e-3, -2e-3]), np.array([1e-3, -2e-3, 0.5])):
        message = topics.NEEDLE_COMMAND.decode(packing.packed_twist(7, velocity))
        assert reading.needle_command(message, "c").tolist() == velocity.tolist()
        message.twist.linear.z = 1e-3
        with pytest.raises(InvalidInputError, match="out of the plane"):
            reading.needle_command(message, "c")
    message = topics.NEEDLE_COMMAND.decode(packing.packed_twist(7, np.array([1e-3, 0.0])))
    message.twist.angular.z = 0.5  # beside that which the velocity of the tip amounts to
    with pytest.raises(InvalidInputError, match="apart from x and y"):
        reading.needle_command(message, "c")
    message.header.frame_id = "needle_elsewhere"
    with pytest.raises(InvalidInputError, match="frame_id"):
        reading.needle_command(message, "c")


IN_A_RIG_WITH_A_PREFIX = """
import numpy as np
from magnetosuture_thread.settings import interface
from magnetosuture_thread.bags.message_types import typestore
from magnetosuture_thread.bags import packing, reading
from magnetosuture_thread.nodes import topics

points, store = np.arange(10.0).reshape(5, 2), typestore()
for count in (0, 1, 5):
    data = packing.packed_path(7, points[:count])
    path = topics.MEASURED_THREAD.decode(data)
    assert bytes(store.serialize_cdr(store.deserialize_cdr(data, "nav_msgs/msg/Path"), "nav_msgs/msg/Path")) == data
    assert {each.header.frame_id for each in (path, *path.poses)} == {interface.DISH_FRAME}
    np.testing.assert_array_equal(reading.path_points(path), points[:count])
    found = reading._plain_path(data)
    assert found is None or found.tolist() == points[:count].tolist()
pose = topics.NEEDLE_POSE.decode(packing.packed_pose(7, points[0], np.array([0.6, 0.8])))
assert reading.needle_pose(pose).tail.tolist() == [0.0, 1.0]
image = topics.COMPRESSED_IMAGE.decode(packing.packed_compressed_image(7, np.arange(9, dtype=np.uint8)))
command = topics.NEEDLE_COMMAND.decode(packing.packed_twist(7, np.array([1e-3, 0.0, 0.5])))
assert command.header.frame_id == interface.NEEDLE_FRAME
assert reading.needle_command(command, "").tolist() == [1e-3, 0.0, 0.5]
print(pose.header.frame_id, image.header.frame_id)
"""


@pytest.mark.parametrize("prefix", ["ab/", "abc/", "left_1/", "right_1/"])  # what follows is aligned by their lengths
def test_the_frames_of_a_rig_with_a_prefix_are_its_own(prefix: str):
    shown = run_python("-c", IN_A_RIG_WITH_A_PREFIX, environment={interface.FRAME_PREFIX_VARIABLE: prefix})
    assert shown == f"{prefix}dish {prefix}camera\n"


@given(angle=st.floats(-math.pi, math.pi), x=st.floats(-0.1, 0.1), y=st.floats(-0.1, 0.1))
def test_a_pose_goes_there_and_back_also_without_a_message(angle: float, x: float, y: float):
    tail, heading = np.array([x, y]), np.array([math.cos(angle), math.sin(angle)])
    covariance = np.diag([2e-10, 3e-10, 1e-5])
    found = reading.needle_pose(wire.pose_message(STAMP, tail, heading, covariance))
    assert found.stamp == 3.5
    np.testing.assert_array_equal(found.tail, tail)
    np.testing.assert_allclose(found.heading, heading, atol=1e-12)
    handed = reading.tracked_pose(STAMP, tail, heading, covariance)
    assert (handed.stamp, handed.deviation) == (found.stamp, found.deviation)
    assert handed.heading.tobytes() == found.heading.tobytes()


def _orientation(axis: str, value: float) -> Callable[[Any], None]:
    return lambda message: setattr(message.pose.pose.orientation, axis, value)


@pytest.mark.parametrize(
    ("harm", "problem"),
    [
        (lambda m: m.pose.covariance.__setitem__(-1, math.pi**2), "the heading is unknown"),
        (lambda m: setattr(m.pose.pose, "orientation", Quaternion(y=0.5**0.5, w=0.5**0.5)), "an x axis in the dish"),
        (lambda m: setattr(m.header, "stamp", Time(sec=2**31 - 1, nanosec=2**32 - 1)), r"header\.stamp\.nanosec"),
        *((_orientation("w", value), "a unit quaternion") for value in (0.5, 1e308, math.inf, math.nan)),
    ],
)
def test_a_pose_that_is_none_is_refused(harm: Callable[[Any], None], problem: str):
    message = wire.pose_message(STAMP, np.zeros(2), np.array([0.6, 0.8]))
    harm(message)
    with pytest.raises(InvalidInputError, match=problem):
        reading.needle_pose(message)


def test_an_observation_goes_there_and_back():
    sent = observation(5, 2, 7)
    found = reading.thread_observation(wire.observation_message(STAMP, sent))
    for one, other in zip(found.pieces, sent.pieces, strict=True):
        for name in ("points", "deviation", "arc_length"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        for name in ("first_end", "last_end", "direction_known", "confidence"):
            assert getattr(one, name) == getattr(other, name)
    for outline, shape in zip(found.hidden, sent.hidden, strict=True):
        np.testing.assert_array_equal(outline, shape)


BROKEN: dict[str, Callable[[Any], None]] = {
    "other deviations": lambda m: setattr(m.pieces[0], "deviation", m.pieces[0].deviation[:-1]),
    "a point that is none": lambda m: setattr(m.pieces[0].points[1], "x", math.nan),
    "an end that is none": lambda m: setattr(m.pieces[0], "last_end", 9),
    "complete in two pieces": lambda m: setattr(m, "complete", True),
    "too many pieces": lambda m: setattr(m, "pieces", m.pieces[:1] * (reading.MAX_PIECES + 1)),
    "an outline that is none": lambda m: setattr(m.hidden[0], "corners", m.hidden[0].corners[:2]),
}


@pytest.mark.parametrize("name", BROKEN)
def test_an_observation_that_is_not_valid_is_refused(name: str):
    message = wire.observation_message(STAMP, observation(4, 5))
    message.pieces[0].arc_length_min, message.pieces[0].arc_length_max = 0.003, 0.004
    BROKEN[name](message)
    with pytest.raises(InvalidInputError, match="thread/observation"):
        reading.thread_observation(message)


def test_margins_of_an_estimate_have_bounds_and_go_there_and_back():
    margins = an_estimate().margins
    for of_estimate in (True, False):
        message = topics.MARGINS.decode(packing.packed_margins(7, margins, of_estimate=of_estimate))
        assert message.source == (SafetyMargins.OF_ESTIMATE if of_estimate else SafetyMargins.OF_PREDICTION)
        read = reading.margins_of(message)
        for name in margins:
            np.testing.assert_array_equal(read[name].bound, margins[name].bound)
            np.testing.assert_array_equal(read[name].clearance, margins[name].clearance)
        assert (read["obstacle"].bound <= read["obstacle"].clearance).all()
        least = {each.barrier: each.clearance_bound for each in message.minimum}
        assert least["obstacle"] == margins["obstacle"].bound.min()
        assert least["connectivity"] == -math.inf
    none = topics.MARGINS.decode(packing.packed_margins(7, None, "no pose"))
    assert (none.valid, none.source, none.reason) == (False, SafetyMargins.OF_NOTHING, "no pose")


def test_the_bags_and_the_graph_have_the_same_own_messages():
    """The same bytes mean the same in both: a type that was rebuilt in one place only would differ."""
    for topic in (*topics.INPUTS, *topics.OUTPUTS, *topics.SETTINGS):
        fields = [name for name, _ in typestore().fielddefs[topic.channel.type_name][1]]
        assert fields == list(topic.message().get_fields_and_field_types())


def test_every_barrier_of_this_package_is_a_constant_of_its_message():
    names = (*BUILT_IN, SelfContact.name)
    assert {name: getattr(BarrierMargin, name.upper(), None) for name in names} == {name: name for name in names}
