"""A bag in the words of our graph: remapped topics, other types, other frames."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magnetosuture_thread.bags import parse_remap
from magnetosuture_thread.bags.message_types import typestore
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.bags.storage import MessageDefinition
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.settings.errors import BagError, ConfigurationError
from magnetosuture_thread.settings.interface import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    GROUND_TRUTH_NEEDLE,
    GROUND_TRUTH_THREAD,
    IMAGE,
    MEASURED_THREAD,
    NEEDLE_COMMAND,
    NEEDLE_POSE,
    SCENE,
)
from test.bags.bags import make, stamped

COVARIANT = "geometry_msgs/msg/PoseWithCovariance"
POINT, QUATERNION, POSE = "geometry_msgs/msg/Point", "geometry_msgs/msg/Quaternion", "geometry_msgs/msg/Pose"
TURN = Rotation.from_euler("z", 90, degrees=True)


def pose(x: float = 1.0, y: float = 2.0, z: float = 3.0) -> Any:
    return make(POSE, make(POINT, x, y, z))


def pose_stamped(index: int = 1, frame: str = "dish") -> Any:
    return make("geometry_msgs/msg/PoseStamped", stamped(index, frame), pose())


def filled(kind: str, **fields: Any) -> Any:
    """Return a message of the stamp 1 s in the dish frame."""
    return make(kind, stamped(1), **fields)


def transform(parent: str, child: str, place: tuple[float, ...], turn: Rotation | None = None, index: int = 0) -> Any:
    quaternion = make(QUATERNION, *(turn or Rotation.identity()).as_quat().tolist())
    both = make("geometry_msgs/msg/Transform", make("geometry_msgs/msg/Vector3", *place), quaternion)
    return make("geometry_msgs/msg/TransformStamped", stamped(index, parent), child, both)


def tf(*transforms: Any) -> Any:
    return make("tf2_msgs/msg/TFMessage", list(transforms))


def bag_of(tmp_path: Path, *messages: tuple[str, Any], remap: dict[str, str] | None = None) -> Bag:
    """Return a bag of messages, one a second."""
    with BagWriter(tmp_path / "bag") as writer:
        for topic, name in {topic: message.__msgtype__ for topic, message in messages}.items():
            writer.add_topic(topic, name)
        for index, (topic, message) in enumerate(messages):
            writer.write_message(topic, (1 + index) * 10**9, message)
    return Bag(tmp_path / "bag", remap=remap)


def only(recording: Recording, channel: Any) -> Any:
    """Return the only message of a channel, decoded."""
    (record,) = recording.records([channel])
    assert (record.topic, record.type_name) == (channel.recorded, channel.type_name)
    return typestore().deserialize_cdr(record.data, channel.type_name)


def place(message: Any) -> tuple[float, float, float]:
    return message.position.x, message.position.y, message.position.z


HELD = make(COVARIANT, pose(), np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]).ravel())
KINDS = [
    (pose_stamped(), 0.0),
    (filled("geometry_msgs/msg/PoseWithCovarianceStamped", pose=HELD), 2.0),
    (transform("dish", "needle", (1.0, 2.0, 3.0), index=1), 0.0),
    (filled("nav_msgs/msg/Odometry", pose=HELD), 2.0),
]


@pytest.mark.parametrize(("message", "variance"), KINDS)
def test_every_kind_of_pose(tmp_path: Path, message: Any, variance: float):
    for number, channel in enumerate((NEEDLE_POSE, GROUND_TRUTH_NEEDLE)):
        bag = bag_of(tmp_path / str(number), ("/theirs", message), remap={"/theirs": channel.recorded})
        found = only(Recording(bag), channel)
        assert (found.header.stamp.sec, found.header.frame_id) == (1, "dish")
        held = found.pose if channel is GROUND_TRUTH_NEEDLE else found.pose.pose
        assert place(held) == (1.0, 2.0, 3.0)
        if channel is NEEDLE_POSE:
            assert found.pose.covariance[7] == variance


POINTS = [(0.0, 0.0, 0.0), (1.0, 0.5, 0.0), (2.0, 0.0, 0.25)]


def marker(kind: int = 4, action: int = 0) -> Any:
    points = [make(POINT, *xyz) for xyz in POINTS]
    return filled("visualization_msgs/msg/Marker", type=kind, action=action, pose=make(POSE), points=points)


THREADS = [
    filled("nav_msgs/msg/Path", poses=[make("geometry_msgs/msg/PoseStamped", pose=pose(*p)) for p in POINTS]),
    filled("geometry_msgs/msg/PoseArray", poses=[pose(*p) for p in POINTS]),
    filled(
        "geometry_msgs/msg/PolygonStamped",
        polygon=make("geometry_msgs/msg/Polygon", [make("geometry_msgs/msg/Point32", *p) for p in POINTS]),
    ),
    marker(),
]


@pytest.mark.parametrize("message", THREADS, ids=lambda message: message.__msgtype__.split("/")[-1])
def test_every_kind_of_thread(tmp_path: Path, message: Any):
    bag = bag_of(tmp_path, ("/theirs", message), remap={"/theirs": MEASURED_THREAD.recorded})
    found = only(Recording(bag), MEASURED_THREAD)
    assert [place(each.pose) for each in found.poses] == POINTS
    assert found.header.frame_id == "dish"


def test_a_marker_that_is_no_line_or_nowhere_is_refused_and_counted(tmp_path: Path):
    markers = [marker(), marker(kind=5), marker(action=2), marker(), marker()]
    markers[3].pose.position.y, markers[4].pose.position.y = math.nan, math.inf
    recording = Recording(bag_of(tmp_path, *((MEASURED_THREAD.recorded, message) for message in markers)))
    assert len(list(recording.records([MEASURED_THREAD]))) == 1
    assert recording.refused == {
        "/thread/measured: a marker that is no line strip being added": 2,
        "/thread/measured: a place that is not finite": 2,
    }


def image(channel: Any) -> Any:
    return make(channel.type_name, stamped(1, "camera"), data=np.zeros(3, dtype=np.uint8))


def test_images_are_told_by_their_type(tmp_path: Path):
    recording = Recording(bag_of(tmp_path, ("/cam", image(IMAGE)), remap={"/cam": COMPRESSED_IMAGE.recorded}))
    assert recording.camera is IMAGE
    assert only(recording, IMAGE).header.frame_id == "camera"


@pytest.mark.parametrize("topic", ["/lab/image_rect_color", "/zed/left/rect/image"])
def test_the_lens_of_frames_that_are_rectified_is_left_out(topic: str, tmp_path: Path):
    lens = ("/camera/camera_info", make("sensor_msgs/msg/CameraInfo", stamped(1, "camera")))
    bag = bag_of(tmp_path / "rectified", (topic, image(IMAGE)), lens, remap={topic: IMAGE.recorded})
    recording = Recording(bag)
    assert recording.rectified == topic
    assert list(recording.records([CAMERA_INFO])) == []
    raw = Recording(
        bag_of(tmp_path / "raw", ("/correct/image", image(IMAGE)), lens, remap={"/correct/image": "/camera/image_raw"})
    )
    assert raw.rectified == ""
    assert len(list(raw.records([CAMERA_INFO]))) == 1


def test_a_scene_of_a_rig_with_a_prefix_is_read_in_our_frame(tmp_path: Path):
    scene = make("magnetosuture_msgs/msg/Scene", stamped(1, "left/dish"))
    recording = Recording(bag_of(tmp_path, (SCENE.recorded, scene)), dish_frame="left/dish")
    assert only(recording, SCENE).header.frame_id == "dish"
    assert only(Recording(Bag(tmp_path / "bag")), SCENE).header.frame_id == "left/dish"


@pytest.mark.parametrize("prefix", ["", "left/"])
def test_a_motion_in_the_needle_s_own_frame_is_not_transformed(tmp_path: Path, prefix: str):
    """The needle's frame is not in tf: a command is of wherever the needle is."""
    along, turn = (make("geometry_msgs/msg/Vector3", *at) for at in ((1e-3, 2e-3, 0.0), (0.0, 0.0, 0.5)))
    twist = make(
        "geometry_msgs/msg/TwistStamped", stamped(1, f"{prefix}needle"), make("geometry_msgs/msg/Twist", along, turn)
    )
    recording = Recording(bag_of(tmp_path, (NEEDLE_COMMAND.recorded, twist)), dish_frame=f"{prefix}dish")
    command = only(recording, NEEDLE_COMMAND)
    assert command.header.frame_id == "needle"
    assert (command.twist.linear.y, command.twist.angular.z) == (2e-3, 0.5)


def test_poses_of_another_frame_are_transformed(tmp_path: Path):
    """Frames: world <- dish turned by 90 degrees at x = 10; world <- arm moves; arm <- tool is fixed."""
    bag = bag_of(
        tmp_path,
        (
            "/tf_static",
            tf(transform("world", "dish", (10.0, 0.0, 0.0), TURN), transform("arm", "tool", (0.5, 0.0, 0.0))),
        ),
        ("/tf", tf(transform("world", "arm", (10.0, 0.0, 0.0), index=2))),
        ("/tf", tf(transform("world", "arm", (20.0, 0.0, 0.0), index=4))),
        (GROUND_TRUTH_NEEDLE.recorded, pose_stamped(1, "tool")),
        (GROUND_TRUTH_NEEDLE.recorded, pose_stamped(3, "/tool")),
        (GROUND_TRUTH_NEEDLE.recorded, pose_stamped(4, "tool")),
        (GROUND_TRUTH_NEEDLE.recorded, pose_stamped(9, "dish")),
    )
    recording = Recording(bag)
    found: list[Any] = [
        typestore().deserialize_cdr(r.data, r.type_name) for r in recording.records([GROUND_TRUTH_NEEDLE])
    ]
    # At 3 s the tool is at x = 10.5 in the world: a point at x = 1 of it is at 1.5 ahead of the dish's origin.
    assert np.allclose([place(m.pose) for m in found], [[2.0, -1.5, 3.0], [2.0, -11.5, 3.0], [1.0, 2.0, 3.0]])
    assert {m.header.frame_id for m in found} == {"dish"}
    turned = found[0].pose.orientation
    assert np.allclose([turned.x, turned.y, turned.z, turned.w], TURN.inv().as_quat())
    assert recording.refused == {"/ground_truth/needle: no transform from its frame tool at its time": 1}


def test_covariances_and_velocities_turn_too(tmp_path: Path):
    vector = make("geometry_msgs/msg/Vector3", 1.0, 0.0, 0.0)
    twist = make("geometry_msgs/msg/Twist", vector, vector)
    bag = bag_of(
        tmp_path,
        ("/tf_static", tf(transform("world", "dish", (10.0, 0.0, 0.0), TURN))),
        (NEEDLE_POSE.recorded, make(NEEDLE_POSE.type_name, stamped(1, "world"), HELD)),
        (NEEDLE_COMMAND.recorded, make(NEEDLE_COMMAND.type_name, stamped(1, "world"), twist)),
    )
    found = only(Recording(bag), NEEDLE_POSE)
    assert np.allclose(np.diag(found.pose.covariance.reshape(6, 6)), [2, 1, 3, 5, 4, 6])
    turned = only(Recording(bag), NEEDLE_COMMAND).twist
    assert np.allclose([turned.linear.x, turned.linear.y, turned.angular.y], [0, -1, -1])


@pytest.mark.parametrize("frame", ["camera_link", ""])
def test_a_frame_that_leads_nowhere_is_refused_unless_it_is_named(tmp_path: Path, frame: str):
    bag = bag_of(
        tmp_path,
        ("/tf_static", tf(transform("world", "dish", (10.0, 0.0, 0.0)))),
        (GROUND_TRUTH_NEEDLE.recorded, pose_stamped(1, frame)),
        (GROUND_TRUTH_THREAD.recorded, make("nav_msgs/msg/Path", stamped(1), [])),
    )
    with pytest.raises(BagError, match="/ground_truth/needle") as caught:
        Recording(bag).records([GROUND_TRUTH_NEEDLE, GROUND_TRUTH_THREAD])
    assert f"--frame {frame or repr('')}" in str(caught.value)
    assert len(list(Recording(bag).records([GROUND_TRUTH_THREAD]))) == 1
    found = only(Recording(bag, dish_frame=frame), GROUND_TRUTH_NEEDLE)
    assert (place(found.pose), found.header.frame_id) == ((1.0, 2.0, 3.0), "dish")


def test_a_broken_transform_and_a_far_future_are_refused_and_counted(tmp_path: Path):
    vector = make("geometry_msgs/msg/Vector3", 1.0, 0.0, 0.0)
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/tf_static", "tf2_msgs/msg/TFMessage")
        bag.add_topic(GROUND_TRUTH_NEEDLE.recorded, GROUND_TRUTH_NEEDLE.type_name)
        bag.add_topic(NEEDLE_COMMAND.recorded, "geometry_msgs/msg/Twist")
        bag.write("/tf_static", 1, b"\0\1\0\0\xff\xff\xff\x7f")
        bag.write_message("/tf_static", 2, tf(transform("dish", "world", (1.0, 0.0, 0.0))))
        bag.write_message(GROUND_TRUTH_NEEDLE.recorded, 3, pose_stamped(1, "world"))
        bag.write_message(NEEDLE_COMMAND.recorded, 2**63, make("geometry_msgs/msg/Twist", vector, vector))
    recording = Recording(Bag(tmp_path / "bag"))
    assert only(recording, GROUND_TRUTH_NEEDLE).pose.position.x == 2.0
    assert any("/tf_static: a message cannot be decoded" in reason for reason in recording.refused)
    assert list(recording.records([NEEDLE_COMMAND])) == []
    assert any("out of range" in reason for reason in recording.refused)


def test_a_type_that_is_defined_in_another_way_is_converted_or_refused(tmp_path: Path):
    """Fields in another order: the bytes must not be passed on as ours."""
    parts = "================\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
    own = "geometry_msgs/Vector3 angular\ngeometry_msgs/Vector3 linear\n" + "=" * 64 + parts
    with BagWriter(tmp_path / "bag") as bag:
        definition = MessageDefinition("geometry_msgs/msg/Twist", "ros2msg", own)
        bag.add_topic(NEEDLE_COMMAND.recorded, definition.type_name, definition)
        bag.write(NEEDLE_COMMAND.recorded, 1, b"\0\1\0\0" + np.arange(6.0).tobytes())
        bag.add_topic(IMAGE.recorded, IMAGE.type_name, MessageDefinition(IMAGE.type_name, "ros2msg", "int32 number\n"))
        bag.write(IMAGE.recorded, 2, b"\0\1\0\0\1\0\0\0")
    recording = Recording(Bag(tmp_path / "bag"))
    found = only(recording, NEEDLE_COMMAND)
    assert (found.twist.angular.x, found.twist.linear.x) == (0.0, 3.0)
    assert list(recording.records([IMAGE])) == []
    assert sum(recording.refused.values()) == 1


def test_remapping_is_written_as_in_ros():
    assert parse_remap("cam/image:=/camera/image_raw") == ("/cam/image", "/camera/image_raw")
    for text in ("", "/a:=", ":=/b", "/a:=/b:=/c", "/a b:=/c"):
        with pytest.raises(ConfigurationError, match="FROM:=TO"):
            parse_remap(text)


def test_a_remap_that_cannot_be_is_refused(tmp_path: Path):
    messages = [("/camera/rgb", pose_stamped()), ("/other", pose_stamped()), ("/needle", pose_stamped())]
    bag_of(tmp_path, *messages)
    for remap, words in (
        (
            {"/camera/rbg": "/x"},
            r"has no topic /camera/rbg to remap; did you mean /camera/rgb\?; its topics: /camera/rgb",
        ),
        ({"/other": "/needle"}, "/needle and /other cannot both be /needle"),
    ):
        with pytest.raises(BagError, match=words):
            Bag(tmp_path / "bag", remap=remap)
    swapped = Bag(tmp_path / "bag", remap={"/other": "/needle", "/needle": "/other"})
    assert [record.topic for record in swapped.records()] == ["/camera/rgb", "/needle", "/other"]
