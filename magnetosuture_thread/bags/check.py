"""Checks a bag: what it holds and what of it is damaged; and writes what can be vouched for into a new one."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from magnetosuture_thread.bags.cdr import stamp_and_frame
from magnetosuture_thread.bags.message_types import own_definition
from magnetosuture_thread.bags.reader import Bag, RecordedMessage
from magnetosuture_thread.bags.recording import Recording, UnfitError
from magnetosuture_thread.bags.storage import (
    CDR,
    MAX_SILENCE,
    NO_CHECKSUM_NOTE,
    QOS,
    Connection,
    DamageReport,
    jazzy_qos_profiles,
)
from magnetosuture_thread.bags.writer import MAX_TIME, BagWriter
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.interface import Channel


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
    channel: Channel | None = None
    known: bool = False
    problem: str = ""
    times: array[float] = field(default_factory=lambda: array("d"))
    stamps: array[int] = field(default_factory=lambda: array("q"))
    unreadable: int = 0
    frames: set[str] = field(default_factory=set)

    def add(self, record: RecordedMessage, time: float, serialization: str, recording: Recording) -> None:
        """Add a message that was recorded at a time [s since the bag's start]; try to use it until one can be used."""
        self.times.append(time)
        if serialization != CDR:
            self._refuse(f"they are written as {serialization!r}, expected {CDR!r}")
            return
        if record.decoder.has_header():
            try:
                stamp, frame = stamp_and_frame(record.topic, record.data)
                self.stamps.append(stamp)
                self.frames.add(frame)
            except BagError:
                self.unreadable += 1
        if self.channel is not None and not self.known:
            try:
                recording.convert(record, self.channel).decode()
                self.known, self.problem = True, ""
            except (UnfitError, BagError) as error:
                self._refuse(error.problem if isinstance(error, BagError) else error)

    def _refuse(self, why: object) -> None:
        """Keep why the first message of a topic of ours cannot be used, until one can."""
        if self.channel is not None and not self.known:
            self.problem = self.problem or f"none of the messages on {self.topic} can be used: {why}"

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


def inspect_bag(bag: Bag, dish_frame: str, progress: Callable[[float], None] = lambda fraction: None) -> dict[str, Any]:
    """Read all messages of a bag and return a report on its content in SI units; null where there is no value.

    Args:
        bag: to inspect.
        dish_frame: name of the dish frame in the bag.
        progress: called with the completed fraction, 0 to 1.
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
        "damage": None if bag.damage is None else _damage(bag.damage),
        "topics": [topic.to_json() for topic in topics.values()],
    }


def _damage(damage: DamageReport) -> dict[str, Any]:
    places = [
        {
            "file": region.file,
            "start_byte": region.start,
            "end_byte": region.end,
            "what": region.what,
            "text": str(region),
            "first_s": None if region.first is None else region.first * 1e-9,
            "last_s": None if region.last is None else region.last * 1e-9,
        }
        for region in damage.regions
    ]
    lost = {"chunks_lost": damage.chunks, "bytes_lost": damage.bytes, "messages_lost": damage.messages}
    return {"text": str(damage), **lost, "places": places}


@dataclass
class RepairReport:
    """What became of a bag.

    Attributes:
        messages: that the new bag holds.
        refused: messages that it does not, by reason.
        dropped: other records that it does not, by kind.
        unpacked: messages that the recorder had packed one by one, and that are not in the new bag.
        defined: types that had no definition, and have ours.
        rewritten: topics whose quality of service is written by name, as Jazzy reads it.
    """

    messages: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    unpacked: int = 0
    defined: list[str] = field(default_factory=list)
    rewritten: list[str] = field(default_factory=list)

    @property
    def is_same(self) -> bool:
        """Return whether the new bag holds everything, as it was."""
        return not (self.refused or self.dropped or self.unpacked or self.defined or self.rewritten)


def write_repaired_bag(
    bag: Bag, folder: Path, name: str, progress: Callable[[float], None] = lambda fraction: None
) -> RepairReport:
    """Write every message of a bag that can be vouched for into a new one, with its notes and definitions.

    The bytes of messages and definitions stay as they are; so do times and numbers of messages, and entries of others
    in metadata.yaml. Messages that the recorder packed one by one are unpacked, and topics have their remapped names.
    Types keep the definitions of the bag; ours is written where it has none and we know the type. Chunks, indices,
    statistics and metadata.yaml are made anew. Attachments and metadata records of others are counted and not kept.

    Args:
        bag: the bag to repair.
        folder: of the new one; must be empty.
        name: of the new one.
        progress: called with the completed fraction, 0 to 1.

    Raises:
        BagError: the new bag cannot be written.
    """
    notes = dict(bag.notes)
    if bag.has_no_checksum and not bag.salvaged_without_checksum:
        notes.setdefault(NO_CHECKSUM_NOTE, f"made by `bag repair` from a bag that {bag.has_no_checksum}")
    report = RepairReport(dropped=bag.others)
    numbers: dict[Connection, int] = {}
    with BagWriter(folder, notes, name=name, custom_data=bag.custom_data) as writer:
        for connection in dict.fromkeys(bag.connections()):
            numbers[connection] = writer.add_connection(_defined(bag, connection, report))
        for item in bag.stored():
            try:
                if item.time > MAX_TIME:
                    raise BagError(bag.name_of(item.connection), "a time that cannot be")
                data = bag.load(item)
            except BagError as error:
                report.refused[str(error)] += 1
                continue
            writer.write_to(
                numbers[item.connection], item.time, data, publish_time=item.publish_time, sequence=item.sequence
            )
            report.messages += 1
            report.unpacked += data is not item.data
            progress((item.time - bag.start) / max(bag.end - bag.start, 1))
    return report


def _defined(bag: Bag, connection: Connection, report: RepairReport) -> Connection:
    """Return a connection as it is written to the new bag."""
    definition = connection.definition
    if not definition.text and connection.serialization == CDR:
        own = own_definition(definition.type_name)
        if own.text:
            definition = own
            report.defined.append(own.type_name)
    profiles = connection.metadata.get(QOS, "")
    if jazzy_qos_profiles(profiles) != profiles:
        report.rewritten.append(bag.name_of(connection))
    return replace(connection, topic=bag.name_of(connection), definition=definition)
