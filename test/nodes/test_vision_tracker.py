"""The vision tracker in a graph."""

from __future__ import annotations

import cv2
import numpy as np
from geometry_msgs.msg import PointStamped
from magnetosuture_msgs.msg import TrackerState
from sensor_msgs.msg import CameraInfo, CompressedImage

from benchmarks.vision.measurements import frame_of
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.vision_tracker import VisionTrackerNode
from magnetosuture_thread.rig.camera import encode_jpeg
from magnetosuture_thread.vision.lens import Lens
from test.shared import known
from test.vision.scenes import rod

TAIL = np.array([0.002, 0.001])


def frame(camera, thread_arc) -> np.ndarray:
    """Return a frame with a needle and a thread."""
    return camera.render(TAIL, 0.4, thread_arc(TAIL, 0.4 + np.pi, 40.0))


def compressed(image: np.ndarray, stamp) -> CompressedImage:
    """Return an image as a JPEG message, with a sensor's noise of that moment."""
    random = np.random.default_rng(stamp.sec * 10**9 + stamp.nanosec)
    noisy = cv2.add(image, random.integers(0, 3, image.shape, dtype=np.uint8))
    message = CompressedImage(format="jpeg", data=encode_jpeg(noisy, 90).tobytes())
    message.header.stamp = stamp
    return message


def camera_info(lens: Lens) -> CameraInfo:
    """Return a lens as a message."""
    message = CameraInfo(width=lens.size[0], height=lens.size[1], distortion_model=lens.model)
    message.k, message.d = list(lens.matrix), list(lens.coefficients)
    return message


def states(diagnostics) -> list[str]:
    """Return what the node said of itself, in order."""
    return [array.status[0].message for array in diagnostics]


def test_a_frame_becomes_a_pose_and_a_centreline_with_its_stamp(graph, camera, thread_arc):
    graph.add(VisionTrackerNode, scene="dish_35mm", confirm_frames=1)
    poses, threads = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.MEASURED_THREAD)
    stamp = graph.now()
    graph.publish(topics.COMPRESSED_IMAGE, compressed(frame(camera, thread_arc), stamp))
    graph.wait(lambda: bool(poses and threads), "pose and centreline")
    assert poses[0].header.frame_id == threads[0].header.frame_id == "dish"
    assert poses[0].header.stamp == threads[0].header.stamp == stamp
    position, turned = poses[0].pose.pose.position, poses[0].pose.pose.orientation
    assert np.hypot(position.x - TAIL[0], position.y - TAIL[1]) < 1e-4
    assert abs(2.0 * np.arctan2(turned.z, turned.w) - 0.4) < 0.01
    assert len(threads[0].poses) > 50


def test_the_axis_of_a_needle_without_a_thread_is_published_and_its_pose_once_a_person_points_at_the_tip(graph):
    node = graph.add(VisionTrackerNode, scene="dish_35mm", confirm_frames=1)
    poses, diagnostics = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.DIAGNOSTICS)
    tracking = graph.listen(topics.TRACKER_STATE)
    ends = np.array([[-0.004, 0.002], [0.003, 0.002]])
    graph.publish(topics.COMPRESSED_IMAGE, compressed(rod(ends), graph.now()))
    # On a busy machine the camera seems to be silent right after the only frame: look at every state.
    graph.wait(lambda: bool(poses and tracking), "an axis")
    graph.wait(lambda: any("not which end is the tip" in state.reason for state in tracking), "the reason")
    assert all(state.state != TrackerState.STATE_TRACKED for state in tracking)
    assert np.reshape(poses[-1].pose.covariance, (6, 6))[5, 5] > 1.0
    graph.wait(lambda: any(value.key == "axis_mm" for value in diagnostics[-1].status[0].values), "the axis")
    tip = PointStamped()
    tip.header.frame_id, (tip.point.x, tip.point.y) = "camera", ends[0].tolist()
    graph.publish(topics.NEEDLE_TIP, tip)
    graph.wait(lambda: any("needle/tip" in text for text in states(diagnostics)), "a refusal")
    tip.header.frame_id = "dish"
    graph.publish(topics.NEEDLE_TIP, tip)
    graph.wait(lambda: node._session is not None and node._session._tracker._tip is not None, "the point")
    graph.publish(topics.COMPRESSED_IMAGE, compressed(rod(ends), graph.now()))
    tracked = TrackerState.STATE_TRACKED
    graph.wait(lambda: any(state.state == tracked for state in tracking) and len(poses) > 1, "a pose")
    position = poses[-1].pose.pose.position
    assert np.hypot(position.x - ends[1, 0], position.y - ends[1, 1]) < 2e-4


def test_hostile_images_are_refused_and_the_node_goes_on(graph, camera, thread_arc):
    graph.add(VisionTrackerNode, scene="dish_35mm", confirm_frames=1)
    poses, diagnostics = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.DIAGNOSTICS)
    tracking = graph.listen(topics.TRACKER_STATE)
    for count, data in enumerate((b"", b"no image", b"\xff\xd8\xff\xe0" + bytes(40)), 1):
        message = CompressedImage(format="jpeg", data=data)
        message.header.stamp = graph.now()
        graph.publish(topics.COMPRESSED_IMAGE, message)
        # On a busy machine the camera seems to be silent in between.
        graph.wait(
            lambda n=count: sum("expected a JPEG or PNG image" in state.reason for state in tracking) == n,
            "a refusal of each",
        )
    graph.publish(topics.COMPRESSED_IMAGE, compressed(frame(camera, thread_arc), graph.now()))
    graph.wait(lambda: bool(poses), "a pose")
    graph.wait(lambda: "tracking" in states(diagnostics), "tracking")
    assert {value.key: value.value for value in diagnostics[-1].status[0].values}["refused"] == "3"


def test_a_camera_that_falls_silent_is_noticed(graph, camera, thread_arc):
    graph.add(VisionTrackerNode, scene="dish_35mm", confirm_frames=1)
    poses, tracking = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.TRACKER_STATE)
    diagnostics = graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.COMPRESSED_IMAGE, compressed(frame(camera, thread_arc), graph.now()))
    graph.wait(lambda: bool(poses), "a pose")
    graph.wait(lambda: bool(tracking) and tracking[-1].reason.startswith("no camera frame for"), "the silence")
    assert tracking[-1].state == TrackerState.STATE_LOST
    graph.wait(lambda: any(text.startswith("no camera frame for") for text in states(diagnostics)), "a warning")
    assert len(poses) == 1


def test_a_lens_from_camera_info_is_undone_and_an_invalid_one_is_reported_and_not_used(graph):
    case, image = frame_of("distortion", 2, 31)
    node = graph.add(VisionTrackerNode, scene="dish_35mm", confirm_frames=1)
    poses, diagnostics = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.DIAGNOSTICS)
    message = camera_info(known(case.lens))
    graph.publish(topics.CAMERA_INFO, message)
    graph.wait(lambda: node._lens is not None, "the lens")  # messages of two topics come in either order
    graph.publish(topics.COMPRESSED_IMAGE, compressed(image, graph.now()))
    graph.wait(lambda: bool(poses), "a pose")
    position = poses[-1].pose.pose.position
    assert np.hypot(*(np.array([position.x, position.y]) - case.needle.tail)) < 0.6 * 8e-5
    message.d = [float("nan")] * 5
    graph.publish(topics.CAMERA_INFO, message)
    graph.wait(lambda: any("camera_info.d" in state for state in states(diagnostics)), "a refusal")
    graph.publish(topics.COMPRESSED_IMAGE, compressed(image, graph.now()))
    graph.wait(lambda: any("tracking; camera_info.d" in state for state in states(diagnostics)), "the reason to stay")


def test_frames_of_a_topic_that_is_rectified_are_not_undistorted_again(graph):
    class Remapped(VisionTrackerNode):
        def __init__(self, **options):
            rule = "camera/image_raw/compressed:=camera/image_rect/compressed"
            super().__init__(cli_args=["--ros-args", "--remap", rule], **options)

    case, _ = frame_of("distortion", 2, 31)
    node = graph.add(Remapped, scene="dish_35mm", confirm_frames=1)
    graph.publish(topics.CAMERA_INFO, camera_info(known(case.lens)))
    graph.wait(lambda: node._lens is not None, "the lens")
    assert node._session._tracker._lens is None
