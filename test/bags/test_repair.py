"""Bags that are odd in what they say are read or refused in one line; `bag repair` vouches for nothing unknown."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any, Literal

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter

from magnetosuture_thread import cli
from magnetosuture_thread.bags.message_types import typestore
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.settings.errors import BagError
from test.bags.bags import STRING, cdr, read, texts, write_rosbag

PATH = "nav_msgs/msg/Path"
BINARY = bytes(range(256)) * 3


def test_a_sound_bag_without_checksums_is_copied_and_stays_unchecked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder = write_rosbag(tmp_path / "bag", StoragePlugin.SQLITE3, texts(5), {"/text": STRING})
    assert cli.main(["bag", "repair", str(folder), "--output", str(tmp_path / "new")]) == 0
    new = Bag(tmp_path / "new")
    assert read(new) == texts(5)
    assert "damage to it cannot be noticed" in new.has_no_checksum
    assert cli.main(["bag", "check", str(tmp_path / "new")]) == 0
    assert "nothing is damaged" not in capsys.readouterr().out


def foreign(path: Path, packed: bytes) -> Path:
    """Write an mcap file with everything that our own recordings do not have."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start("ros2")
        schema = writer.register_schema("pkg.Thing", "protobuf", BINARY)
        channel = writer.register_channel("/thing", "protobuf", schema)
        writer.add_attachment(7, 8, "photo.bin", "application/octet-stream", BINARY)
        writer.add_metadata("lab", {"operator": "nobody"})
        for index in range(5):
            writer.add_message(channel, 100 + index, packed + bytes([index]), 50 + index, 1000 + 3 * index)
        writer.finish()
    return path


def content(path: Path) -> tuple[set[Any], list[Any]]:
    """Return schemas and messages of an mcap file, by the package `mcap`."""
    with path.open("rb") as stream:
        found = list(make_reader(stream, validate_crcs=True).iter_messages())
    schemas = {(schema.name, schema.encoding, schema.data) for schema, _, _ in found if schema is not None}
    return schemas, [(m.log_time, m.publish_time, m.sequence, m.data) for _, _, m in found]


@pytest.mark.parametrize("packed", [b"", b"\x28\xb5\x2f\xfd"])
def test_bytes_stay_bytes_and_what_is_no_message_is_counted(
    tmp_path: Path, packed: bytes, capsys: pytest.CaptureFixture[str]
):
    path = foreign(tmp_path / "a.mcap", packed)
    assert cli.main(["bag", "repair", str(path), "--output", str(tmp_path / "new")]) == 0
    said = capsys.readouterr().out
    assert "not kept: 1 of this: attachment" in said
    assert "not kept: 1 of this: metadata record" in said
    assert content(tmp_path / "new" / "new_0.mcap") == content(path)
    assert Bag(tmp_path / "new").damage is None


KEPT = QosTime(0, 0)
RELIABLE = (QosHistory.KEEP_LAST, 7, QosReliability.RELIABLE)
LATCHED = Qos(*RELIABLE, QosDurability.TRANSIENT_LOCAL, KEPT, KEPT, QosLiveliness.AUTOMATIC, KEPT, False)


def repaired(path: Path, output: Path, *options: str) -> Bag:
    """Return what `bag repair` makes of a bag."""
    assert cli.main(["bag", "repair", str(path), "--output", str(output), *options]) == 0
    return Bag(output)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ("timestamp = 'noon'", r"is damaged .*no checksums"),
        ("data = zeroblob(67108865)", "has a message of 67108865 bytes; at most 67108864 are read"),
    ],
)
def test_a_database_with_a_row_that_cannot_be_is_refused(tmp_path: Path, change: str, problem: str):
    folder = write_rosbag(tmp_path / "bag", StoragePlugin.SQLITE3, texts(50), {"/text": STRING})
    with closing(sqlite3.connect(folder / "bag.db3")) as database:
        database.execute(f"UPDATE messages SET {change} WHERE id = 3")
        database.commit()
    with pytest.raises(BagError, match=problem):
        Bag(folder)
    assert cli.main(["bag", "repair", str(folder), "--output", str(tmp_path / "new")]) == 1
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("table", "problem"),
    [
        ("TABLE messages(id INTEGER PRIMARY KEY, topic_id INT, timestamp INT, data BLOB /* as virtual */)", ""),
        ("TABLE messages(topic_id INT, timestamp INT, data BLOB)", "has no column id in its table messages"),
        (
            "TABLE messages(id INT, topic_id INT, timestamp INT, d BLOB, data BLOB GENERATED ALWAYS AS (d) STORED)",
            "has no column data in its table messages, or one that is computed",
        ),
        ("VIEW messages AS SELECT * FROM old", "has no plain table messages"),
        ("VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data)", "has no plain table messages"),
    ],
)
def test_only_plain_tables_of_a_database_are_read(tmp_path: Path, table: str, problem: str):
    folder = write_rosbag(tmp_path / "bag", StoragePlugin.SQLITE3, texts(9), {"/text": STRING})
    with closing(sqlite3.connect(folder / "bag.db3")) as database:
        database.execute("ALTER TABLE messages RENAME TO old")
        database.execute(f"CREATE {table}")
        if not problem:
            database.execute("INSERT INTO messages SELECT id, topic_id, timestamp, data FROM old")
        database.commit()
    if problem:
        with pytest.raises(BagError, match=problem):
            Bag(folder)
    else:
        assert read(Bag(folder)) == texts(9)


def test_a_message_that_cannot_be_unpacked_is_counted_and_all_else_is_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    writer = RosbagWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer as bag:
        connection = bag.add_connection("/text", STRING, typestore=typestore())
        for _, at, data in texts(20):
            bag.write(connection, at, data)
    with closing(sqlite3.connect(tmp_path / "bag" / "bag.db3")) as database:
        database.execute("UPDATE messages SET data = substr(data, 1, length(data) - 3) WHERE id = 5")
        database.commit()
    assert cli.main(["bag", "check", str(tmp_path / "bag")]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "did not decompress full frame: 1 message lost" in said
    assert "nothing is damaged" not in said
    assert read(repaired(tmp_path / "bag", tmp_path / "new")) == texts(20)[:4] + texts(20)[5:]
    assert "1 message lost" in capsys.readouterr().out


@pytest.mark.parametrize(("plugin", "version"), [(StoragePlugin.MCAP, 8), (StoragePlugin.SQLITE3, 9)])
def test_repair_keeps_what_others_wrote_and_the_quality_of_service_in_todays_words(
    tmp_path: Path, plugin: StoragePlugin, version: Literal[8, 9], capsys: pytest.CaptureFixture[str]
):
    folder = tmp_path / "bag"
    with RosbagWriter(folder, version=version, storage_plugin=plugin) as bag:
        bag.set_custom_data("operator", "nobody")
        connection = bag.add_connection("/text", STRING, typestore=typestore(), offered_qos_profiles=[LATCHED])
        bag.write(connection, 1, cdr(STRING, "a"))
    (folder / "other.mcap").write_bytes(b"whatever")
    assert Bag(folder).remarks == ["other.mcap is not read: metadata.yaml does not list it"]
    new = repaired(folder, tmp_path / "new")
    said = capsys.readouterr().out
    assert ("quality of service written by name, as Jazzy reads it: /text" in said) == (version == 8)
    assert "other.mcap is not read" in said
    assert new.custom_data == {"operator": "nobody"}
    assert "transient_local" in (tmp_path / "new" / "metadata.yaml").read_text()
    with Reader(tmp_path / "new") as reader:
        assert [getattr(c.ext, "offered_qos_profiles", None) for c in reader.connections] == [[LATCHED]]
