"""The node `vision_tracker`: camera frames in, needle pose and what is seen of the thread out."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PointStamped
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from magnetosuture_thread import InvalidInputError, Scene
from magnetosuture_thread.bags import reading
from magnetosuture_thread.bags.packing import packed_tracker_state, pose_outputs, thread_outputs
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.node import ManagedNode, SceneFollower
from magnetosuture_thread.settings import interface
from magnetosuture_thread.vision.images import image_of
from magnetosuture_thread.vision.lens import Lens, lens_of
from magnetosuture_thread.vision.settings import VisionTrackerSettings
from magnetosuture_thread.vision.tracker import FrameMeasurement, State, Track, TrackerSession, warm_up

NO_SCENE = "no scene yet: neither the parameter nor the topic says how large the dish is"
SILENCE = 0.5  # s without a frame, after which the tracker says that it sees nothing


class VisionTrackerNode(ManagedNode[VisionTrackerSettings]):
    """Tracks the needle in every camera frame; when it is lost, no pose is published.

    Activated again, it finds needle and thread anew.

    Attributes:
        follower: called with each frame in which the needle is tracked, once that is published.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("vision_tracker", VisionTrackerSettings, **options)
        self._session: TrackerSession | None = None
        self._scene = SceneFollower(self, self.on_scene)
        self._text = ""  # what was seen last
        self._lens: Lens | None = None
        self._lens_problem = ""  # why frames are not corrected for the lens, until valid parameters come
        self._last_frame = time.monotonic()
        self.follower: Callable[[Time, Track], None] | None = None
        topics.CAMERA_INFO.subscribe(self, self.on_camera_info)
        topics.NEEDLE_TIP.subscribe(self, self.on_tip)
        self.start()

    def allocate(self, settings: VisionTrackerSettings) -> None:
        """Load the kernels, and subscribe to the camera."""
        with self.health.load("the tracker's kernels"):
            warm_up()
        self._states = topics.TRACKER_STATE.publisher(self)
        self._publish = topics.publishing(self, topics.NEEDLE_POSE, topics.THREAD_OBSERVATION, topics.MEASURED_THREAD)
        topic = topics.COMPRESSED_IMAGE if settings.image_transport == "compressed" else topics.IMAGE
        self._camera = topic.subscribe(self, self.while_active(self.on_image)).topic_name
        self._start_session(settings, self._scene.load(settings.scene))
        self.every(0.5 * SILENCE, self.while_active(self.on_watch))
        self.get_logger().info(f"ready: frames from {self._camera}")

    def activate(self) -> None:
        """Look for needle and thread in the next frame."""
        self._text = "nothing seen"
        self.health.warn("no camera frame yet" if self._session is not None else NO_SCENE)

    def deactivate(self) -> None:
        """Forget needle and thread, which move meanwhile."""
        if not self.is_shutting_down:
            self._start_session(self.configured_settings, self._scene.scene)

    def release(self) -> None:
        """Leave the camera."""
        self._session = None

    def on_scene(self, scene: Scene) -> None:
        """Look for the needle in another scene."""
        if self._session is not None:
            self._session.set_scene(scene)
        else:
            self._start_session(self.configured_settings, scene)

    def on_camera_info(self, message: CameraInfo) -> None:
        """Undo the distortion of the camera's lens; frames are taken as they are where its parameters are invalid."""
        try:
            self._lens, self._lens_problem = lens_of(message), ""
        except InvalidInputError as error:
            self._lens, self._lens_problem = None, str(error)
            self.refuse(error)
        self._set_lens()

    def on_tip(self, message: PointStamped) -> None:
        """Take which end of the needle is its tip."""
        place = reading.plane_point(message, topics.NEEDLE_TIP.name)
        if self._session is not None:
            now, stamp = self.get_clock().now().nanoseconds, reading.nanoseconds(message.header.stamp)
            self._session.point_at_tip(place, 1e-9 * (min(stamp, now) or now))

    def on_watch(self) -> None:
        """Report when no frame has come for too long."""
        waited = time.monotonic() - self._last_frame
        if self._session is not None and self._session.frames and waited > SILENCE:
            reason = f"no camera frame for {waited:.1f} s"
            stamp = self.get_clock().now().to_msg()
            self._states.publish(packed_tracker_state(stamp, Track(self._session.missing, reason)))
            self.health.warn("; ".join(filter(None, (reason, f"before that {self._text}", self._lens_problem))))

    def _start_session(self, settings: VisionTrackerSettings, scene: Scene | None) -> None:
        self._session = None if scene is None else TrackerSession(settings, scene)
        self._set_lens()

    def _set_lens(self) -> None:
        """Undo the lens's distortion, unless frames come rectified."""
        if self._session is not None:
            self._session.set_lens(None if interface.is_rectified(self._camera) else self._lens)

    def on_image(self, message: Image | CompressedImage) -> None:
        """Track the needle in a frame; its pose is published before the thread is measured."""
        self._last_frame = time.monotonic()
        stamp, taken = message.header.stamp, 0.0
        reading.checked_nanoseconds(stamp, f"{self._camera}.header.stamp")  # nothing could be stamped by another
        if self._session is None:
            self._states.publish(packed_tracker_state(stamp, Track(State.SEARCHING, NO_SCENE)))
            self.health.warn(NO_SCENE)
            return
        try:
            image = image_of(message)
        except InvalidInputError as error:
            seen = self._session.on_broken(error)
        else:
            began = time.perf_counter()
            # A pose is published also with a heading that is unknown, which those who need it refuse.
            seen = self._session.on_image(
                reading.seconds(stamp),
                image,
                lambda pose: self._publish(pose_outputs(stamp, pose.tail, pose.heading, pose.covariance)),
            )
            taken = time.perf_counter() - began
        track = seen.track
        if seen.tracked:
            self._publish(thread_outputs(stamp, track.observation, seen.centreline))
            if self.follower is not None:
                self.follower(stamp, track)
        self._states.publish(packed_tracker_state(stamp, track, 0.0 if seen.problem else taken))
        self._report(seen, self._session)

    def _report(self, seen: FrameMeasurement, session: TrackerSession) -> None:
        """Report what was seen in a frame."""
        track = seen.track
        values: dict[str, Any] = {"frames": session.frames, "tracked": session.tracked}
        if track.needle_length is not None:
            values["needle_length_mm"] = round(1e3 * track.needle_length, 3)
        if len(track.axis):
            values["axis_mm"] = " to ".join(f"{1e3 * x:.2f}, {1e3 * y:.2f}" for x, y in track.axis)
        if seen.problem is not None:
            self.health.refuse(seen.problem, **values)
        else:
            state = "tracking" if seen.tracked else f"{track.state.value}: {track.reason}"
            self._text = "; ".join(filter(None, (state, track.warning)))
            text = "; ".join(filter(None, (self._text, self._lens_problem)))
            report = self.health.ok if text == "tracking" else self.health.warn
            report(text, confidence=round(track.confidence, 3), **values)
