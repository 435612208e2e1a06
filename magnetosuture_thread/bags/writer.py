"""Writes mcap bags that other tools open, in which damage is found, and that stay readable whatever ends them."""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import yaml

from magnetosuture_thread.bags.damage import counted
from magnetosuture_thread.bags.mcap.writing import INDEX_SIZE, McapWriter
from magnetosuture_thread.bags.notes import NOTES, as_custom_data, sealed
from magnetosuture_thread.bags.qos import OFFERED, in_words, profiles
from magnetosuture_thread.bags.reserve import Reserve
from magnetosuture_thread.bags.storage import Connection, Definition
from magnetosuture_thread.bags.types import typestore
from magnetosuture_thread.errors import BagError

FORMAT_VERSION = 9  # of rosbag2's metadata.yaml
LATEST = (1 << 64) - 1  # ns, that mcap has room for
FULL = {errno.ENOSPC: "is full", errno.EDQUOT: "is full (quota)", errno.EFBIG: "takes no larger file"}
_SPARE = 256 * 1024  # bytes kept free for summary and metadata.yaml, besides what each chunk needs there


class RecordingEndedError(BagError):
    """The disk is full, or fails; what was recorded before can be read."""


class BagWriter:
    """A bag being written: a folder with one mcap file and its metadata.yaml.

    Small chunks with checksums, so that damage to a message is found and what is intact can be recovered; full
    message definitions and type hashes, so that any tool can decode it. Chunks go to the disk as they are full: a
    recorder that is killed loses two seconds. When the disk is full, what was recorded before is finished as a
    whole bag, in room that was kept for that.

    Args:
        folder: made by the writer if there is none; must be empty.
        notes: words about the bag, kept in it, for example the set-up it was recorded with.
        name: of the bag; the folder's if empty.

    Raises:
        BagError: the folder is not empty or cannot be written.
    """

    def __init__(self, folder: Path, notes: Mapping[str, str] | None = None, *, name: str = "") -> None:
        self.folder = folder
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
            self._writer = McapWriter(self._stream, {NOTES: sealed(self._notes)} if self._notes else {})
            self._reserve = Reserve(folder / ".reserve")
            self._reserve.grow(_SPARE)
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

    def add_topic(self, topic: str, type_name: str, definition: Definition | None = None) -> None:
        """Say of which type a topic is, for example `nav_msgs/msg/Path`.

        Args:
            topic: with its leading slash.
            type_name: of its messages.
            definition: of the type; ours if None.

        Raises:
            BagError: we do not know the type, and no definition is given.
        """
        if definition is None:
            definition = our_definition(type_name)
            if not definition.text:
                raise BagError(topic, f"nothing defines the type {type_name}")
        offered = {OFFERED: "", "topic_type_hash": _type_hash(definition)}
        self._topics[topic] = self.add_connection(Connection(topic, definition, offered=offered))

    def add_connection(self, connection: Connection) -> int:
        """Say what one publisher says on a topic, and return its number for `write_to`."""
        if OFFERED in connection.offered:
            words = {**connection.offered, OFFERED: in_words(profiles(connection.offered[OFFERED]))}
            connection = replace(connection, offered=words)
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

    def write_to(self, number: int, time: int, data: bytes) -> None:
        """Write one serialised message of a connection; otherwise as `write`."""
        if not 0 <= time <= LATEST:
            raise BagError(self._connections[number].topic, f"a message of the time {time} ns; expected 0 to {LATEST}")
        if self._closed:
            raise BagError(self.folder, "is closed; nothing more can be written to it")
        try:
            if self._writer.add_message(number, time, data):
                self._reserve.grow(_SPARE + INDEX_SIZE * self._writer.chunks)
        except OSError as error:
            raise self._end_early(error) from None

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
        try:
            self._writer.flush()
        except OSError as error:
            raise self._end_early(error) from None
        self._closed = True
        self._reserve.release()
        try:
            self._finish()
        except OSError as error:
            self._writer.abandon()
            raise self._refusal(error) from None

    def _end_early(self, problem: OSError) -> RecordingEndedError:
        """Make a whole bag of what is on the disk, if there is room for its summary; return what to raise."""
        self._closed = True
        self._reserve.release()
        try:
            self._finish()
        except OSError:
            self._writer.abandon()
        return self._refusal(problem)

    def _refusal(self, problem: OSError) -> RecordingEndedError:
        kept = counted(self._writer.counts.total(), "message")
        what = FULL.get(problem.errno or 0, f"fails ({problem.strerror})")
        file = self.folder / self._file_name
        text = f"the disk {what} after {kept}; what was recorded before can be read: {file}"
        return RecordingEndedError(self.folder, text)

    def _finish(self) -> None:
        information = self._information()
        inside = {"serialized_metadata": yaml.safe_dump(information, sort_keys=False)}
        self._writer.finish({"rosbag2": inside})
        text = yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False)
        with (self.folder / "metadata.yaml").open("w", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())

    def _information(self) -> dict[str, Any]:
        counts = self._writer.counts
        start = self._writer.start or 0
        duration = self._writer.end - start
        topics = [
            {
                "topic_metadata": {
                    "name": connection.topic,
                    "type": connection.type_name,
                    "serialization_format": connection.serialization,
                    "offered_qos_profiles": profiles(connection.offered.get(OFFERED, "")),
                    "type_description_hash": connection.offered.get("topic_type_hash", ""),
                },
                "message_count": counts[number],
            }
            for number, connection in self._connections.items()
        ]
        file = {
            "path": self._file_name,
            "starting_time": {"nanoseconds_since_epoch": start},
            "duration": {"nanoseconds": duration},
            "message_count": counts.total(),
        }
        return {
            "version": FORMAT_VERSION,
            "storage_identifier": "mcap",
            "duration": {"nanoseconds": duration},
            "starting_time": {"nanoseconds_since_epoch": start},
            "message_count": counts.total(),
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self._file_name],
            "files": [file],
            "custom_data": as_custom_data(self._notes),
            "ros_distro": "jazzy",
        }


def our_definition(type_name: str) -> Definition:
    """Return our definition of a type; without a text if we have none."""
    store = typestore()
    if type_name not in store.fielddefs:
        return Definition(type_name)
    return Definition(type_name, "ros2msg", store.generate_msgdef(type_name, ros_version=2)[0])


def _type_hash(definition: Definition) -> str:
    """Return the hash of a type, by ROS's rule, where its definition is ours."""
    if definition != our_definition(definition.type_name) or not definition.text:
        return ""
    return typestore().hash_rihs01(definition.type_name)
