"""Writes and repairs bags: mcap in small chunks, by the package `mcap`, readable after a crash or on a full disk.

Messages are written by a worker, which no signal interrupts: the file stays whole whatever stops a recorder, and the
callback that a message came by does not wait for the disk.

Source: the MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import errno
import os
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from time import sleep
from typing import TYPE_CHECKING, Any

import yaml
from mcap.writer import Writer

from magnetosuture_thread.bags import storage
from magnetosuture_thread.bags.message_types import own_definition, typestore
from magnetosuture_thread.bags.storage import CDR, QOS, TYPE_HASH, Connection, MessageDefinition, pluralize
from magnetosuture_thread.settings.errors import BagError, RecordingEndedError

if TYPE_CHECKING:
    from magnetosuture_thread.bags.reader import Bag

MAX_TIME = (1 << 64) - 1  # ns, the range of mcap

Message = tuple[int, int, bytes, int, int]  # arguments of `mcap.writer.Writer.add_message`


class BagWriter:
    """A bag being written: a folder with one mcap file and its metadata.yaml.

    Chunks are small and have checksums, so that damage is detected and intact messages can be salvaged. The bag holds
    full message definitions and type hashes, so that any tool can decode it. A recorder that is killed loses two
    seconds. When the disk is full, the bag ends with the last complete chunk, and is reported as truncated.

    Args:
        folder: made by the writer if there is none; must be empty.
        notes: entries kept in the bag, for example the setup it was recorded with.
        name: of the bag; the folder's if empty.
        custom_data: entries of others in metadata.yaml.

    Raises:
        BagError: the folder is not empty or cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        notes: Mapping[str, str] | None = None,
        *,
        name: str = "",
        custom_data: Mapping[str, str] | None = None,
    ) -> None:
        self.folder = folder
        self._file = folder / f"{name or folder.name}_0.mcap"
        self._notes, self._custom_data = storage.add_checksum(notes) if notes else {}, dict(custom_data or {})
        self._topics: dict[str, int] = {}
        self._connections: list[Connection] = []
        self._sequences: Counter[int] = Counter()
        self._pending: list[Message] = []
        self._bytes, self._first, self._last = 0, MAX_TIME, 0  # of the pending messages
        self._defined = 0  # connections when the last chunk was begun
        self._handed = 0  # chunks that the worker was given
        self._closed = False
        # What follows is of the worker.
        self._taken = 0  # chunks that are done with
        self._schemas: dict[MessageDefinition, int] = {MessageDefinition(""): 0}
        self._registered = 0  # connections that the file has
        self._counts: Counter[int] = Counter()
        self._start, self._end = MAX_TIME, 0
        self._problem: Exception | None = None
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if any(folder.iterdir()):
                raise BagError(folder, "is not empty; a bag is written to a new folder")
            self._stream = self._file.open("wb")
            # Chunks end by `flush` alone.
            self._mcap: Any = Writer(self._stream, chunk_size=MAX_TIME, enable_data_crcs=True)
            self._mcap.start("ros2", "magnetosuture_thread")
            if self._notes:  # at the head of the file, where truncation leaves them
                self._mcap.add_metadata(storage.NOTES, self._notes)
            self._mcap.flush()  # type: ignore[no-untyped-call]
        except OSError as error:
            with suppress(OSError):
                self._file.unlink()  # of no use, but in the way of the next attempt
            raise BagError(folder, f"cannot be written: {error.strerror}") from None
        self._size = self._stream.tell()
        # Not an executor: its locks are Python's, which an interrupt can leave held for ever.
        self._chunks: SimpleQueue[tuple[int, list[Message]] | None] = SimpleQueue()  # connections, and messages
        self._worker = Thread(target=self._work, name="bag_writer", daemon=True)  # nobody waits for one left open
        self._worker.start()

    def __enter__(self) -> BagWriter:
        """Use the writer in a with statement, which closes it."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the bag, so that what was written can be read whatever happened."""
        self.close()

    def add_topic(self, topic: str, type_name: str, definition: MessageDefinition | None = None) -> None:
        """Add a topic of a type, for example `nav_msgs/msg/Path`.

        Args:
            topic: with its leading slash.
            type_name: of its messages.
            definition: of the type; ours if None.

        Raises:
            BagError: the type is unknown, and no definition is given.
        """
        ours = own_definition(type_name)
        definition = definition or ours
        if not definition.text:
            raise BagError(topic, f"the type {type_name} has no definition")
        type_hash = typestore().hash_rihs01(type_name) if definition == ours else ""
        connection = Connection(topic, definition, metadata={QOS: "", TYPE_HASH: type_hash})
        self._topics[topic] = self.add_connection(connection)

    def add_connection(self, connection: Connection) -> int:
        """Add a connection, and return its number for `write_to`."""
        metadata = dict(connection.metadata)
        if QOS in metadata:
            metadata[QOS] = storage.jazzy_qos_profiles(metadata[QOS])
        self._connections.append(replace(connection, metadata=metadata))
        return len(self._connections)

    def write(self, topic: str, time: int, data: bytes) -> None:
        """Write one serialised message.

        Args:
            topic: one that was added.
            time: when it was received [ns].
            data: CDR bytes.

        Raises:
            RecordingEndedError: the disk is full, or fails. The bag is closed, and what was written before can be read.
        """
        self.write_to(self._topics[topic], time, data)

    def write_to(
        self, number: int, time: int, data: bytes, *, publish_time: int | None = None, sequence: int | None = None
    ) -> None:
        """Write one serialised message of a connection, with its own publish time and sequence number if it has any.

        Otherwise as `write`.
        """
        published = time if publish_time is None else publish_time
        for each in (time, published):
            if not 0 <= each <= MAX_TIME:
                topic = self._connections[number - 1].topic
                raise BagError(topic, f"a message of the time {each} ns; expected 0 to {MAX_TIME}")
        if self._closed:
            raise BagError(self.folder, "is closed; nothing more can be written to it")
        sequence = self._sequences[number] if sequence is None else sequence
        self._pending.append((number, time, data, published, sequence))
        self._sequences[number] = (sequence + 1) & 0xFFFFFFFF
        self._bytes += len(data)
        self._first, self._last = min(self._first, time), max(self._last, time)
        # Bytes, uncompressed; or ns from first to last message, which are lost if the recorder is killed.
        is_full = self._bytes > 256 * 1024 or self._last - self._first > 2_000_000_000
        # Without the definition of its topic a message is lost: it comes in a chunk that is too small to be hit.
        if is_full or number > self._defined:
            while self._handed > self._taken:  # so that at most two chunks wait for the disk
                sleep(0.001)
            if self._problem is not None:
                self.close()
            self._defined = len(self._connections)
            self._chunks.put((self._defined, self._pending))
            self._handed += 1
            self._pending, self._bytes, self._first, self._last = [], 0, MAX_TIME, 0

    def write_message(self, topic: str, time: int, message: Any) -> None:
        """Serialise a message of the type store and write it; otherwise as `write`."""
        type_name = self._connections[self._topics[topic] - 1].type_name
        self.write(topic, time, bytes(typestore().serialize_cdr(message, type_name)))

    def close(self) -> None:
        """Finish the file and write metadata.yaml; a second call does nothing.

        Raises:
            RecordingEndedError: the disk is full, or fails; what was written before can be read.
        """
        if self._closed:
            return
        self._chunks.put((len(self._connections), self._pending))
        self._chunks.put(None)
        self._closed = True
        try:
            self._worker.join()
        finally:  # also of an interrupt in that time, which is short
            self._worker.join()
        if isinstance(self._problem, OSError):
            kept = pluralize(self._counts.total(), "message")
            texts = {errno.ENOSPC: "is full", errno.EDQUOT: "is full (quota)", errno.EFBIG: "takes no larger file"}
            what = texts.get(self._problem.errno or 0, f"fails ({self._problem.strerror})")
            raise RecordingEndedError(self.folder, f"the disk {what} after {kept}", self._file) from None
        if self._problem is not None:
            raise self._problem

    def _work(self) -> None:
        """Write chunks until there are no more, then what ends the file."""
        chunk: tuple[int, list[Message]] | None = (0, [])
        while chunk is not None:
            chunk = self._chunks.get()
            try:
                self._finish() if chunk is None else self._write_chunk(*chunk)
            except Exception as error:  # raised by `close`
                self._problem = error
            self._taken += 1

    def _write_chunk(self, connections: int, pending: list[Message]) -> None:
        """Write messages as a chunk, and take them from the list: it may come again where its owner was interrupted.

        The connections that are written with it are those that were known then, so that the same calls give the same
        bytes.
        """
        messages = pending[:]
        del pending[: len(messages)]
        if isinstance(self._problem, OSError) or not messages:
            return
        try:
            self._register(connections)
            for message in messages:
                self._mcap.add_message(*message)
            self._mcap.flush()
            self._size = self._stream.tell()
        except OSError as error:
            self._fail(error)
            return
        self._counts.update(message[0] for message in messages)
        times = [message[1] for message in messages]
        self._start, self._end = min(self._start, *times), max(self._end, *times)

    def _register(self, count: int) -> None:
        """Write the first connections, up to a count, that are not in the file yet."""
        for connection in self._connections[self._registered : count]:
            definition = connection.definition
            if definition not in self._schemas:
                text = definition.text.encode("utf-8", "surrogateescape")
                self._schemas[definition] = self._mcap.register_schema(definition.type_name, definition.encoding, text)
            schema, metadata = self._schemas[definition], dict(connection.metadata)
            self._mcap.register_channel(connection.topic, connection.serialization, schema, metadata)
            self._registered += 1

    def _finish(self) -> None:
        """Write the summary and metadata.yaml."""
        if isinstance(self._problem, OSError):
            return
        metadata = self.folder / storage.METADATA_FILE
        try:
            self._register(len(self._connections))
            information = self._information()
            self._mcap.add_metadata("rosbag2", {"serialized_metadata": yaml.safe_dump(information, sort_keys=False)})
            self._mcap.finish()
            self._stream.flush()
            os.fsync(self._stream.fileno())
            self._size = self._stream.tell()
            self._stream.close()
            with metadata.open("w", encoding="utf-8") as stream:
                yaml.safe_dump({"rosbag2_bagfile_information": information}, stream, sort_keys=False)
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            self._fail(error)
            with suppress(OSError):  # most often there is none
                metadata.unlink()  # a part of it would be refused, where readers do without it

    def _fail(self, problem: OSError) -> None:
        """End the file with the last complete chunk."""
        self._problem = problem
        with suppress(OSError):
            self._stream.close()  # which tries to write the rest
        os.truncate(self._file, self._size)

    def _information(self) -> dict[str, Any]:
        """Return the content of metadata.yaml."""
        start = self._start if self._counts else 0
        notes = {f"{storage.NOTES}.{key}": text for key, text in self._notes.items()}
        times = {"starting_time": {"nanoseconds_since_epoch": start}, "duration": {"nanoseconds": self._end - start}}
        count = self._counts.total()
        topics = []
        for number, connection in enumerate(self._connections, 1):
            topic = {
                "name": connection.topic,
                "type": connection.type_name,
                "serialization_format": connection.serialization,
                "offered_qos_profiles": storage.parse_qos_profiles(connection.metadata.get(QOS, "")),
                "type_description_hash": connection.metadata.get(TYPE_HASH, ""),
            }
            topics.append({"topic_metadata": topic, "message_count": self._counts[number]})
        return {
            "version": 9,  # of the format of metadata.yaml
            "storage_identifier": "mcap",
            **times,
            "message_count": count,
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self._file.name],
            "files": [{"path": self._file.name, **deepcopy(times), "message_count": count}],  # YAML would write aliases
            "custom_data": {**self._custom_data, **notes},
            "ros_distro": "jazzy",
        }


@dataclass
class RepairReport:
    """Counts of what a repaired bag holds, lacks, and holds otherwise.

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
    bag: Bag, folder: Path, name: str, progress: Callable[[float], None] = lambda share: None
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
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: the new bag cannot be written.
    """
    notes = dict(bag.notes)
    if bag.has_no_checksum and not bag.salvaged_without_checksum:
        notes.setdefault(storage.NO_CHECKSUM_NOTE, f"made by `bag repair` from a bag that {bag.has_no_checksum}")
    report = RepairReport(dropped=bag.others)
    with BagWriter(folder, notes, name=name, custom_data=bag.custom_data) as writer:
        connections = dict.fromkeys(bag.connections())
        numbers = {old: writer.add_connection(_repaired_connection(bag, old, report)) for old in connections}
        for item in bag.stored():
            try:
                if item.time > MAX_TIME:
                    raise BagError(bag.name_of(item.connection), "a time that cannot be")
                data = bag.load(item)
            except BagError as error:
                report.refused[str(error)] += 1
                continue
            number, publish_time, sequence = numbers[item.connection], item.publish_time, item.sequence
            writer.write_to(number, item.time, data, publish_time=publish_time, sequence=sequence)
            report.messages += 1
            report.unpacked += data is not item.data
            progress((item.time - bag.start) / max(bag.end - bag.start, 1))
    return report


def _repaired_connection(bag: Bag, connection: Connection, report: RepairReport) -> Connection:
    """Return a connection as it is in the new bag: under its remapped name, with our definition where it has none."""
    definition = connection.definition
    if not definition.text and connection.serialization == CDR:
        ours = own_definition(definition.type_name)
        if ours.text:
            definition = ours
            report.defined.append(ours.type_name)
    profiles = connection.metadata.get(QOS, "")
    if storage.jazzy_qos_profiles(profiles) != profiles:
        report.rewritten.append(bag.name_of(connection))
    return replace(connection, topic=bag.name_of(connection), definition=definition)
