"""Bags there and back, and bags of other recorders: mcap and sqlite3, split, with definitions of their own."""

from __future__ import annotations

import shutil
import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import pytest
import zstandard
from rosbags.rosbag2 import Reader, StoragePlugin

from magnetosuture_thread.bags.message_types import typestore
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.storage import UNPACKERS, MessageDefinition
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.settings.errors import BagError
from test.bags.bags import HEADER, STRING, cdr, read, stamped, texts, write_mcap, write_rosbag
from test.shared import known

COUNT = 300
LFS_POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1951000\n"


def write(folder: Path) -> Path:
    """Write a bag of COUNT messages on two topics and return its mcap file."""
    with BagWriter(folder, {"setup": "example"}) as bag:
        bag.add_topic("/one", HEADER)
        bag.add_topic("/two", HEADER)
        for index in range(COUNT):
            bag.write_message("/one" if index % 3 else "/two", 10**9 + index * 10**7, stamped(index, f"frame {index}"))
    return folder / f"{folder.name}_0.mcap"


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the mcap file of a good bag."""
    return write(tmp_path_factory.mktemp("bags") / "good")


def test_what_is_written_is_read_also_by_another_tool(good: Path):
    for path in (good, good.parent):
        bag = Bag(path)
        assert bag.damage is None
        assert bag.topics == {"/one": HEADER, "/two": HEADER}
        assert bag.counts == {"/one": 200, "/two": 100}
        assert bag.start == 10**9
        assert bag.notes == {"setup": "example"}
        assert [record.decode().frame_id for record in bag.records()] == [f"frame {k}" for k in range(COUNT)]
        assert {record.topic for record in bag.records({"/two"})} == {"/two"}
    with Reader(good.parent) as reader:
        assert (reader.message_count, reader.duration) == (COUNT, 2_990_000_001)
        assert reader.connections[0].digest == typestore().hash_rihs01(HEADER)
        assert sum(1 for _ in reader.messages()) == COUNT


def test_what_is_no_bag_is_refused(tmp_path: Path, good: Path):
    for name in ("folder", "two", "packed"):
        (tmp_path / name).mkdir()
    (tmp_path / "packed" / "a.mcap.zstd").write_bytes(zstandard.compress(good.read_bytes()))
    for name in ("one", "other"):
        (tmp_path / "two" / f"{name}.mcap").write_bytes(good.read_bytes())
    (tmp_path / "ros1").mkdir()
    (tmp_path / "ros1" / "a.bag").write_bytes(b"#ROSBAG V2.0\n" * 9)
    database = write_rosbag(tmp_path / "db", StoragePlugin.SQLITE3, texts(500), {"/text": STRING}) / "db.db3"
    broken = database.read_bytes()[:-4096] + b"\xff" * 4096
    with BagWriter(tmp_path / "hollow") as bag:
        bag.add_topic("/one", HEADER)
    for name, content, words in (
        ("missing", None, "does not exist; expected an mcap file"),
        ("folder", None, "holds no .mcap or .db3 file"),
        ("packed", None, "is compressed as a whole; decompress it first: zstd -d a.mcap.zstd"),
        ("hollow", None, "holds no messages"),
        ("two", None, "holds 2 .mcap files; name one of them"),
        ("pointer.mcap", LFS_POINTER, "is a pointer of Git LFS, not the file itself; fetch that by: git lfs pull"),
        ("old.bag", b"#ROSBAG V2.0\n" * 9, "is a bag of ROS 1; convert it by: rosbags-convert --src FILE.bag"),
        ("ros1", None, "is a bag of ROS 1"),
        ("text.mcap", b"not a bag, but long enough to be one", "is no mcap file"),
        ("text.db3", b"text" * 99, "is no sqlite3"),
        ("broken.db3", broken, "is damaged"),
    ):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(BagError) as caught:
            Bag(tmp_path / name)
        assert words in str(caught.value)
        assert name in str(caught.value)
        assert "\n" not in str(caught.value)


PLUGINS = [StoragePlugin.MCAP, StoragePlugin.SQLITE3]
TYPES = {"/text": STRING, "/header": HEADER}


def messages(count: int = 200):
    header = stamped(3)
    both = texts(count) + [("/header", time + 5, cdr(HEADER, header.stamp, "dish")) for _, time, _ in texts(count)]
    return sorted(both, key=lambda message: message[1])


@pytest.mark.parametrize("plugin", PLUGINS)
def test_bags_of_rosbag2_are_read(tmp_path: Path, plugin: StoragePlugin):
    folder = write_rosbag(tmp_path / "bag", plugin, messages(), TYPES)
    before = {path: path.read_bytes() for path in folder.iterdir()}
    bag = Bag(folder)
    assert read(bag) == messages()
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    assert (bag.topics, bag.counts) == (TYPES, {"/text": 200, "/header": 200})
    assert bag.damage is None
    assert "no checksums" in bag.has_no_checksum
    assert [r.decode().data for r in bag.records({"/text"}, start=1.0, duration=0.01)] == ["text 100", "text 101"]
    (folder / "metadata.yaml").unlink()
    assert read(Bag(folder)) == messages()
    file = next(path for path in folder.iterdir() if path.suffix in (".db3", ".mcap"))
    assert read(Bag(file)) == messages()


@pytest.mark.parametrize("named", [True, False])
def test_a_split_bag_is_one_bag(tmp_path: Path, named: bool):
    """Eleven parts, so that by name alone the last would come second."""
    folder = tmp_path / "split"
    folder.mkdir()
    for part in range(11):
        write_mcap(folder / f"split_{part}.mcap", texts(20, start=(1 + part) * 10**9), {"/text": STRING})
    if named:
        names = "".join(f"  - split_{part}.mcap\n" for part in range(11))
        (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{names}")
    bag = Bag(folder)
    assert bag.counts == {"/text": 220}
    assert [time for _, time, _ in read(bag)] == sorted(time for _, time, _ in read(bag))
    assert [r.decode().data for r in bag.records(start=5.0, duration=0.01)] == ["text 0", "text 1"]
    middle = folder / "split_4.mcap"
    middle.write_bytes(middle.read_bytes()[:-300])
    (folder / "split_5.mcap").write_bytes(b"")
    (folder / "split_6.mcap").unlink()
    said = "\n".join(map(str, known(Bag(folder).damage).regions))
    assert "split_4.mcap" in said
    assert "split_5.mcap is empty" in said
    assert ("split_6.mcap is missing" in said) == named
    assert Bag(folder).counts["/text"] >= 160


@pytest.mark.parametrize("has_metadata", [True, False])
@pytest.mark.parametrize(("packed", "remedy"), UNPACKERS.items())
def test_parts_that_are_compressed_as_a_whole_are_named(tmp_path: Path, has_metadata: bool, packed: str, remedy: str):
    """As recorder or player of rosbag2 leave them after a crash or some parts, or a person who saves space."""
    names = [f"run_{part}.mcap" for part in range(3)]
    for part, name in enumerate(names):
        file = write_mcap(tmp_path / name, texts(20, start=(1 + part) * 10**9), {"/text": STRING})
        (tmp_path / f"{name}{packed}").write_bytes(zstandard.compress(file.read_bytes()))
    (tmp_path / names[1]).unlink()
    if has_metadata:
        lines = "".join(f"  - {name}{packed}\n" for name in names)
        (tmp_path / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{lines}")
    bag = Bag(tmp_path)
    assert bag.counts == {"/text": 40}
    advice = f"run_1.mcap{packed} is compressed as a whole; decompress it first: {remedy} run_1.mcap{packed}"
    assert [str(region) for region in known(bag.damage).regions] == [advice]


def test_the_bags_own_definitions_are_taken(tmp_path: Path):
    """Of a type that we do not know, and of one that was different once."""
    theirs = MessageDefinition("their_msgs/msg/Thing", "ros2msg", "std_msgs/Header header\nint32 number\n")
    older = MessageDefinition(STRING, "ros2msg", "int32 size\nstring data\n")
    idl = "module geometry_msgs { module msg { struct Point { float y; float x; float z; double w; }; }; };"
    point = MessageDefinition("geometry_msgs/msg/Point", "ros2idl", idl)
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/thing", theirs.type_name, theirs)
        bag.add_topic("/older", STRING, older)
        bag.add_topic("/point", point.type_name, point)
        bag.add_topic("/text", STRING)
        bag.write("/thing", 1, cdr(HEADER, stamped(3).stamp, "dis") + b"\7\0\0\0")
        bag.write("/older", 2, b"\0\1\0\0\5\0\0\0\2\0\0\0a\0")
        bag.write("/text", 3, cdr(STRING, "b"))
        bag.write("/point", 4, b"\0\1\0\0" + struct.pack("<3f4xd", 2.0, 1.0, 3.0, 4.0))
    thing, old, text, place = (record.decode() for record in Bag(tmp_path / "bag").records())
    assert (thing.header.frame_id, thing.number) == ("dis", 7)
    assert (old.size, old.data, text.data) == (5, "a", "b")
    assert (place.x, place.y, place.z, place.w) == (1.0, 2.0, 3.0, 4.0)


@pytest.mark.parametrize("data", [b"", b"\0\1\0\0\xff\xff\xff\x7fabc\0", b"\x28\xb5\x2f\xfd\0\0"])
def test_bytes_that_are_no_message_name_the_topic(tmp_path: Path, data: bytes):
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/text", STRING)
        bag.write("/text", 1, data)
    with pytest.raises(BagError, match=r"/text: a (packed )?message cannot be"):
        [record.decode() for record in Bag(tmp_path / "bag").records()]


def test_a_topic_with_two_types_spoils_no_other(tmp_path: Path):
    path = tmp_path / "two"
    shutil.copytree(write_rosbag(tmp_path / "bag", StoragePlugin.SQLITE3, messages(), TYPES), path)
    with closing(sqlite3.connect(path / "bag.db3")) as database:
        database.execute("UPDATE topics SET name = '/text' WHERE name = '/header'")
        database.execute("INSERT INTO topics VALUES (9, '/other', 'std_msgs/msg/String', 'cdr', '', '')")
        database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (9, 1, ?)", (cdr(STRING, "a"),))
        database.commit()
    bag = Bag(path)
    assert bag.conflicts == {"/text": (STRING, HEADER)}
    assert [topic for topic, _, _ in read(bag)] == ["/other"]
    with pytest.raises(BagError, match=f"topic /text has two types, {STRING} and {HEADER}; expected one"):
        bag.records({"/text"})
