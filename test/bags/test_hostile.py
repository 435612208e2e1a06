"""Bags that are whole as files and odd in what they say: nothing ends in anything but a bag or one clear line."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import struct
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter

from magnetosuture_thread import cli
from magnetosuture_thread.bags.conversion import rotation_from_message
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
        "timestamp = 1.5",
        "data = 'text'",
        "data = 7",
        "topic_id = 'x'",
        "topic_id = 77",
    ],
)
def test_a_row_with_anything_in_it_is_lost_and_said(tmp_path: Path, change: str):
    folder = write_rosbag(tmp_path / "bag", StoragePlugin.SQLITE3, texts(50), {"/text": STRING})
    with closing(sqlite3.connect(folder / "bag.db3")) as database:
        database.execute(f"UPDATE messages SET {change} WHERE id = 3")
        database.commit()
    bag = Bag(folder)
    assert bag.damage is not None
    assert bag.damage.messages == 1
    assert read(bag) == texts(50)[:2] + texts(50)[3:]
    assert cli.main(["bag", "repair", str(folder), "--output", str(tmp_path / "new")]) == 1
    assert read(repaired(folder, tmp_path / "new", "--unverified")) == read(bag)


@pytest.mark.parametrize("name", ["X'ff00'", "CAST(X'2fff' AS TEXT)", "7.5"])
def test_a_topic_without_a_name_in_sqlite(tmp_path: Path, name: str):
    folder = write_rosbag(tmp_path / "bag", StoragePlugin.SQLITE3, texts(5), {"/text": STRING, "/other": STRING})
    with closing(sqlite3.connect(folder / "bag.db3")) as database:
        database.execute(f"UPDATE topics SET name = {name} WHERE name = '/other'")
        database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (2, 1, X'00')")
        database.commit()
    bag = Bag(folder)
    assert read(bag)[-5:] == texts(5)


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


@pytest.mark.parametrize("ending", ["mcap", "db3"])
def test_a_file_whose_name_is_no_text(tmp_path: Path, ending: str):
    plugin = StoragePlugin.MCAP if ending == "mcap" else StoragePlugin.SQLITE3
    folder = write_rosbag(tmp_path / "bag", plugin, texts(5), {"/text": STRING})
    odd = tmp_path / os.fsdecode(b"\xff #?[x]." + ending.encode())
    shutil.copy(folder / f"bag.{ending}", odd)
    assert read(Bag(odd)) == texts(5)
    command = [sys.executable, "-m", "magnetosuture_thread.cli", "bag", "check", str(odd)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env={**os.environ, "LC_ALL": "C.UTF-8"})
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    "text", ["[" * 5000, "rosbag2_bagfile_information:\n  relative_file_paths: [a.mcap, a.mcap]\n"]
)
def test_metadata_that_is_odd_reads_each_file_once(tmp_path: Path, text: str):
    write_mcap(tmp_path / "a.mcap", texts(5), {"/text": STRING})
    (tmp_path / "metadata.yaml").write_text(text)
    assert read(Bag(tmp_path)) == texts(5)


def test_thousands_of_topics_are_opened_in_proportion(tmp_path: Path):
    def opened(count: int) -> float:
        names = [f"/t{number}" for number in range(count)]
        path = write_mcap(
            tmp_path / f"{count}.mcap", [(n, 1, b"\0\1\0\0") for n in names], dict.fromkeys(names, STRING)
        )
        before = time.process_time()
        assert len(Bag(path).topics) == count
        return time.process_time() - before

    few = opened(500)
    assert opened(5000) < 40.0 * few  # a hundred times as long, if each is held against each


@pytest.mark.parametrize("value", [1e-320, 1e-200, 1.0, 1e200])
def test_a_quaternion_of_any_length_is_a_rotation(value: float):
    turn = make("geometry_msgs/msg/Quaternion", 0.0, 0.0, value, value)
    rotation = rotation_from_message(turn)
    assert rotation is not None
    np.testing.assert_allclose(rotation.as_rotvec(), [0.0, 0.0, np.pi / 2], atol=1e-12)


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_what_is_no_quaternion(value: float):
    assert rotation_from_message(make("geometry_msgs/msg/Quaternion", 0.0, value, 0.0, 0.0)) is None


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


def test_what_a_killed_recorder_leaves_is_read(tmp_path: Path):
    kill = """
import os, sys
from pathlib import Path
from magnetosuture_thread.bags.writer import BagWriter
bag = BagWriter(Path(sys.argv[1]))
bag.add_topic("/noise", "std_msgs/msg/UInt8MultiArray")
for index in range(100):
    bag.write("/noise", 10**9 + index * 10**7, os.urandom(10_000))
os._exit(9)
"""
    subprocess.run([sys.executable, "-c", kill, str(tmp_path / "bag")], check=False, timeout=300)
    assert (tmp_path / "bag" / ".reserve").exists()
    assert cli.main(["bag", "check", str(tmp_path / "bag")]) == 1
    new = repaired(tmp_path / "bag", tmp_path / "new")
    assert new.counts["/noise"] >= 70
    with Reader(tmp_path / "new") as reader:
        assert reader.message_count == new.counts["/noise"]
    assert not (tmp_path / "new" / ".reserve").exists()


def test_a_length_in_a_header_that_lies(tmp_path: Path):
    path = write_mcap(
        tmp_path / "a.mcap",
        [("/h", 1, b"\0\1\0\0" + struct.pack("<iII", 1, 2, 0xFFFFFFFF) + b"a\0")],
        {"/h": "std_msgs/msg/Header"},
    )
    assert cli.main(["bag", "check", str(path)]) == 0


def test_a_damaged_name_in_the_words_of_an_error_is_no_traceback(tmp_path: Path):
    folder = write_rosbag(tmp_path / "bag", StoragePlugin.SQLITE3, texts(5), {"/text": STRING})
    file = folder / "bag.db3"
    data = file.read_bytes().replace(b"timestamp_idx", b"\xc1imestamp_idx").replace(b"CREATE INDEX", b"CREATE INDEZ")
    assert data != file.read_bytes()
    file.write_bytes(data)
    with pytest.raises(BagError, match="cannot be read as a bag"):
        Bag(folder)
