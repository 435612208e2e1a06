"""Writes mcap bags that stay readable after a crash or on a full disk."""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml
from mcap.records import Attachment, Metadata

from magnetosuture_thread.bags.bag_folder import (
    METADATA_FILE,
    NOTES,
    QOS,
    TYPE_HASH,
    add_checksum,
    bag_information,
    jazzy_qos_profiles,
    marked,
)
from magnetosuture_thread.bags.mcap.writer import MAX_INDEX_BYTES, McapWriter
from magnetosuture_thread.bags.message_types import own_definition, typestore
from magnetosuture_thread.bags.storage import ROS2_PROFILE, Connection, MessageDefinition, pluralize
from magnetosuture_thread.errors import BagError

MAX_TIME = (1 << 64) - 1  # ns, the range of mcap
DISK_FULL_TEXTS = {errno.ENOSPC: "is full", errno.EDQUOT: "is full (quota)", errno.EFBIG: "takes no larger file"}
_RESERVE_BYTES = 256 * 1024  # for summary and metadata.yaml, besides the index of each chunk


class RecordingEndedError(BagError):
    """The disk is full, or fails; what was recorded before can be read.

    Args:
        folder: of the bag.
        cause: what ended it.
        file: that holds what was recorded before.
    """

    def __init__(self, folder: Path, cause: str, file: Path) -> None:
        self.cause, self.file = cause, file
        super().__init__(folder, f"{cause}; what was recorded before can be read: {file}")


class BagWriter:
    """A bag being written: a folder with one mcap file and its metadata.yaml.

    Chunks are small and have checksums, so that damage is detected and intact messages can be salvaged. The bag holds
    full message definitions and type hashes, so that any tool can decode it. A recorder that is killed loses two
    seconds. When the disk is full, the bag is finished in disk space that was reserved for this.

    Args:
        folder: made by the writer if there is none; must be empty.
        notes: entries kept in the bag, for example the setup it was recorded with.
        name: of the bag; the folder's if empty.
        profile: which conventions it follows, as mcap names them.
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
        profile: str = ROS2_PROFILE,
        custom_data: Mapping[str, str] | None = None,
    ) -> None:
        self.folder = folder
        self._custom_data = dict(custom_data or {})
        self._file_name = f"{name or folder.name}_0.mcap"
        self._notes = dict(notes or {})
        self._topics: dict[str, int] = {}
        self._connections: dict[int, Connection] = {}
        self._closed = False
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if any(folder.iterdir()):
                raise BagError(folder, "is not empty; a bag is written to a new folder")
            self._stream = (folder / self._file_name).open("wb", buffering=0)
        except OSError as error:
            raise BagError(folder, f"cannot be written: {error.strerror}") from None
        try:
            self._writer = McapWriter(self._stream, {NOTES: add_checksum(self._notes)} if self._notes else {}, profile)
            self._reserve = _DiskReserve(folder / ".reserve")
            self._reserve.grow(_RESERVE_BYTES)
        except OSError as error:
            self._stream.close()
            for name in (".reserve", self._file_name):
                (folder / name).unlink(missing_ok=True)  # of no use, but in the way of the next attempt
            raise BagError(folder, f"cannot be written: {error.strerror}") from None

    def __enter__(self) -> BagWriter:
        """Use the writer in a with statement, which closes it."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
        if definition is None:
            definition = own_definition(type_name)
            if not definition.text:
                raise BagError(topic, f"the type {type_name} has no definition")
        metadata = {QOS: "", TYPE_HASH: _type_hash(definition)}
        self._topics[topic] = self.add_connection(Connection(topic, definition, metadata=metadata))

    def add_connection(self, connection: Connection) -> int:
        """Add a connection, and return its number for `write_to`."""
        if QOS in connection.metadata:
            profiles = jazzy_qos_profiles(connection.metadata[QOS])
            connection = replace(connection, metadata={**connection.metadata, QOS: profiles})
        connection = marked(connection, self._notes)
        number = self._writer.add_channel(connection)
        self._connections[number] = connection
        return number

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
        if not 0 <= time <= MAX_TIME:
            raise BagError(
                self._connections[number].topic, f"a message of the time {time} ns; expected 0 to {MAX_TIME}"
            )
        if self._closed:
            raise BagError(self.folder, "is closed; nothing more can be written to it")
        try:
            if self._writer.add_message(number, time, data, publish_time=publish_time, sequence=sequence):
                self._reserve.grow(_RESERVE_BYTES + MAX_INDEX_BYTES * self._writer.state.chunks)
        except OSError as error:
            self._end(error)

    def add_extra(self, extra: Attachment | Metadata) -> None:
        """Write an attachment or a metadata record; before the first message.

        Raises:
            RecordingEndedError: as `write`.
        """
        try:
            if isinstance(extra, Metadata):
                self._writer.add_metadata(extra.name, extra.metadata)
            else:
                self._writer.add_attachment(extra)
        except OSError as error:
            self._end(error)

    def write_message(self, topic: str, time: int, message: Any) -> None:
        """Serialise a message of the type store and write it; otherwise as `write`."""
        type_name = self._connections[self._topics[topic]].type_name
        self.write(topic, time, bytes(typestore().serialize_cdr(message, type_name)))

    def close(self) -> None:
        """Finish the file and write metadata.yaml; a second call does nothing.

        Raises:
            RecordingEndedError: the disk is full, or fails; what was written before can be read.
        """
        if self._closed:
            return
        problem: OSError | None = None
        try:
            self._writer.flush()
        except OSError as error:
            problem = error
        self._end(problem)

    def _end(self, problem: OSError | None) -> None:
        """Finish the bag with what is on the disk, if there is space for its summary; raise what ended it early."""
        self._closed = True
        self._reserve.release()
        try:
            self._finish()
        except OSError as error:
            self._writer.abandon()
            problem = problem or error
        if problem is not None:
            raise self._refusal(problem) from None

    def _refusal(self, problem: OSError) -> RecordingEndedError:
        kept = pluralize(self._writer.state.counts.total(), "message")
        what = DISK_FULL_TEXTS.get(problem.errno or 0, f"fails ({problem.strerror})")
        return RecordingEndedError(self.folder, f"the disk {what} after {kept}", self.folder / self._file_name)

    def _finish(self) -> None:
        state, custom = self._writer.state, self._custom_data
        information = bag_information(self._file_name, state, self._connections, self._notes, custom)
        self._writer.finish({"rosbag2": {"serialized_metadata": yaml.safe_dump(information, sort_keys=False)}})
        text = yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False)
        with (self.folder / METADATA_FILE).open("w", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())


def _type_hash(definition: MessageDefinition) -> str:
    """Return the RIHS01 hash of a type, where its definition is ours."""
    if definition != own_definition(definition.type_name) or not definition.text:
        return ""
    return typestore().hash_rihs01(definition.type_name)


class _DiskReserve:
    """A file that reserves disk space for finishing the bag when the disk is full.

    Args:
        path: the file; created by `grow`, deleted by `release`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._size = 0

    def grow(self, size: int) -> None:
        """Reserve at least this many bytes.

        Raises:
            OSError: the disk has no more space.
        """
        if size <= self._size:
            return
        size = 2 * size  # so that it grows rarely
        with self._path.open("ab") as stream:
            os.posix_fallocate(stream.fileno(), 0, size)
        self._size = size

    def release(self) -> None:
        """Free the reserved space."""
        self._path.unlink(missing_ok=True)
