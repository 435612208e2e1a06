"""The vision tracker in a graph."""

from __future__ import annotations

import numpy as np
from sensor_msgs.msg import CompressedImage, Image

from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.vision_tracker import VisionTrackerNode
from magnetosuture_thread.rig.camera import encode_jpeg

TAIL = np.array([0.002, 0.001])


def frame(camera, thread_arc) -> np.ndarray:
    """Return a frame with a needle and a thread."""
    return camera.render(TAIL, 0.4, thread_arc(TAIL, 0.4 + np.pi, 40.0))


def compressed(image: np.ndarray, stamp) -> CompressedImage:
    """Return an image as a JPEG message."""
    message = CompressedImage(format="jpeg", data=encode_jpeg(image, 90).tobytes())
    message.header.stamp = stamp
    return message


def states(diagnostics) -> list[str]:
    """Return what the node said of itself, in order."""
    return [array.status[0].message for array in diagnostics]


def test_a_frame_becomes_a_pose_and_a_centreline_with_its_stamp(graph, camera, thread_arc):
    graph.add(VisionTrackerNode)
    poses, threads = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.SEEN_THREAD)
    stamp = graph.now()
    graph.publish(topics.COMPRESSED_IMAGE, compressed(frame(camera, thread_arc), stamp))
    graph.wait(lambda: bool(poses and threads), "pose and centreline")
    assert poses[0].header.frame_id == threads[0].header.frame_id == "dish"
    assert poses[0].header.stamp == threads[0].header.stamp == stamp
    position, turned = poses[0].pose.position, poses[0].pose.orientation
    assert np.hypot(position.x - TAIL[0], position.y - TAIL[1]) < 1e-4
    assert abs(2.0 * np.arctan2(turned.z, turned.w) - 0.4) < 0.01
    assert len(threads[0].poses) > 50


def test_a_raw_image_is_taken_too(graph, camera, thread_arc):
    graph.add(VisionTrackerNode, image_transport="raw")
    poses = graph.listen(topics.NEEDLE_POSE)
    image = frame(camera, thread_arc)
    message = Image(height=480, width=640, step=1920, encoding="bgr8", data=image.tobytes())
    message.header.stamp = graph.now()
    graph.publish(topics.IMAGE, message)
    graph.wait(lambda: bool(poses), "a pose")


def test_lost_is_said_and_no_pose_is_guessed(graph, camera, thread_arc):
    graph.add(VisionTrackerNode)
    poses, diagnostics = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.DIAGNOSTICS)
    far = np.array([0.5, 0.5])
    empty = camera.render(far, 0.0, np.array([far, far + 0.01]))
    graph.publish(topics.COMPRESSED_IMAGE, compressed(empty, graph.now()))
    graph.wait(lambda: "lost: no single needle in the dish" in states(diagnostics), "lost")
    assert not poses
    graph.publish(topics.COMPRESSED_IMAGE, compressed(frame(camera, thread_arc), graph.now()))
    graph.wait(lambda: bool(poses), "a pose")
    graph.wait(lambda: states(diagnostics)[-1] == "tracking", "tracking")


def test_hostile_images_are_refused_and_the_node_goes_on(graph, camera, thread_arc):
    graph.add(VisionTrackerNode)
    poses, diagnostics = graph.listen(topics.NEEDLE_POSE), graph.listen(topics.DIAGNOSTICS)
    for data in (b"", b"no image", b"\xff\xd8\xff\xe0" + bytes(40)):
        message = CompressedImage(format="jpeg", data=data)
        message.header.stamp = graph.now()
        graph.publish(topics.COMPRESSED_IMAGE, message)
    graph.wait(lambda: any("expected a JPEG or PNG image" in text for text in states(diagnostics)), "a refusal")
    graph.publish(topics.COMPRESSED_IMAGE, compressed(frame(camera, thread_arc), graph.now()))
    graph.wait(lambda: bool(poses), "a pose")
    graph.wait(lambda: diagnostics[-1].status[0].message == "tracking", "tracking")
    assert {value.key: value.value for value in diagnostics[-1].status[0].values}["refused"] == "3"
