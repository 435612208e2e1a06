"""The vision tracker in a graph."""

from __future__ import annotations

import threading
from typing import Any

import cv2
import numba
import numpy as np
import pytest
from builtin_interfaces.msg import Time
from magnetosuture_msgs.msg import TrackerState
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from benchmarks.vision.measurements import frame_of
from magnetosuture_thread.messages import reading
from magnetosuture_thread.nodes import topics, vision_tracker
from magnetosuture_thread.nodes.vision_tracker import VisionTrackerNode
from magnetosuture_thread.rig.camera import encode_jpeg
from magnetosuture_thread.scene import Dish, Scene
from magnetosuture_thread.thread_observation import PieceEnd
from magnetosuture_thread.vision.lens import Lens
from magnetosuture_thread.vision.look import UNKNOWN_HEADING
from test.nodes.scenes import scene_told
from test.vision.scenes import Pose, render

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
    message.k, message.d = lens.matrix.ravel().tolist(), lens.coefficients.tolist()
    return message


def states(diagnostics) -> list[str]:
    """Return what the node said of itself, in order."""
    return [array.status[0].message for array in diagnostics]


@pytest.mark.parametrize(("compiles", "word"), [(False, "loading"), (True, "compiling")])
def test_that_kernels_are_loaded_or_compiled_is_reported_meanwhile(graph, monkeypatch, compiles: bool, word: str):
    reports = graph.listen_later(topics.DIAGNOSTICS)

    def warm_up() -> None:
        if compiles:
            numba.njit(lambda x: x)(1)
        reported = [f"{word} the tracker's kernels" + ", once on this machine" * compiles] * 2
        graph.wait(lambda: states(reports)[-2:] == reported, "the report, and once more")

    monkeypatch.setattr(vision_tracker, "warm_up", warm_up)
    graph.add(VisionTrackerNode, scene="dish_35mm")
    graph.wait(lambda: states(reports)[-1] == "no camera frame yet", "the end of it")


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
    covariance = np.reshape(poses[0].pose.covariance, (6, 6))
    assert 1e-12 < covariance[0, 0] < 1e-8
    assert 1e-8 < covariance[5, 5] < 1e-3
    assert covariance[2, 2] == 0.0


def test_a_tracked_frame_becomes_an_observation_of_all_of_the_thread(graph, camera, thread_arc):
    graph.add(VisionTrackerNode, scene="dish_35mm", confirm_frames=1)
    observations, threads = graph.listen(topics.THREAD_OBSERVATION), graph.listen(topics.MEASURED_THREAD)
    stamp = graph.now()
    graph.publish(topics.COMPRESSED_IMAGE, compressed(frame(camera, thread_arc), stamp))
    graph.wait(lambda: bool(observations and threads), "observation and centreline")
    assert observations[0].header.stamp == stamp
    assert observations[0].header.frame_id == "dish"
    read = reading.thread_observation(observations[0])
    assert read.complete
    (piece,) = read.pieces
    assert (piece.first_end, piece.last_end) == (PieceEnd.TAIL, PieceEnd.FREE)
    first = threads[0].poses[0].pose.position
    np.testing.assert_allclose(piece.points[0], (first.x, first.y), atol=1e-9)
    assert piece.length == pytest.approx(0.019, rel=0.03)


def test_a_tracked_frame_without_a_thread_becomes_an_empty_observation(graph, camera):
    graph.add(VisionTrackerNode, scene="dish_35mm", confirm_frames=1)
    observations, threads = graph.listen(topics.THREAD_OBSERVATION), graph.listen(topics.MEASURED_THREAD)
    nowhere = np.array([[0.5, 0.5], [0.51, 0.5]])
    graph.publish(topics.COMPRESSED_IMAGE, compressed(camera.render(TAIL, 0.4, nowhere), graph.now()))
    graph.wait(lambda: bool(observations), "an observation")
    assert not observations[0].pieces
    assert not observations[0].complete
    assert not threads


def test_every_frame_gets_a_state_and_a_pose_comes_once_three_agree(graph, camera, thread_arc):
    graph.add(VisionTrackerNode, scene="dish_35mm")
    poses, tracking = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.TRACKER_STATE)
    image = frame(camera, thread_arc)
    for index in range(4):
        graph.publish(topics.COMPRESSED_IMAGE, compressed(image, Time(sec=5, nanosec=index * 16_000_000)))
        graph.wait(lambda n=index: len(tracking) > n, "a state")
    searching, tracked = TrackerState.STATE_SEARCHING, TrackerState.STATE_TRACKED
    assert [state.state for state in tracking] == [searching, searching, tracked, tracked]
    assert "1 of 3 frames" in tracking[0].reason
    assert tracking[0].confidence == 0.0
    assert tracking[3].reason == ""
    assert 0.3 < tracking[3].confidence <= 1.0
    assert abs(tracking[3].curvature) < 5.0
    assert 0.0 < tracking[3].processing_time < 10.0
    graph.wait(lambda: len(poses) == 2, "poses of the frames that were tracked")
    assert poses[0].header.stamp == tracking[2].header.stamp
    graph.publish(topics.COMPRESSED_IMAGE, compressed(0 * image, Time(sec=5, nanosec=64_000_000)))
    graph.wait(lambda: len(tracking) > 4, "a state")
    assert tracking[4].state == TrackerState.STATE_LOST
    assert len(poses) == 2


def test_a_camera_that_repeats_frames_gives_no_pose_until_a_new_one_comes(graph, camera, thread_arc):
    graph.add(VisionTrackerNode, scene="dish_35mm", confirm_frames=1)
    poses, tracking = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.TRACKER_STATE)
    reports = graph.listen(topics.DIAGNOSTICS)
    shown = [compressed(frame(camera, thread_arc), Time()) for _ in range(3)]
    for index, message in enumerate((shown[0], shown[1], shown[0], shown[1], shown[2])):
        message.header.stamp = Time(sec=5 + index)
        graph.publish(topics.COMPRESSED_IMAGE, message)
        graph.wait(lambda n=index: len(tracking) > n, "a state")
        if index == 3:
            graph.wait(lambda: states(reports)[-1] == "lost: camera repeats frames", "the reason on /diagnostics")
    tracked, repeated = (TrackerState.STATE_TRACKED, ""), (TrackerState.STATE_LOST, "camera repeats frames")
    assert [(each.state, each.reason) for each in tracking] == [tracked] * 2 + [repeated] * 2 + [tracked]
    graph.wait(lambda: [each.header.stamp.sec for each in poses] == [5, 6, 9], "poses of new frames alone")


def test_of_frames_that_wait_only_the_newest_two_are_tracked(graph, camera, thread_arc, monkeypatch):
    node = graph.add(VisionTrackerNode, scene="dish_35mm", confirm_frames=1)
    tracking = graph.listen(topics.TRACKER_STATE)
    begun, go = threading.Event(), threading.Event()
    look = node._session.on_image

    def held_up(*frame: Any) -> Any:
        begun.set()
        assert go.wait(10.0)
        return look(*frame)

    monkeypatch.setattr(node._session, "on_image", held_up)
    image = frame(camera, thread_arc)
    for index in range(8):
        graph.publish(topics.COMPRESSED_IMAGE, compressed(image, Time(sec=5 + index)))
        assert begun.wait(10.0)
    go.set()
    graph.wait(lambda: tracking and tracking[-1].header.stamp.sec == 12, "the newest")
    assert [state.header.stamp.sec for state in tracking] == [5, 11, 12]


def test_a_raw_image_is_taken_too(graph, camera, thread_arc):
    graph.add(VisionTrackerNode, scene="dish_35mm", image_transport="raw", confirm_frames=1)
    poses = graph.listen(topics.NEEDLE_POSE)
    image = frame(camera, thread_arc)
    message = Image(height=480, width=640, step=1920, encoding="bgr8", data=image.tobytes())
    message.header.stamp = graph.now()
    graph.publish(topics.IMAGE, message)
    graph.wait(lambda: bool(poses), "a pose")


def test_lost_is_said_and_no_pose_is_guessed(graph, camera, thread_arc):
    graph.add(VisionTrackerNode, scene="dish_35mm", confirm_frames=1)
    poses, diagnostics = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.DIAGNOSTICS)
    tracking = graph.listen(topics.TRACKER_STATE)
    far = np.array([0.5, 0.5])
    empty = camera.render(far, 0.0, np.array([far, far + 0.01]))
    graph.publish(topics.COMPRESSED_IMAGE, compressed(empty, graph.now()))
    graph.wait(lambda: bool(tracking), "a state")
    assert tracking[0].state == TrackerState.STATE_SEARCHING
    assert tracking[0].reason.startswith("no needle in the dish")
    assert not poses
    graph.publish(topics.COMPRESSED_IMAGE, compressed(frame(camera, thread_arc), graph.now()))
    graph.wait(lambda: bool(poses), "a pose")
    graph.wait(lambda: "tracking" in states(diagnostics), "tracking")


def test_a_rod_without_a_thread_is_published_with_an_unknown_heading(graph):
    graph.add(VisionTrackerNode, scene="dish_35mm", confirm_frames=1)
    poses, tracking = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.TRACKER_STATE)
    threads = graph.listen(topics.MEASURED_THREAD)
    image = render(Pose(np.array([0.5, 0.5]), 0.0))  # a dish without a needle
    outline = np.array([(300.0, 237.5), (385.0, 237.5), (387.5, 240.0), (385.0, 242.5), (300.0, 242.5)])
    cv2.fillPoly(image, [np.round(outline * 16).astype(np.int32)], (50, 50, 50), cv2.LINE_AA, 4)
    graph.publish(topics.COMPRESSED_IMAGE, compressed(cv2.GaussianBlur(image, (0, 0), 0.8), graph.now()))
    graph.wait(lambda: bool(poses and tracking), "a pose and a state")
    assert poses[0].pose.covariance[-1] > np.pi**2
    assert tracking[0].state == TrackerState.STATE_SEARCHING
    assert tracking[0].reason == UNKNOWN_HEADING
    assert not threads


def test_hostile_images_are_refused_and_the_node_goes_on(graph, camera, thread_arc):
    graph.add(VisionTrackerNode, scene="dish_35mm", confirm_frames=1)
    poses, diagnostics = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.DIAGNOSTICS)
    tracking = graph.listen(topics.TRACKER_STATE)
    for count, data in enumerate((b"", b"no image", b"\xff\xd8\xff\xe0" + bytes(40)), 1):
        message = CompressedImage(format="jpeg", data=data)
        message.header.stamp = graph.now()
        graph.publish(topics.COMPRESSED_IMAGE, message)
        graph.wait(lambda n=count: len(tracking) == n, "a state for each")
    assert all("expected a JPEG or PNG image" in state.reason for state in tracking)
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


def test_without_a_scene_it_waits_for_the_topic(graph, camera, thread_arc):
    node = graph.add(VisionTrackerNode, confirm_frames=1)
    diagnostics, poses = graph.listen(topics.DIAGNOSTICS), graph.listen(topics.NEEDLE_POSE)
    graph.wait(lambda: any("no scene yet" in d.status[0].message for d in diagnostics), "the reason")
    graph.publish(topics.SCENE, scene_told(Scene(Dish(0.035))))
    graph.wait(lambda: node._session is not None, "the scene")
    image = frame(camera, thread_arc)
    for index in range(3):
        graph.publish(topics.COMPRESSED_IMAGE, compressed(image, Time(sec=5 + index)))
        graph.wait(lambda n=index: len(poses) > n, "a pose")


def test_a_frame_with_an_impossible_stamp_is_refused(graph, camera, thread_arc):
    """Nothing that is published could be stamped by it."""
    graph.add(VisionTrackerNode, scene="dish_35mm", confirm_frames=1)
    poses, tracking = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.TRACKER_STATE)
    diagnostics = graph.listen(topics.DIAGNOSTICS)
    image = frame(camera, thread_arc)
    graph.publish(topics.COMPRESSED_IMAGE, compressed(image, Time(sec=5, nanosec=1_000_000_000)))
    graph.publish(topics.COMPRESSED_IMAGE, compressed(image, Time(sec=6, nanosec=0)))
    graph.wait(lambda: bool(poses and tracking), "the second frame")
    assert [pose.header.stamp for pose in poses] == [state.header.stamp for state in tracking] == [Time(sec=6)]

    def is_reported() -> bool:
        values = [value for array in diagnostics for value in array.status[0].values]
        return any(value.key == "last refusal" and "nanosec" in value.value for value in values)

    graph.wait(is_reported, "the refusal")


def test_a_lens_from_camera_info_is_undone_and_an_invalid_one_is_reported_and_not_used(graph):
    case, image = frame_of("distortion", 2, 31)
    lens = case.lens
    assert lens is not None
    node = graph.add(VisionTrackerNode, scene="dish_35mm", confirm_frames=1)
    poses, diagnostics = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.DIAGNOSTICS)
    message = camera_info(lens)
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
