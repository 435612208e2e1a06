"""Adapts a bag to our graph: converts its topics, types and frames to ours."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from typing import Any

from magnetosuture_thread import interface
from magnetosuture_thread.bags.conversion import (
    CONVERSIONS,
    TF_MESSAGE,
    TOPICS,
    UNSTAMPED_TWIST,
    RigidTransform,
    TransformTree,
    UnfitError,
    moved,
)
from magnetosuture_thread.bags.message_types import typestore
from magnetosuture_thread.bags.reader import Bag, RecordedMessage
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.interface import CAMERA, DISH_FRAME, Channel
from magnetosuture_thread.messages.cdr import is_in_dish_frame, stamp_and_frame

CHANNELS = tuple(value for value in vars(interface).values() if isinstance(value, Channel))
_CAMERA_TOPICS = {channel.recorded for channel in CAMERA.values()}
_CAMERA_TYPES = {channel.type_name: channel for channel in CAMERA.values()}


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
        unchecked: as the bag's.
        unverified: as the bag's.
        remarks: as the bag's.
    """

    def __init__(self, bag: Bag, *, dish_frame: str = DISH_FRAME) -> None:
        self.path = bag.path
        self.notes, self.start, self.duration = bag.notes, bag.start, bag.duration
        self.damage, self.unchecked = bag.damage, bag.unchecked
        self.unverified, self.remarks = bag.unverified, bag.remarks
        self.refused: Counter[str] = Counter()
        self.unfit: dict[str, str] = {}
        self.counts: Counter[str] = Counter()
        self._bag = bag
        self._dish_frame = dish_frame.lstrip("/")
        self._transforms: TransformTree | None = None
        self._topics: dict[Channel, str] = {}
        for channel in CHANNELS:
            self._match(channel)
        for channel, topic in self._topics.items():
            self.counts[channel.recorded] = bag.counts[topic]
        cameras = [channel for channel in CAMERA.values() if self.counts.get(channel.recorded)]
        self.camera: Channel | None = max(cameras, key=lambda c: self.counts[c.recorded], default=None)

    def require(self, channel: Channel) -> None:
        """Raise `BagError` unless the bag has messages for a channel."""
        if channel.recorded in self.unfit:
            raise BagError(self.path, self.unfit[channel.recorded])
        if not self.counts.get(channel.recorded):
            present = ", ".join(sorted(self._bag.counts)) or "none"
            needed = f"has no messages on {channel.recorded} ({channel.type_name})"
            remap = f"; its topics: {present}; remap one by TOPIC:={channel.recorded}"
            raise BagError(self.path, needed + remap)

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
        for channel in channels:
            if channel.recorded in self.unfit:
                raise BagError(self.path, self.unfit[channel.recorded])
        wanted = {self._topics[channel]: channel for channel in channels if channel in self._topics}
        # The first message of each, so that an unknown frame is reported before any message is used.
        for topic, channel in wanted.items():
            self._check_first(topic, channel)
        return self._records(wanted, start, duration)

    def uses(self, topic: str) -> bool:
        """Return whether a topic of the bag is used as one of our channels."""
        return topic in self._topics.values()

    def problem_of(self, topic: str) -> str:
        """Return why a topic with the name of one of our channels cannot be used; empty if it can."""
        for channel, name in self._topics.items():
            if name == topic:
                try:
                    return self._conversion_problem(topic, channel)
                except BagError as error:
                    return error.problem
        return self.unfit.get(topic, "")

    def _conversion_problem(self, topic: str, channel: Channel) -> str:
        """Return why not one message of a topic can be used; empty if one can, or there are none.

        Raises:
            BagError: their frame is not connected to the dish's.
        """
        first, refused = "", Counter[str]()
        for record in self._bag.records({topic}, refused=refused):
            try:
                converted = self._convert(record, channel)
                if not isinstance(converted, str):
                    converted.decode()
                    return ""
            except BagError as error:
                if error.path == str(self.path):
                    raise
                converted = error.problem
            first = first or converted
        first = first or next(iter(refused), "")
        return f"none of the messages on {topic} can be used: {first}" if first else ""

    def _check_first(self, topic: str, channel: Channel) -> None:
        for record in self._bag.records({topic}, refused=Counter()):
            self._convert(record, channel)
            return

    def _records(self, wanted: dict[str, Channel], start: float, duration: float | None) -> Iterator[RecordedMessage]:
        for record in self._bag.records(wanted, start=start, duration=duration, refused=self.refused):
            channel = wanted[record.topic]
            converted = self._convert(record, channel)
            if isinstance(converted, str):
                self.refused[f"{channel.recorded}: {converted}"] += 1
            else:
                yield converted

    def _match(self, channel: Channel) -> None:
        """Find the topic for one of our channels."""
        bag, name = self._bag, channel.recorded
        if name in _CAMERA_TOPICS:
            fitting = [topic for topic in _CAMERA_TOPICS if bag.topics.get(topic) == channel.type_name]
            if len(fitting) > 1:
                fitting = [name]  # the name of the channel comes first
            if fitting:
                self._topics[channel] = fitting[0]
                return
            if bag.topics.get(name) in _CAMERA_TYPES:
                return  # used by the other camera channel
        if name in bag.conflicts:
            self.unfit[name] = f"topic {name} has two types, {' and '.join(bag.conflicts[name])}; expected one"
        elif name in bag.topics:
            accepted = {*CONVERSIONS.get(channel.type_name, {}), channel.type_name}
            if bag.topics[name] in accepted:
                self._topics[channel] = name
            else:
                expected = " or ".join(sorted(accepted))
                self.unfit[name] = f"topic {name} is of type {bag.topics[name]}, expected {expected}"

    def _convert(self, record: RecordedMessage, channel: Channel) -> RecordedMessage | str:
        """Return a message converted to our type and frame; the reason where that is impossible."""
        conversions = CONVERSIONS.get(channel.type_name)
        is_ours = record.type_name == channel.type_name and record.decoder.is_ours
        if is_ours and (conversions is None or (self._dish_frame == DISH_FRAME and is_in_dish_frame(record.data))):
            return record if record.topic == channel.recorded else self._as_channel(record, channel, record.data)
        if conversions is None:
            return f"its type {record.type_name} has another definition than ours"
        frame, stamp = self._dish_frame, record.time
        try:
            if record.type_name != UNSTAMPED_TWIST:
                stamp, frame = stamp_and_frame(record.topic, record.data)
            message = conversions[record.type_name](record.decode(), record.time)
        except (BagError, UnfitError, AttributeError, TypeError, ValueError) as problem:
            # Fields are missing or of other types: another definition of the type.
            return problem.problem if isinstance(problem, BagError) else str(problem)
        frame = frame.lstrip("/")
        if frame == self._dish_frame:
            message.header.frame_id = DISH_FRAME
        else:
            transform = self._transform_to_dish(record.topic, frame, stamp)
            if transform is None:
                return f"no transform from its frame {frame} at its time"
            try:
                message = moved(message, transform, DISH_FRAME)
            except (UnfitError, ValueError) as problem:  # a covariance of another size
                return str(problem)
        try:
            data = bytes(typestore().serialize_cdr(message, channel.type_name))
        except Exception:  # The serialiser raises any error, for example for a stamp out of range.
            return "a value out of range of our type"
        return self._as_channel(record, channel, data)

    def _transform_to_dish(self, topic: str, frame: str, stamp: int) -> RigidTransform | None:
        """Return the transform from a frame to the dish frame at a time [ns]; None where it is unknown.

        Raises:
            BagError: the frame is never connected to the dish frame.
        """
        if self._transforms is None:
            self._transforms = TransformTree(self._transform_messages())
        if not frame or not self._transforms.is_connected(frame, self._dish_frame):
            known = ", ".join(self._transforms.frames) or "none"
            which = f"the frame {frame}, which is not connected to {self._dish_frame}" if frame else "an empty frame"
            raise BagError(
                self.path,
                f"topic {topic} has {which}; frames on {' and '.join(TOPICS)}: {known}. "
                f"If it is the dish frame, give it: --frame {frame or repr(frame)}",
            )
        return self._transforms.lookup(frame, self._dish_frame, stamp)

    def _transform_messages(self) -> Iterator[tuple[str, Any]]:
        """Yield topic and message of all transforms; invalid ones are counted in `refused`."""
        topics = [topic for topic in TOPICS if self._bag.topics.get(topic) == TF_MESSAGE]
        for record in self._bag.records(topics, refused=self.refused):
            try:
                if not record.decoder.is_ours:
                    raise BagError(record.topic, f"its type {record.type_name} has another definition than ours")
                yield record.topic, record.decode()
            except BagError as error:
                self.refused[str(error)] += 1

    def _as_channel(self, record: RecordedMessage, channel: Channel, data: bytes) -> RecordedMessage:
        return RecordedMessage(channel.recorded, channel.type_name, record.time, data)
