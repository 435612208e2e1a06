"""Adapts a bag to our graph: converts its topics, types and frames to ours; and reports what a bag holds."""

from __future__ import annotations

import math
import struct
from array import array
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.bags.message_types import typestore
from magnetosuture_thread.bags.packing import BEGIN, MarkerType, pack, packed_poses
from magnetosuture_thread.bags.reader import Bag, RecordedMessage
from magnetosuture_thread.bags.reading import nanoseconds, stamp_and_frame
from magnetosuture_thread.bags.storage import CDR, MAX_SILENCE
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.interface import CAMERA, CAMERA_INFO, DISH_FRAME, Channel, is_rectified

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

POSE, POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
TWIST, UNSTAMPED_TWIST = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"
PATH = "nav_msgs/msg/Path"
UPRIGHT = (0.0, 0.0, 0.0, 1.0)  # quaternion without rotation

Matrix = NDArray[np.float64]  # homogeneous, shape (4, 4): p' = R p + t


class Recording:
    """A bag whose messages are converted to the topics, types and frame of our graph.

    Messages whose type and frame are ours already are passed on byte for byte. Camera images are identified by their
    type, whichever of the two camera topics they are on.

    Args:
        bag: the bag, its topics remapped to ours.
        dish_frame: name of the dish frame in the bag.

    Attributes:
        path: of the bag.
        camera: the camera's channel, the one with more messages if there are both; None if there is none.
        counts: messages of each of our channels that the bag has, by its recorded name.
        unfit: why a topic with the name of one of our channels cannot be used, by that name.
        refused: number of messages that could not be converted, by reason.
        notes: as the bag's.
        start: as the bag's [ns].
        duration: as the bag's [s].
        damage: as the bag's.
        has_no_checksum: as the bag's.
        salvaged_without_checksum: as the bag's.
        remarks: as the bag's, and that frames are rectified.
        rectified: the camera's recorded topic where its frames are rectified, as by image_proc: then no lens is to be
            undone, and the bag's camera_info is left out; else empty.
    """

    def __init__(self, bag: Bag, *, dish_frame: str = DISH_FRAME) -> None:
        self.path = bag.path
        self.notes, self.start, self.duration = bag.notes, bag.start, bag.duration
        self.damage, self.has_no_checksum = bag.damage, bag.has_no_checksum
        self.salvaged_without_checksum, self.remarks = bag.salvaged_without_checksum, list(bag.remarks)
        self.refused: Counter[str] = Counter()
        self.unfit: dict[str, str] = {}
        self.counts: Counter[str] = Counter()
        self._bag = bag
        self._dish_frame = dish_frame.lstrip("/")
        self._needle_frame = f"{self._dish_frame[: self._dish_frame.rfind('/') + 1]}needle"
        self._transforms: TransformTree | None = None
        self._topics: dict[Channel, str] = {}
        for channel in (value for value in vars(interface).values() if isinstance(value, Channel)):
            if topic := self._matching_topic(channel):
                self._topics[channel], self.counts[channel.recorded] = topic, bag.counts[topic]
        cameras = [channel for channel in CAMERA.values() if self.counts.get(channel.recorded)]
        self.camera: Channel | None = max(cameras, key=lambda c: self.counts[c.recorded], default=None)
        topic = bag.recorded_name(self._topics[self.camera]) if self.camera is not None else ""
        self.rectified = topic if is_rectified(topic) else ""
        if self.rectified and self._topics.pop(CAMERA_INFO, None) is not None:
            del self.counts[CAMERA_INFO.recorded]
            self.remarks.append(f"{topic} is rectified: the lens of {CAMERA_INFO.recorded} is not undone again")

    def refuse_unfit(self, *channels: Channel) -> None:
        """Raise `BagError` if a topic with the name of one of some channels cannot be used."""
        for channel in channels:
            if channel.recorded in self.unfit:
                raise BagError(self.path, self.unfit[channel.recorded])

    def require(self, channel: Channel) -> None:
        """Raise `BagError` unless the bag has messages for a channel."""
        self.refuse_unfit(channel)
        if not self.counts.get(channel.recorded):
            topics = ", ".join(sorted(self._bag.counts)) or "none"
            remap = f"its topics: {topics}; remap one by TOPIC:={channel.recorded}"
            raise BagError(self.path, f"has no messages on {channel.recorded} ({channel.type_name}); {remap}")

    def records(
        self, channels: Collection[Channel], *, start: float = 0.0, duration: float | None = None
    ) -> Iterator[RecordedMessage]:
        """Yield the messages of some channels by time; those that cannot be converted are counted in `refused`.

        Args:
            channels: of our graph; those that the bag lacks give nothing.
            start: only messages from this time on [s since the bag's start].
            duration: only messages until this time after `start` [s]; all that follow if None.

        Raises:
            BagError: a topic has a type that cannot be converted, or a frame without a transform to the dish frame; or
                the bag has changed since it was opened.
        """
        self.refuse_unfit(*channels)
        wanted = {self._topics[channel]: channel for channel in channels if channel in self._topics}
        # The first message of each, so that an unknown frame is reported before any message is used.
        for topic, channel in wanted.items():
            first = next(self._bag.records({topic}, refused=Counter()), None)
            if first is not None:
                with suppress(UnfitError):
                    self.convert(first, channel)
        return self._records(wanted, start, duration)

    def channel_of(self, topic: str) -> Channel | None:
        """Return our channel that a topic of the bag is used as; None if it is not used."""
        return next((channel for channel, name in self._topics.items() if name == topic), None)

    def _records(self, wanted: dict[str, Channel], start: float, duration: float | None) -> Iterator[RecordedMessage]:
        for record in self._bag.records(wanted, start=start, duration=duration, refused=self.refused):
            channel = wanted[record.topic]
            try:
                yield self.convert(record, channel)
            except UnfitError as problem:
                self.refused[f"{channel.recorded}: {problem}"] += 1

    def _matching_topic(self, channel: Channel) -> str:
        """Return the topic for one of our channels; empty, and `unfit` says why, where there is none."""
        bag, name = self._bag, channel.recorded
        if channel in CAMERA.values():
            topics = [name, *(other.recorded for other in CAMERA.values())]
            if fitting := [topic for topic in topics if bag.topics.get(topic) == channel.type_name]:
                return fitting[0]
            if bag.topics.get(name) in {other.type_name for other in CAMERA.values()}:
                return ""  # used by the other camera channel
        accepted = {*CONVERTED.get(channel.type_name, ()), channel.type_name}
        if name in bag.conflicts:
            self.unfit[name] = bag.conflict(name)
        elif bag.topics.get(name) in accepted:
            return name
        elif name in bag.topics:
            expected = " or ".join(sorted(accepted))
            self.unfit[name] = f"topic {name} is of type {bag.topics[name]}, expected {expected}"
        return ""

    def convert(self, record: RecordedMessage, channel: Channel) -> RecordedMessage:
        """Return a message converted to our type and frame.

        Raises:
            UnfitError: that is impossible.
            BagError: its frame is never connected to the dish frame.
        """
        data = self._converted_data(record, channel)
        return RecordedMessage(channel.recorded, channel.type_name, record.time, data)

    def _converted_data(self, record: RecordedMessage, channel: Channel) -> bytes:
        is_ours = record.type_name == channel.type_name and record.decoder.is_ours
        if channel.type_name not in CONVERTED:
            if not is_ours:
                raise UnfitError(f"its type {record.type_name} has another definition than ours")
            return self._in_our_frame(record)
        frame, stamp = self._dish_frame, record.time  # of a Twist, which has none
        try:
            if record.type_name != UNSTAMPED_TWIST:
                stamp, frame = stamp_and_frame(record.topic, record.data)
            if is_ours and frame == self._dish_frame == DISH_FRAME and record.data.startswith(BEGIN[:2]):
                return record.data  # as our machines write it
            message = record.decode()
        except BagError as error:
            raise UnfitError(error.problem) from None
        frame = frame.lstrip("/")
        if is_ours and record.type_name == TWIST and frame == self._needle_frame:
            return _in_frame(message, interface.NEEDLE_FRAME)
        matrix = None if frame == self._dish_frame else self._transform_to_dish(record.topic, frame, stamp)
        try:
            return converted(message, channel.type_name, stamp, matrix)
        except (AttributeError, TypeError, ValueError) as error:  # of another definition of the type
            raise UnfitError(str(error)) from None
        except struct.error:
            raise UnfitError("a value out of range of our type") from None

    def _in_our_frame(self, record: RecordedMessage) -> bytes:
        """Return the bytes of a message of ours, where it is in the bag's dish frame in ours."""
        if self._dish_frame == DISH_FRAME:
            return record.data
        with suppress(BagError):  # it has no frame, or cannot be decoded, which whoever takes it reports
            if stamp_and_frame(record.topic, record.data)[1].lstrip("/") == self._dish_frame:
                return _in_frame(record.decode(), DISH_FRAME)
        return record.data

    def _transform_to_dish(self, topic: str, frame: str, stamp: int) -> Matrix:
        """Return the transform from a frame to the dish frame at a time [ns].

        Raises:
            UnfitError: it is unknown at that time.
            BagError: the frame is never connected to the dish frame.
        """
        if self._transforms is None:
            self._transforms = TransformTree(self._transform_messages())
        if not frame or self._transforms.lookup(frame, self._dish_frame, None) is None:
            known = ", ".join(self._transforms.frames) or "none"
            which = f"the frame {frame}, which is not connected to {self._dish_frame}" if frame else "an empty frame"
            advice = f"If it is the dish frame, give it: --frame {frame or repr(frame)}"
            raise BagError(self.path, f"topic {topic} has {which}; frames on /tf and /tf_static: {known}. {advice}")
        matrix = self._transforms.lookup(frame, self._dish_frame, stamp)
        if matrix is None:
            raise UnfitError(f"no transform from its frame {frame} at its time")
        return matrix

    def _transform_messages(self) -> Iterator[tuple[str, Any]]:
        """Yield topic and message of all transforms; invalid ones are counted in `refused`."""
        topics = [topic for topic in ("/tf", "/tf_static") if self._bag.topics.get(topic) == "tf2_msgs/msg/TFMessage"]
        for record in self._bag.records(topics, refused=self.refused):
            try:
                if not record.decoder.is_ours:
                    raise BagError(record.topic, f"its type {record.type_name} has another definition than ours")
                yield record.topic, record.decode()
            except BagError as error:
                self.refused[str(error)] += 1


def _in_frame(message: Any, frame: str) -> bytes:
    """Return a message with a header as CDR bytes, in a frame of another name."""
    message.header.frame_id = frame
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


class UnfitError(Exception):
    """A message that cannot be converted to a type of our graph; the text gives the reason."""


class TransformTree:
    """Tree of frames.

    Args:
        messages: topic and tf2_msgs/TFMessage in the order of the bag. Of static transforms the last one holds at any
            time; one that moves holds from its stamp until the next.
    """

    def __init__(self, messages: Iterable[tuple[str, Any]]) -> None:
        # By child frame, in the order of time: stamp, parent, and the transform into it from then on.
        self._edges: dict[str, list[tuple[float, str, Matrix]]] = {}
        static: dict[str, list[tuple[float, str, Matrix]]] = {}
        for topic, message in messages:
            for transform in message.transforms:
                child, parent = transform.child_frame_id.lstrip("/"), transform.header.frame_id.lstrip("/")
                matrix = matrix_of(transform.transform)
                if matrix is None or child == parent:
                    continue
                if topic == "/tf_static":
                    static[child] = [(-math.inf, parent, matrix)]
                else:
                    self._edges.setdefault(child, []).append((nanoseconds(transform.header.stamp), parent, matrix))
        self._edges |= static
        for entries in self._edges.values():
            entries.sort(key=itemgetter(0))

    @property
    def frames(self) -> list[str]:
        """Names of all frames."""
        return sorted({parent for entries in self._edges.values() for _, parent, _ in entries} | set(self._edges))

    def lookup(self, frame: str, target: str, stamp: int | None) -> Matrix | None:
        """Return the transform from a frame into another at a time [ns], the last if None; None where it is unknown."""
        ups, downs = self._ancestors(frame, stamp), self._ancestors(target, stamp)
        for ancestor, matrix in ups.items():
            if ancestor in downs:
                return np.asarray(np.linalg.inv(downs[ancestor]) @ matrix)
        return None

    def _ancestors(self, frame: str, stamp: int | None) -> dict[str, Matrix]:
        """Return the transform of a frame into each of its ancestors, from the nearest on."""
        matrix = np.eye(4)
        ancestors = {frame: matrix}
        while entries := self._edges.get(frame):
            index = len(entries) if stamp is None else bisect_right(entries, stamp, key=itemgetter(0))
            if not index:
                break  # Nothing is known as early as that.
            _, frame, up = entries[index - 1]
            if frame in ancestors:
                break  # A cycle of frames.
            matrix = up @ matrix
            ancestors[frame] = matrix
        return ancestors


def matrix_of(transform: Any) -> Matrix | None:
    """Return a Transform as a matrix; None if it is not finite, or its quaternion 0."""
    place, turn, matrix = transform.translation, transform.rotation, np.eye(4)
    matrix[:3, 3] = place.x, place.y, place.z
    try:
        matrix[:3, :3] = _rotations(np.array([[turn.x, turn.y, turn.z, turn.w]])).as_matrix()[0]
    except UnfitError:
        return None
    return matrix if np.isfinite(matrix).all() else None


def _rotations(quaternions: NDArray[np.float64]) -> Rotation:
    """Return the rotations of quaternions of any length, shape (n, 4).

    Raises:
        UnfitError: one is not finite, or of length 0.
    """
    from scipy.spatial.transform import Rotation  # late, as bags of our own graph turn nothing

    greatest = np.abs(quaternions).max(axis=1, keepdims=True)
    if not np.isfinite(greatest).all() or not greatest.all():
        raise UnfitError("not a valid orientation")
    return Rotation.from_quat(quaternions / greatest)  # whose length neither vanishes nor overflows


def _pose(position: Any, orientation: Any = None) -> list[float]:
    """Return position [m] and quaternion of a pose."""
    turn = UPRIGHT if orientation is None else (orientation.x, orientation.y, orientation.z, orientation.w)
    return [position.x, position.y, position.z, *turn]


def _needle_pose(message: Any) -> list[float]:
    """Return the pose in a message that holds one, however deep."""
    if hasattr(message, "transform"):
        if matrix_of(message.transform) is None:
            raise UnfitError("not a valid transform")
        return _pose(message.transform.translation, message.transform.rotation)
    pose = getattr(message.pose, "pose", message.pose)
    return _pose(pose.position, pose.orientation)


def _marker_poses(message: Any) -> list[list[float]]:
    """Return the points of a Marker that is a line strip, as poses."""
    if message.action != 0 or message.type != MarkerType.LINE_STRIP:
        raise UnfitError("a marker that is no line strip being added")
    pose = np.array(_pose(message.pose.position, message.pose.orientation))
    place, turn = pose[:3], pose[3:] if pose[3:].any() else np.array(UPRIGHT)  # RViz takes zeros for no rotation
    if not np.isfinite(place).all():
        raise UnfitError("a place that is not finite")
    points = np.array([[point.x, point.y, point.z] for point in message.points]).reshape(-1, 3)
    return [[*point, *UPRIGHT] for point in _rotations(turn[None]).apply(points) + place]


# By the type that a bag may have: what gives the points or poses of a thread in a message.
_PATHS: dict[str, Callable[[Any], list[list[float]]]] = {
    PATH: lambda m: [_pose(stamped.pose.position, stamped.pose.orientation) for stamped in m.poses],
    "geometry_msgs/msg/PoseArray": lambda m: [_pose(pose.position, pose.orientation) for pose in m.poses],
    "geometry_msgs/msg/PolygonStamped": lambda m: [_pose(point) for point in m.polygon.points],
    "visualization_msgs/msg/Marker": _marker_poses,
    "magnetosuture_msgs/msg/PredictedThread": lambda m: [_pose(point) for point in m.positions],
}
_POSES = (POSE, POSE_WITH_COVARIANCE, "geometry_msgs/msg/TransformStamped", "nav_msgs/msg/Odometry")
# Types that a bag may have, by the type that our graph takes.
CONVERTED = {POSE: _POSES, POSE_WITH_COVARIANCE: _POSES, PATH: tuple(_PATHS), TWIST: (TWIST, UNSTAMPED_TWIST)}


def converted(message: Any, type_name: str, stamp: int, matrix: Matrix | None) -> bytes:
    """Return a message as CDR bytes of one of our types, in the dish frame.

    A covariance C becomes M C M^T, where M turns position and rotation alike. Of a twist only the directions change: it
    stays the velocity of the same point, seen from a frame at rest.

    Args:
        message: of one of the types in `CONVERTED`.
        type_name: our type.
        stamp: of the message [ns].
        matrix: the transform from its frame to the dish frame; None for no change.

    Raises:
        UnfitError: it holds no such thing.
        struct.error: its stamp is out of range.
    """
    if type_name == TWIST:
        twist = getattr(message, "twist", message)
        vectors = np.array([[vector.x, vector.y, vector.z] for vector in (twist.linear, twist.angular)])
        if matrix is not None:  # else inf would make nan of its neighbours
            vectors = vectors @ matrix[:3, :3].T
        return pack("header float64[6]", stamp, vectors)
    if type_name == PATH:
        return packed_poses(stamp, _moved(_PATHS[message.__msgtype__](message), matrix))
    (pose,) = _moved([_needle_pose(message)], matrix)
    if type_name == POSE:
        return pack("header float64[7]", stamp, pose)
    covariance = np.reshape(getattr(getattr(message, "pose", None), "covariance", np.zeros(36)), (6, 6))
    if matrix is not None:
        both = np.kron(np.eye(2), matrix[:3, :3])
        covariance = both @ covariance @ both.T
    return pack("header float64[7] float64[36]", stamp, pose, covariance)


def _moved(poses: list[list[float]], matrix: Matrix | None) -> Matrix:
    """Return poses, shape (n, 7), in another frame; quaternions keep their length, which whoever takes them judges."""
    moved = np.array(poses, dtype=float).reshape(-1, 7)
    if matrix is not None and poses:
        moved[:, :3] = moved[:, :3] @ matrix[:3, :3].T + matrix[:3, 3]
        turns = _rotations(moved[:, 3:])
        turned = type(turns).from_matrix(matrix[:3, :3]) * turns
        moved[:, 3:] = turned.as_quat() * np.linalg.norm(moved[:, 3:], axis=1, keepdims=True)
    return moved


@dataclass
class TopicReport:
    """Report on a topic.

    Attributes:
        topic: its name, remapped.
        types: of its messages; more than one is an error of the recorder.
        channel: of our graph that the topic is used as; None for a topic that it does not use.
        known: whether at least one of its messages can be used.
        problem: why none can, although the topic has the name of one of ours.
        times: when each message was recorded [s since the bag's start].
        stamps: of the messages that have one [ns].
        unreadable: number of messages whose stamp cannot be read although their type has one.
        frames: frame ids of the messages.
    """

    topic: str
    types: tuple[str, ...]
    channel: Channel | None
    known: bool
    problem: str
    times: array[float] = field(default_factory=lambda: array("d"))
    stamps: array[int] = field(default_factory=lambda: array("q"))
    unreadable: int = 0
    frames: set[str] = field(default_factory=set)

    def add(self, record: RecordedMessage, time: float, serialization: str, recording: Recording) -> None:
        """Add a message that was recorded at a time [s since the bag's start]; try to use it until one can be used."""
        self.times.append(time)
        if serialization == CDR and record.decoder.has_header():
            try:
                stamp, frame = stamp_and_frame(record.topic, record.data)
                self.stamps.append(stamp)
                self.frames.add(frame)
            except BagError:
                self.unreadable += 1
        if self.channel is None or self.known:
            return
        try:
            if serialization != CDR:
                raise UnfitError(f"they are written as {serialization!r}, expected {CDR!r}")
            recording.convert(record, self.channel).decode()
            self.known, self.problem = True, ""
        except (UnfitError, BagError) as error:
            reason = error.problem if isinstance(error, BagError) else error
            self.problem = self.problem or f"none of the messages on {self.topic} can be used: {reason}"

    def to_json(self) -> dict[str, Any]:
        """Return the report in SI units; null where there is no value."""
        times = np.array(self.times)
        span = float(np.ptp(times)) if len(times) else 0.0
        return {
            "topic": self.topic,
            "types": list(self.types),
            "messages": len(times),
            "rate_hz": (len(times) - 1) / span if span > 0.0 else None,
            "first_s": float(times[0]) if len(times) else None,
            "last_s": float(times[-1]) if len(times) else None,
            "greatest_gap_s": float(np.diff(times).max()) if len(times) > 1 else None,
            "stamps_going_back": int((np.diff(np.array(self.stamps)) < 0).sum()),
            "unreadable_stamps": self.unreadable,
            "frames": sorted(self.frames),
            "known": self.known,
            "problem": self.problem or None,
        }


def inspect_bag(bag: Bag, dish_frame: str, progress: Callable[[float], None] = lambda share: None) -> dict[str, Any]:
    """Read all messages of a bag and return a report on its content in SI units; null where there is no value.

    Args:
        bag: to inspect.
        dish_frame: name of the dish frame in the bag.
        progress: called with the share done, 0 to 1.
    """
    recording = Recording(bag, dish_frame=dish_frame)
    topics: dict[str, TopicReport] = {}
    for name in sorted(bag.counts):
        channel = recording.channel_of(name)
        is_empty = channel is not None and not bag.counts[name]
        types = bag.conflicts.get(name) or (bag.topics[name],)
        topics[name] = TopicReport(name, types, channel, is_empty, recording.unfit.get(name, ""))
    refused: Counter[str] = Counter()
    silences, last = list[dict[str, float]](), 0.0
    for connection, record in bag.every_record(refused):
        time = (record.time - bag.start) * 1e-9
        if time - last > MAX_SILENCE:
            silences.append({"begin_s": last, "end_s": time})
        last = time
        topics[record.topic].add(record, time, connection.serialization, recording)
        progress(time / max(bag.duration, 1e-9))
    return {
        "bag": str(bag.path),
        "start_s": bag.start * 1e-9,
        "duration_s": bag.duration,
        "messages": sum(bag.counts.values()),
        "notes": bag.notes,
        "files": bag.facts,
        "has_no_checksum": bag.has_no_checksum or None,
        "salvaged_without_checksum": bag.salvaged_without_checksum or None,
        "remarks": bag.remarks,
        "refused": dict(refused),
        "silences": silences,
        "damage": None if bag.damage is None else bag.damage.to_json(),
        "topics": [topic.to_json() for topic in topics.values()],
    }
