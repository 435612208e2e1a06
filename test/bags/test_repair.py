"""Bags that are odd in what they say are read or refused in one line; `bag repair` vouches for nothing unknown."""

from __future__ import annotations

import json
import sqlite3
import struct
from contextlib import closing
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter

from magnetosuture_thread import cli
from magnetosuture_thread.bags.message_types import MESSAGES, typestore
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.interface import GROUND_TRUTH_NEEDLE, NEEDLE_COMMAND
from magnetosuture_thread.messages.building import MessageBuilder
from test.bags.bags import STRING, cdr, make, read, stamped, texts, write_mcap, write_rosbag

PATH = "nav_msgs/msg/Path"
BINARY = bytes(range(256)) * 3


def thread(index: int, points: list[tuple[float, float, float]]) -> tuple[str, int, bytes]:
    """Return a message of a measured thread, stamped every 0.1 s."""
    builder: MessageBuilder = MESSAGES
    at = 10**9 + index * 10**8
    message = builder.path(builder.header(at, "dish"), [builder.pose(point, (0.0, 0.0, 0.0, 1.0)) for point in points])
    return "/thread/measured", at, bytes(typestore().serialize_cdr(message, PATH))


def test_a_sound_bag_without_checksums_is_copied_and_stays_unchecked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder = write_rosbag(tmp_path / "bag", StoragePlugin.SQLITE3, texts(5), {"/text": STRING})
    assert cli.main(["bag", "repair", str(folder), "--output", str(tmp_path / "new")]) == 0
    new = Bag(tmp_path / "new")
    assert read(new) == texts(5)
    assert "damage to it cannot be noticed" in new.unchecked
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


def test_files_that_metadata_does_not_list_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = write_rosbag(tmp_path / "bag", StoragePlugin.MCAP, texts(5), {"/text": STRING})
    (folder / "other.mcap").write_bytes(b"whatever")
    assert Bag(folder).remarks == ["other.mcap is not read: metadata.yaml does not list it"]
    assert cli.main(["bag", "check", str(folder)]) == 0
    assert "other.mcap is not read" in capsys.readouterr().out


def test_a_topic_of_which_no_message_can_be_used_is_not_marked_as_taken(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    garbage = b"\0\1\0\0" + struct.pack("<iII", 1, 0, 5) + b"dish\0"
    messages = [("/thread/measured", 10**9 + n, garbage + bytes(3) + b"\xff\xff\xff\x7f") for n in range(3)]
    messages += [("/text", 10**9, cdr(STRING, "a"))]
    folder = write_rosbag(tmp_path / "bag", StoragePlugin.MCAP, messages, {"/thread/measured": PATH, "/text": STRING})
    assert cli.main(["bag", "check", str(folder)]) == 0
    shown = capsys.readouterr().out
    assert "/thread/measured *" not in shown
    assert "none of the messages on /thread/measured can be used" in " ".join(shown.split())
    assert np.isfinite(Bag(folder).duration)


def test_what_others_wrote_of_a_bag_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Entries of metadata.yaml, and the quality of service, by name."""
    folder = tmp_path / "bag"
    folder.mkdir()
    with (folder / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        schema = writer.register_schema(STRING, "ros2msg", b"string data\n")
        profiles = "- history: 3\n  depth: 1\n  reliability: 1\n  durability: 2\n  deadline: {sec: 0, nsec: 0}\n"
        profiles += "  lifespan: {sec: 0, nsec: 0}\n  liveliness: 1\n  liveliness_lease_duration: {sec: 0, nsec: 0}\n"
        profiles += "  avoid_ros_namespace_conventions: false\n"
        channel = writer.register_channel("/text", "cdr", schema, {"offered_qos_profiles": profiles})
        writer.add_message(channel, 1, cdr(STRING, "a"), 1)
        writer.finish()
    about = {"relative_file_paths": ["a.mcap"], "custom_data": {"operator": "nobody"}}
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": about}))
    assert cli.main(["bag", "repair", str(folder), "--output", str(tmp_path / "new")]) == 0
    said = capsys.readouterr().out
    assert "quality of service written by name, as Jazzy reads it: /text" in said
    new = Bag(tmp_path / "new")
    assert new.custom_data == {"operator": "nobody"}
    assert "reliable" in next(iter(new.connections())).metadata["offered_qos_profiles"]


KEPT = QosTime(0, 0)
LATCHED = Qos(
    QosHistory.KEEP_LAST,
    7,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    KEPT,
    KEPT,
    QosLiveliness.AUTOMATIC,
    KEPT,
    False,
)


def repaired(path: Path, output: Path, *options: str) -> Bag:
    """Return what `bag repair` makes of a bag."""
    assert cli.main(["bag", "repair", str(path), "--output", str(output), *options]) == 0
    return Bag(output)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ("timestamp = -5", r"is damaged .*no checksums"),
        ("timestamp = 'noon'", r"is damaged .*no checksums"),
        ("data = 'text'", r"is damaged .*no checksums"),
        ("topic_id = 77", r"is damaged .*no checksums"),
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


@pytest.mark.parametrize("topic", ["/a[red]b", "/a[/x]", "/a\nb\x1b[31m"])
def test_names_are_shown_as_they_are(tmp_path: Path, topic: str, capsys: pytest.CaptureFixture[str]):
    path = write_mcap(tmp_path / "a [b].mcap", texts(2, topic), {topic: STRING})
    assert cli.main(["bag", "check", str(path), "--json", str(tmp_path / "found.json")]) == 0
    shown = capsys.readouterr().out
    assert topic.replace("\n", r"\n").replace("\x1b", r"\x1b") in shown
    assert "\x1b" not in shown
    assert json.loads((tmp_path / "found.json").read_text())["topics"][0]["topic"] == topic


def test_a_broken_transform_and_a_far_future_are_refused_and_counted(tmp_path: Path):
    vector, turn = make("geometry_msgs/msg/Vector3", 1.0, 0.0, 0.0), make("geometry_msgs/msg/Quaternion", 0, 0, 0, 1.0)
    to_world = make(
        "geometry_msgs/msg/TransformStamped",
        stamped(0, "dish"),
        "world",
        make("geometry_msgs/msg/Transform", vector, turn),
    )
    point = make("geometry_msgs/msg/Point", 1.0, 0.0, 0.0)
    pose = make("geometry_msgs/msg/PoseStamped", stamped(1, "world"), make("geometry_msgs/msg/Pose", point, turn))
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/tf_static", "tf2_msgs/msg/TFMessage")
        bag.add_topic(GROUND_TRUTH_NEEDLE.recorded, GROUND_TRUTH_NEEDLE.type_name)
        bag.add_topic(NEEDLE_COMMAND.recorded, "geometry_msgs/msg/Twist")
        bag.write("/tf_static", 1, b"\0\1\0\0\xff\xff\xff\x7f")
        bag.write_message("/tf_static", 2, make("tf2_msgs/msg/TFMessage", [to_world]))
        bag.write_message(GROUND_TRUTH_NEEDLE.recorded, 3, pose)
        bag.write_message(NEEDLE_COMMAND.recorded, 2**63, make("geometry_msgs/msg/Twist", vector, vector))
    recording = Recording(Bag(tmp_path / "bag"))
    (found,) = recording.records([GROUND_TRUTH_NEEDLE])
    assert found.decode().pose.position.x == 2.0
    assert any("/tf_static: a message cannot be decoded" in reason for reason in recording.refused)
    assert list(recording.records([NEEDLE_COMMAND])) == []
    assert any("out of range" in reason for reason in recording.refused)


@pytest.mark.parametrize("version", [8, 9])
@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_repair_keeps_the_quality_of_service_in_todays_words(
    tmp_path: Path, plugin: StoragePlugin, version: Literal[8, 9]
):
    with RosbagWriter(tmp_path / "bag", version=version, storage_plugin=plugin) as bag:
        connection = bag.add_connection("/text", STRING, typestore=typestore(), offered_qos_profiles=[LATCHED])
        bag.write(connection, 1, cdr(STRING, "a"))
    new = repaired(tmp_path / "bag", tmp_path / "new")
    (kept,) = (c.metadata["offered_qos_profiles"] for c in new.connections())
    assert "transient_local" in kept
    assert "transient_local" in (tmp_path / "new" / "metadata.yaml").read_text()
    with Reader(tmp_path / "new") as reader:
        assert [getattr(c.ext, "offered_qos_profiles", None) for c in reader.connections] == [[LATCHED]]
