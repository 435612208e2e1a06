"""Writes mcap bags that other tools open and in which damage is found."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any

import yaml
from mcap.writer import CompressionType, Writer

from magnetosuture_thread.bags.types import typestore
from magnetosuture_thread.errors import BagError

CHUNK_SIZE = 256 * 1024
FORMAT_VERSION = 9  # of rosbag2's metadata.yaml
NOTES = "magnetosuture"  # name of the mcap record that holds our notes


class BagWriter:
    """A bag being written: a folder with one mcap file and its metadata.yaml.

    Small chunks with checksums, so that damage to a message is found and what is intact can be recovered; full
    message definitions and type hashes, so that any tool can decode it.

    Args:
        folder: made by the writer if there is none; must be empty.
        notes: words about the bag, kept in it, for example the set-up it was recorded with.
        name: of the bag; the folder's if empty.

    Raises:
        BagError: the folder is not empty or cannot be written.
    """

    def __init__(self, folder: Path, notes: dict[str, str] | None = None, *, name: str = "") -> None:
        self.folder = folder
        self._file_name = f"{name or folder.name}_0.mcap"
        self._notes = notes or {}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if any(folder.iterdir()):
                raise BagError(folder, "is not empty; a bag is written to a new folder")
            self._stream = (folder / self._file_name).open("wb")
        except OSError as error:
            raise BagError(folder, f"cannot be written: {error.strerror}") from None
        self._writer = Writer(
            self._stream, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD, enable_data_crcs=True
        )
        self._writer.start(profile="ros2", library="magnetosuture_thread")
        self._channels: dict[str, int] = {}
        self._types: dict[str, str] = {}
        self._counts: dict[str, int] = {}
        self._first: int | None = None
        self._last = 0

    def __enter__(self) -> BagWriter:
        """Use the writer in a with statement, which closes it."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the bag, so that what was written can be read whatever happened."""
        self.close()

    def add_topic(self, topic: str, type_name: str) -> None:
        """Say of which type a topic is, for example `nav_msgs/msg/Path`."""
        store = typestore()
        definition, _ = store.generate_msgdef(type_name, ros_version=2)
        schema = self._writer.register_schema(type_name, "ros2msg", definition.encode())
        self._channels[topic] = self._writer.register_channel(
            topic, "cdr", schema, {"offered_qos_profiles": "", "topic_type_hash": store.hash_rihs01(type_name)}
        )
        self._types[topic] = type_name
        self._counts[topic] = 0

    def write(self, topic: str, time: int, data: bytes) -> None:
        """Write one serialised message.

        Args:
            topic: one that was added.
            time: when it was received [ns].
            data: CDR bytes.
        """
        self._writer.add_message(
            self._channels[topic], log_time=time, publish_time=time, data=data, sequence=self._counts[topic]
        )
        self._counts[topic] += 1
        self._first = time if self._first is None else min(self._first, time)
        self._last = max(self._last, time)

    def write_message(self, topic: str, time: int, message: Any) -> None:
        """Serialise a message of the type store and write it."""
        self.write(topic, time, bytes(typestore().serialize_cdr(message, self._types[topic])))

    def close(self) -> None:
        """Finish the file and write metadata.yaml; a second call does nothing."""
        if self._stream.closed:
            return
        information = self._information()
        if self._notes:
            self._writer.add_metadata(NOTES, self._notes)
        self._writer.add_metadata("rosbag2", {"serialized_metadata": yaml.safe_dump(information, sort_keys=False)})
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()
        text = yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False)
        (self.folder / "metadata.yaml").write_text(text, encoding="utf-8")

    def _information(self) -> dict[str, Any]:
        start = self._first or 0
        duration = {"nanoseconds": self._last - start}
        count = sum(self._counts.values())
        store = typestore()
        topics = [
            {
                "topic_metadata": {
                    "name": topic,
                    "type": type_name,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [],
                    "type_description_hash": store.hash_rihs01(type_name),
                },
                "message_count": self._counts[topic],
            }
            for topic, type_name in self._types.items()
        ]
        starting = {"nanoseconds_since_epoch": start}
        return {
            "version": FORMAT_VERSION,
            "storage_identifier": "mcap",
            "duration": duration,
            "starting_time": starting,
            "message_count": count,
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self._file_name],
            "files": [
                {"path": self._file_name, "starting_time": starting, "duration": duration, "message_count": count}
            ],
            "custom_data": {f"{NOTES}.{key}": value for key, value in self._notes.items()},
            "ros_distro": "jazzy",
        }
