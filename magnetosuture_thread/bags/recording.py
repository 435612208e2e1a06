"""A bag in the words of our graph: its topics, types and frame, whatever the recorder's were."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from typing import Any

from magnetosuture_thread import interface
from magnetosuture_thread.bags.conversion import CONVERSIONS, UNSTAMPED_TWIST, UnfitError, moved
from magnetosuture_thread.bags.reader import Bag, Record
from magnetosuture_thread.bags.transforms import TF_MESSAGE, TOPICS, Rigid, Transforms
from magnetosuture_thread.bags.types import typestore
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.interface import CAMERA, DISH_FRAME, Channel
from magnetosuture_thread.messages.cdr import is_in_dish, stamp_and_frame

CHANNELS = tuple(value for value in vars(interface).values() if isinstance(value, Channel))
_CAMERA_NAMES = {channel.recorded for channel in CAMERA.values()}
_CAMERA_TYPES = {channel.type_name: channel for channel in CAMERA.values()}


class Recording:
    """A bag as our graph would have recorded it.

    Messages whose type and frame are ours already are passed on byte for byte. Camera images are told by their
    type, whichever of the two topics they are on.

    Args:
        bag: the bag, its topics remapped to ours.
        dish_frame: name of the bag's frame that is ours, `dish`.

    Attributes:
        path: of the bag.
        camera: the camera's channel, the one with more messages if there are both; None if there is none.
        counts: messages of each of our channels that the bag has, by its recorded name.
        unfit: why a topic that has the name of one of our channels cannot be taken for it.
        refused: how many messages could not be converted, by the reason.
        notes: as the bag's.
        start: as the bag's [ns].
        duration: as the bag's [s].
        damage: as the bag's.
        unchecked: as the bag's.
    """

    def __init__(self, bag: Bag, *, dish_frame: str = DISH_FRAME) -> None:
        self.path = bag.path
        self.notes, self.start, self.duration = bag.notes, bag.start, bag.duration
        self.damage, self.unchecked = bag.damage, bag.unchecked
        self.refused: Counter[str] = Counter()
        self.unfit: dict[str, str] = {}
        self.counts: Counter[str] = Counter()
        self._bag = bag
        self._dish_frame = dish_frame.lstrip("/")
        self._transforms: Transforms | None = None
        self._topics: dict[Channel, str] = {}
        for channel in CHANNELS:
            self._find(channel)
        for channel, topic in self._topics.items():
            self.counts[channel.recorded] = bag.counts[topic]
        cameras = [channel for channel in CAMERA.values() if self.counts.get(channel.recorded)]
        self.camera: Channel | None = max(cameras, key=lambda c: self.counts[c.recorded], default=None)

    def require(self, channel: Channel) -> None:
        """Raise `BagError` unless the bag has messages that can be taken for a channel."""
        if channel.recorded in self.unfit:
            raise BagError(self.path, self.unfit[channel.recorded])
        if not self.counts.get(channel.recorded):
            present = ", ".join(sorted(self._bag.counts)) or "none"
            needed = f"has no messages on {channel.recorded} ({channel.type_name})"
            remap = f"; its topics: {present}; remap one by TOPIC:={channel.recorded}"
            raise BagError(self.path, needed + remap)

    def records(
        self, channels: Collection[Channel], *, start: float = 0.0, duration: float | None = None
    ) -> Iterator[Record]:
        """Go through the messages of some channels by time; what cannot be converted is counted in `refused`.

        Args:
            channels: of our graph; those that the bag lacks give nothing.
            start: only messages from this time on [s since the bag's start].
            duration: only messages until this time after `start` [s]; all that follow if None.

        Raises:
            BagError: a topic has another type than can be converted, or a frame from which nothing leads to the
                dish's; or the bag has changed since it was opened.
        """
        for channel in channels:
            if channel.recorded in self.unfit:
                raise BagError(self.path, self.unfit[channel.recorded])
        wanted = {self._topics[channel]: channel for channel in channels if channel in self._topics}
        # The first of each, so that a frame that leads nowhere is known before anything is made of the others.
        for topic, channel in wanted.items():
            self._try(topic, channel)
        return self._records(wanted, start, duration)

    def takes(self, topic: str) -> bool:
        """Return whether one of the bag's topics is one of our channels."""
        return topic in self._topics.values()

    def problem_of(self, topic: str) -> str:
        """Return why a topic with the name of one of our channels cannot be taken for it; empty if it can."""
        for channel, name in self._topics.items():
            if name == topic:
                try:
                    self._try(topic, channel)
                except BagError as error:
                    return error.problem
        return self.unfit.get(topic, "")

    def _try(self, topic: str, channel: Channel) -> None:
        for record in self._bag.records({topic}, refused=Counter()):
            self._convert(record, channel)
            return

    def _records(self, wanted: dict[str, Channel], start: float, duration: float | None) -> Iterator[Record]:
        for record in self._bag.records(wanted, start=start, duration=duration, refused=self.refused):
            channel = wanted[record.topic]
            converted = self._convert(record, channel)
            if isinstance(converted, str):
                self.refused[f"{channel.recorded}: {converted}"] += 1
            else:
                yield converted

    def _find(self, channel: Channel) -> None:
        """Find the topic that is one of our channels."""
        bag, name = self._bag, channel.recorded
        if name in _CAMERA_NAMES:
            fitting = [topic for topic in _CAMERA_NAMES if bag.topics.get(topic) == channel.type_name]
            if len(fitting) > 1:
                fitting = [name]  # what has the channel's own name comes first
            if fitting:
                self._topics[channel] = fitting[0]
                return
            if bag.topics.get(name) in _CAMERA_TYPES:
                return  # the other camera channel takes it
        if name in bag.conflicts:
            self.unfit[name] = f"topic {name} has two types, {' and '.join(bag.conflicts[name])}; expected one"
        elif name in bag.topics:
            taken = {*CONVERSIONS.get(channel.type_name, {}), channel.type_name}
            if bag.topics[name] in taken:
                self._topics[channel] = name
            else:
                expected = " or ".join(sorted(taken))
                self.unfit[name] = f"topic {name} is of type {bag.topics[name]}, expected {expected}"

    def _convert(self, record: Record, channel: Channel) -> Record | str:
        """Return a record as our graph would have it; the reason where it cannot be one."""
        conversions = CONVERSIONS.get(channel.type_name)
        is_ours = record.type_name == channel.type_name and record.decoder.is_ours
        if is_ours and (conversions is None or (self._dish_frame == DISH_FRAME and is_in_dish(record.data))):
            return record if record.topic == channel.recorded else self._said(record, channel, record.data)
        if conversions is None:
            return f"its type {record.type_name} is defined in another way than ours"
        frame, stamp = self._dish_frame, record.time
        try:
            if record.type_name != UNSTAMPED_TWIST:
                stamp, frame = stamp_and_frame(record.topic, record.data)
            message = conversions[record.type_name](record.decode(), record.time)
        except (BagError, UnfitError, AttributeError, TypeError, ValueError) as problem:
            # Fields that are not there, or are of other kinds: another definition of the type.
            return problem.problem if isinstance(problem, BagError) else str(problem)
        frame = frame.lstrip("/")
        if frame == self._dish_frame:
            message.header.frame_id = DISH_FRAME
        else:
            rigid = self._into_dish(record.topic, frame, stamp)
            if rigid is None:
                return f"nothing tells where its frame {frame} was at its time"
            try:
                message = moved(message, rigid, DISH_FRAME)
            except (UnfitError, ValueError) as problem:  # a covariance of another size
                return str(problem)
        try:
            data = bytes(typestore().serialize_cdr(message, channel.type_name))
        except Exception:  # The writer raises whatever a value makes it stumble over, such as a stamp out of range.
            return "a value that our type has no room for"
        return self._said(record, channel, data)

    def _into_dish(self, topic: str, frame: str, stamp: int) -> Rigid | None:
        """Return where the points of a frame are in the dish's at a time [ns]; None where nothing tells.

        Raises:
            BagError: nothing ever leads from the frame to the dish's.
        """
        if self._transforms is None:
            self._transforms = Transforms(self._told_transforms())
        if not frame or not self._transforms.lead(frame, self._dish_frame):
            known = ", ".join(self._transforms.frames) or "none"
            which = f"the frame {frame}, from which nothing leads to {self._dish_frame}" if frame else "an empty frame"
            raise BagError(
                self.path,
                f"topic {topic} has {which}; frames told on {' and '.join(TOPICS)}: {known}. "
                f"If it is the dish's own frame, say so: --frame {frame or repr(frame)}",
            )
        return self._transforms.between(frame, self._dish_frame, stamp)

    def _told_transforms(self) -> Iterator[tuple[str, Any]]:
        """Yield topic and message of all transforms; what is none is counted in `refused`."""
        topics = [topic for topic in TOPICS if self._bag.topics.get(topic) == TF_MESSAGE]
        for record in self._bag.records(topics, refused=self.refused):
            try:
                if not record.decoder.is_ours:
                    raise BagError(record.topic, f"its type {record.type_name} is defined in another way than ours")
                yield record.topic, record.decode()
            except BagError as error:
                self.refused[str(error)] += 1

    def _said(self, record: Record, channel: Channel, data: bytes) -> Record:
        return Record(channel.recorded, channel.type_name, record.time, data)
