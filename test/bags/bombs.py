"""Files of a few bytes that ask for hours or gigabytes."""

from __future__ import annotations

import sqlite3
import struct
import zlib
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import zstandard
from mcap import records as mcap_records
from mcap.data_stream import RecordBuilder
from mcap.writer import Writer
from rosbags.rosbag2 import StoragePlugin

from test.bags.bags import STRING, cdr, texts, write_mcap, write_rosbag

TOPIC = "/ground_truth/thread"  # one that our graph takes, so that its messages are decoded
PATH = "nav_msgs/msg/Path"


def definition_bomb(path: Path, text: str, encoding: str = "ros2msg") -> Path:
    """Write a bag with a message whose definition is a bomb."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        schema = writer.register_schema(PATH, encoding, text.encode())
        channel = writer.register_channel(TOPIC, "cdr", schema)
        writer.add_message(channel, 1, cdr(STRING, "a"), 1)
        writer.finish()
    return path


def nested(levels: int, first: str = "") -> str:
    """Return a definition of types in types, two of each in the next."""
    parts = [f"a/T{levels} x\n"]
    for level in range(levels, 0, -1):
        inner = f"T{level - 1} x\nT{level - 1} y\n" if level > 1 else first
        parts.append(f"{'=' * 80}\nMSG: a/T{level}\n{inner}")
    return "".join(parts)


def idl(size: str, before: str = "") -> str:
    """Return an IDL definition of a path with an array of some size."""
    return f"module nav_msgs {{ module msg {{ {before} struct Path {{ double x[{size}]; }}; }}; }};"


def chunk_bomb(path: Path, size: int, count: int = 1, record: bytes = b"") -> Path:
    """Write an mcap file of chunks that hold zeros, or a record over and over, when they are unpacked."""
    unit = record or bytes(1 << 16)
    compressor = zstandard.ZstdCompressor(level=1).compressobj(size=size // len(unit) * len(unit))
    compressed, crc = b"", 0
    for _ in range(size // len(unit)):
        crc = zlib.crc32(unit, crc)
        compressed += compressor.compress(unit)
    compressed += compressor.flush()
    builder = RecordBuilder()
    mcap_records.Header("ros2", "bomb").write(builder)
    mcap_records.Schema(id=1, name=STRING, encoding="ros2msg", data=b"string data\n").write(builder)
    mcap_records.Channel(id=1, topic="/text", message_encoding="cdr", metadata={}, schema_id=1).write(builder)
    for _ in range(count):
        mcap_records.Chunk("zstd", compressed, 1, 1, crc, size // len(unit) * len(unit)).write(builder)
    mcap_records.DataEnd(0).write(builder)
    mcap_records.Footer(0, 0, 0).write(builder)
    path.write_bytes(b"\x89MCAP0\r\n" + builder.end() + b"\x89MCAP0\r\n")
    return path


def lone_records(path: Path, *parts: bytes, tail: bytes = b"") -> Path:
    """Write an mcap file with a message, after further records, and before what is no part of it."""
    write_mcap(path, texts(1), {"/text": STRING})
    data = path.read_bytes()
    first = struct.unpack_from("<Q", data, 9)[0] + 17  # where the header ends
    path.write_bytes(data[:first] + b"".join(parts) + data[first:] + tail)
    return path


def encoded(*records: mcap_records.McapRecord) -> bytes:
    """Return records as they are in a file."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


def chunk(data: bytes) -> bytes:
    """Return a chunk of records with its checksum."""
    return encoded(
        mcap_records.Chunk("zstd", zstandard.ZstdCompressor().compress(data), 1, 1, zlib.crc32(data), len(data))
    )


def with_many_entries(record: mcap_records.McapRecord, count: int) -> bytes:
    """Return a record, whose last field is a map without entries, with many: ten times as large in memory as here."""
    digits = np.frombuffer(b"0123456789abcdef", np.uint8)
    entries = np.zeros(count, [("key_size", "<u4"), ("key", "u1", 6), ("value_size", "<u4")])
    entries["key_size"] = 6
    for place in range(6):
        entries["key"][:, place] = digits[np.arange(count) >> 4 * place & 15]
    whole, data = encoded(record), entries.tobytes()
    content = whole[9:-4] + struct.pack("<I", len(data)) + data
    return whole[:1] + struct.pack("<Q", len(content)) + content


def metadata_bomb(folder: Path, text: str) -> Path:
    """Write a bag whose metadata.yaml is a bomb."""
    folder.mkdir()
    write_mcap(folder / "a.mcap", texts(5), {"/text": STRING})
    (folder / "metadata.yaml").write_text(text)
    return folder


def metadata_device(folder: Path, make: Callable[[Path], None]) -> Path:
    """Write a bag whose metadata.yaml is no file."""
    folder.mkdir()
    write_mcap(folder / "a.mcap", texts(5), {"/text": STRING})
    make(folder / "metadata.yaml")
    return folder


def database(folder: Path, *statements: str) -> Path:
    """Write a sqlite3 bag and change it by SQL."""
    write_rosbag(folder, StoragePlugin.SQLITE3, texts(20), {"/text": STRING})
    with closing(sqlite3.connect(folder / f"{folder.name}.db3")) as opened:
        for statement in statements:
            opened.execute(statement)
        opened.commit()
    return folder


def cyclic_database(folder: Path) -> Path:
    """Write a sqlite3 bag whose tree of messages leads back to itself."""
    write_rosbag(folder, StoragePlugin.SQLITE3, texts(4000), {"/text": STRING})
    file = folder / f"{folder.name}.db3"
    data = bytearray(file.read_bytes())
    (size,) = struct.unpack_from(">H", data, 16)
    with closing(sqlite3.connect(file)) as opened:
        (root,) = opened.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'").fetchone()
    begin = (root - 1) * size
    assert data[begin] == 5  # an interior page
    (cells,) = struct.unpack_from(">H", data, begin + 3)
    pointers = struct.unpack_from(f">{cells}H", data, begin + 12)
    first = data[begin + pointers[0] : begin + pointers[0] + 4]
    for pointer in pointers[cells // 2 :]:  # the second half of the tree is its first page, over and over
        data[begin + pointer : begin + pointer + 4] = first
    file.write_bytes(data)
    return folder


ALIASES = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{chr(98 + n)}: &{chr(98 + n)} [{', '.join(['*' + chr(97 + n)] * 9)}]\n" for n in range(9)
)
VIEW = (
    "CREATE VIEW messages AS WITH RECURSIVE r(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM r) "
    "SELECT id, 1 AS topic_id, id AS timestamp, X'00' AS data FROM r"
)
BOMBS: dict[str, Callable[[Path], Path]] = {
    "large_array": lambda p: definition_bomb(p / "a.mcap", "string[300000000] x\n"),
    "nested_empty": lambda p: definition_bomb(p / "a.mcap", nested(40)),
    "idl_shift": lambda p: definition_bomb(p / "a.mcap", idl("1 << 40000000000"), "ros2idl"),
    "one_large_definition": lambda p: lone_records(
        p / "a.mcap", chunk(with_many_entries(mcap_records.Channel(2, "/t", "cdr", {}, 0), 4_000_000))
    ),
    "lone_records": lambda p: lone_records(p / "a.mcap", struct.pack("<BQ", 0x80, 0) * 1_000_000),
    "chunk_of_zeros": lambda p: chunk_bomb(p / "a.mcap", 1 << 30),
    "aliases": lambda p: metadata_bomb(p / "bag", ALIASES),
    "brackets": lambda p: metadata_bomb(p / "bag", "[" * 20_000),
    "metadata_zero": lambda p: metadata_device(p / "bag", lambda path: path.symlink_to("/dev/zero")),
    "endless_view": lambda p: database(p / "bag", "ALTER TABLE messages RENAME TO m", VIEW),
    "zeroblobs": lambda p: database(
        p / "bag",
        "ALTER TABLE messages RENAME TO m",
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
        "data BLOB AS (zeroblob(900000000)))",
        "INSERT INTO messages(topic_id, timestamp) SELECT topic_id, timestamp FROM m",
    ),
    "cyclic_tree": lambda p: cyclic_database(p / "bag"),
}
