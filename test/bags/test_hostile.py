"""Bags that are whole as files and odd in what they say: nothing ends in anything but a bag or one clear line."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Literal

import pytest
from mcap.writer import Writer
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter

from magnetosuture_thread import cli
from magnetosuture_thread.bags.message_types import typestore
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.interface import GROUND_TRUTH_NEEDLE, NEEDLE_COMMAND
from test.bags.bags import STRING, cdr, make, read, stamped, texts, write_mcap, write_rosbag

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
    "change",
    [
        "timestamp = -5",
        "timestamp = 'noon'",
        "data = 'text'",
        "topic_id = 77",
    ],
)
def test_a_database_with_a_row_that_cannot_be_is_refused_as_damaged(tmp_path: Path, change: str):
    folder = write_rosbag(tmp_path / "bag", StoragePlugin.SQLITE3, texts(50), {"/text": STRING})
    with closing(sqlite3.connect(folder / "bag.db3")) as database:
        database.execute(f"UPDATE messages SET {change} WHERE id = 3")
        database.commit()
    with pytest.raises(BagError, match=r"is damaged .*no checksums"):
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


def test_a_topic_that_is_no_cdr_spoils_no_other(tmp_path: Path):
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        for topic, form in (("/text", "cdr"), ("/state", "json")):
            schema = writer.register_schema(STRING, "ros2msg", b"string data")
            channel = writer.register_channel(topic, form, schema)
            writer.add_message(channel, 1, cdr(STRING, "a") if form == "cdr" else b"{}", 1)
        writer.finish()
    assert cli.main(["bag", "check", str(path)]) == 0
    new = repaired(path, tmp_path / "new")
    assert new.counts == {"/text": 1, "/state": 1}
    assert {c.topic: c.serialization for c in new.connections()} == {"/text": "cdr", "/state": "json"}


@pytest.mark.parametrize("topic", ["/a[red]b", "/a[/x]", "/a\nb\x1b[31m"])
def test_names_are_shown_as_they_are(tmp_path: Path, topic: str, capsys: pytest.CaptureFixture[str]):
    path = write_mcap(tmp_path / "a [b].mcap", texts(2, topic), {topic: STRING})
    assert cli.main(["bag", "check", str(path), "--json", str(tmp_path / "found.json")]) == 0
    shown = capsys.readouterr().out
    assert topic.replace("\n", r"\n").replace("\x1b", r"\x1b") in shown
    assert "\x1b" not in shown
    assert json.loads((tmp_path / "found.json").read_text())["topics"][0]["topic"] == topic


@pytest.mark.parametrize(
    "text", ["[" * 5000, "rosbag2_bagfile_information:\n  relative_file_paths: [a.mcap, a.mcap]\n"]
)
def test_metadata_that_is_odd_reads_each_file_once(tmp_path: Path, text: str):
    write_mcap(tmp_path / "a.mcap", texts(5), {"/text": STRING})
    (tmp_path / "metadata.yaml").write_text(text)
    assert read(Bag(tmp_path)) == texts(5)


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


@pytest.mark.parametrize("time_", [-1, 2**64])
def test_a_time_that_has_no_room_is_refused_at_once(tmp_path: Path, time_: int):
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/text", STRING)
        bag.write("/text", 1, cdr(STRING, "a"))
        with pytest.raises(BagError, match="expected 0 to"):
            bag.write("/text", time_, cdr(STRING, "b"))
    assert len(read(Bag(tmp_path / "bag"))) == 1


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
