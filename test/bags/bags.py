"""Bags that the tests of this folder make."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import mcap.records
import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter

from magnetosuture_thread.bags.message_types import own_definition, typestore
from magnetosuture_thread.bags.packing import packed_scene
from magnetosuture_thread.bags.reader import Bag, RecordedMessage
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.settings.interface import SCENE, Channel

HEADER = "std_msgs/msg/Header"
STRING = "std_msgs/msg/String"
IMAGE = "sensor_msgs/msg/CompressedImage"
SECOND = 10**9

Message = tuple[str, int, bytes]


def make(name: str, /, *values: Any, **fields: Any) -> Any:
    """Return a message of our type store; fields that are not given are zero, or empty."""
    kinds = typestore().fielddefs[name][1]
    fields |= dict(zip((field for field, _ in kinds), values, strict=False))
    return typestore().types[name](
        **{field: fields[field] if field in fields else _zero(kind) for field, kind in kinds}
    )


def _zero(kind: Any) -> Any:
    """Return what a field of a kind, as rosbags describes it, holds at first."""
    node, detail = kind
    if node is Nodetype.NAME:
        return make(detail, w=1.0) if detail == "geometry_msgs/msg/Quaternion" else make(detail)
    if node is Nodetype.BASE:
        return {"string": "", "bool": False}.get(detail[0], 0.0 if detail[0].startswith("float") else 0)
    (inner, element), count = detail
    count = count if node is Nodetype.ARRAY else 0
    if inner is Nodetype.BASE and element[0] != "string":
        return np.zeros(count, element[0])
    return [_zero((inner, element)) for _ in range(count)]


def stamped(index: int, frame: str = "dish") -> Any:
    """Return a header with a stamp of so many seconds."""
    return make(HEADER, make("builtin_interfaces/msg/Time", index, 0), frame)


def cdr(name: str, *fields: Any) -> bytes:
    """Return a message as bytes."""
    return bytes(typestore().serialize_cdr(make(name, *fields), name))


def write_many_chunks(folder: Path, chunks: int = 40) -> Path:
    """Write a bag of several topics in several dozens of chunks, and return its mcap file."""
    noise = np.random.default_rng(4)
    with BagWriter(folder, {"setup": "example", "simulated": "all of it"}) as bag:
        bag.add_topic("/camera", IMAGE)
        bag.add_topic("/header", HEADER)
        bag.add_topic("/text", STRING)
        for index in range(chunks):
            at = SECOND * (1 + 3 * index)
            for step in range(4):
                picture = noise.integers(0, 256, 300, dtype=np.uint8)
                bag.write_message("/camera", at + step, make(IMAGE, stamped(index), "jpeg", picture))
                bag.write("/header", at + 10 + step, cdr(HEADER, stamped(index).stamp, f"frame {index}.{step}"))
            if index % 3 == 0:
                bag.write("/text", at + 20, cdr(STRING, f"every third {index}"))
    return folder / f"{folder.name}_0.mcap"


def write_mcap(path: Path, messages: list[Message], types: dict[str, str], **options: Any) -> Path:
    """Write an mcap file with the package `mcap`, as any other tool would."""
    with path.open("wb") as stream:
        writer = Writer(stream, **{"compression": CompressionType.NONE, "chunk_size": 1000, **options})
        writer.start("ros2")
        channels = {}
        for topic, name in types.items():
            schema = writer.register_schema(name, "ros2msg", own_definition(name).text.encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for topic, time, data in messages:
            writer.add_message(channels[topic], time, data, time)
        writer.finish()
    return path


def write_rosbag(folder: Path, plugin: StoragePlugin, messages: list[Message], types: dict[str, str]) -> Path:
    """Write a bag with rosbags, as rosbag2 would."""
    with RosbagWriter(folder, version=9, storage_plugin=plugin) as bag:
        connections = {topic: bag.add_connection(topic, name, typestore=typestore()) for topic, name in types.items()}
        for topic, time, data in messages:
            bag.write(connections[topic], time, data)
    return folder


def texts(count: int, topic: str = "/text", start: int = SECOND) -> list[Message]:
    """Return messages of a topic, 10 ms apart."""
    return [(topic, start + index * 10**7, cdr(STRING, f"text {index}")) for index in range(count)]


def read(bag: Bag) -> list[Message]:
    """Return all messages of a bag."""
    return [(record.topic, record.time, record.data) for record in bag.records()]


def chunks_of(path: Path) -> Iterator[tuple[int, int, list[Message]]]:
    """Yield start, end and messages of each chunk of an undamaged file, by the package `mcap`."""
    with path.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        for index in summary.chunk_indexes:
            stream.seek(index.chunk_start_offset + 9)
            records = breakup_chunk(Chunk.read(ReadDataStream(stream)), validate_crc=True)
            messages = [
                (summary.channels[record.channel_id].topic, record.log_time, record.data)
                for record in records
                if isinstance(record, mcap.records.Message)
            ]
            yield index.chunk_start_offset, index.chunk_start_offset + index.chunk_length, messages


def changed(
    bag: Path,
    folder: Path,
    change: Callable[[RecordedMessage, Any], Any] = lambda old, message: message,
    added: Iterable[tuple[Channel, int, Any]] = (),
    notes: Mapping[str, str] | None = None,
) -> Path:
    """Write a bag again.

    Args:
        bag: that is there.
        folder: of the new one.
        change: makes of each message another one; those that come out as None are left out.
        added: further messages, with their channels and times [ns].
        notes: in place of the bag's own.
    """
    source, added = Bag(bag), list(added)
    with BagWriter(folder, source.notes if notes is None else notes) as writer:
        own = {channel.recorded: channel.type_name for channel, _, _ in added}
        for topic, type_name in {**source.topics, **own}.items():
            writer.add_topic(topic, type_name)
        for channel, time, message in added:
            writer.write_message(channel.recorded, time, message)
        for old in source.records(set(source.topics)):
            if (message := change(old, old.decode())) is not None:
                writer.write_message(old.topic, old.time, message)
    return folder


def copy_with_notes(bag: Path, folder: Path, **notes: str) -> None:
    """Copy a bag to a folder, with further notes."""
    changed(bag, folder, notes={**Bag(bag).notes, **notes})


def scene_message(time: int, scene: Scene, version: str = "") -> Any:
    """Return the message of a scene, of its own version unless another is named."""
    message: Any = typestore().deserialize_cdr(packed_scene(time, scene), SCENE.type_name)
    message.version = version or message.version
    return message
