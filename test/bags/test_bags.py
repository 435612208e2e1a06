"""Bags there and back, and damage that is found."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import Reader

from magnetosuture_thread.bags.message_types import typestore
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.errors import BagError

COUNT = 300
HEADER = "std_msgs/msg/Header"


def header(index: int):
    """Return a small message that knows its index."""
    types = typestore().types
    return types[HEADER](types["builtin_interfaces/msg/Time"](index, 0), f"frame {index}")


def write(folder: Path) -> Path:
    """Write a bag of COUNT messages on two topics and return its mcap file."""
    with BagWriter(folder, {"setup": "example"}) as bag:
        bag.add_topic("/one", HEADER)
        bag.add_topic("/two", HEADER)
        for index in range(COUNT):
            bag.write_message("/one" if index % 3 else "/two", 10**9 + index * 10**7, header(index))
    return folder / f"{folder.name}_0.mcap"


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the mcap file of a good bag."""
    return write(tmp_path_factory.mktemp("bags") / "good")


def test_what_is_written_is_read(good: Path):
    for path in (good, good.parent):
        bag = Bag(path)
        assert bag.damage is None
        assert bag.topics == {"/one": HEADER, "/two": HEADER}
        assert bag.counts == {"/one": 200, "/two": 100}
        assert bag.start == 10**9
        assert bag.duration == pytest.approx(2.99)
        assert bag.notes == {"setup": "example"}
        assert [record.decode().frame_id for record in bag.records()] == [f"frame {k}" for k in range(COUNT)]
        assert {record.topic for record in bag.records({"/two"})} == {"/two"}


def test_another_tool_reads_it_whole(good: Path):
    with Reader(good.parent) as reader:
        assert reader.message_count == COUNT
        assert reader.duration == 2_990_000_001
        connection = reader.connections[0]
        assert connection.digest == typestore().hash_rihs01(HEADER)
        assert connection.msgdef is not None
        assert sum(1 for _ in reader.messages()) == COUNT


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
def test_bags_of_other_writers_are_read_and_their_damage_is_found(tmp_path: Path, compression: CompressionType):
    path = tmp_path / "other.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression, chunk_size=2000)
        writer.start("ros2")
        schema = writer.register_schema(HEADER, "ros2msg", b"builtin_interfaces/Time stamp\nstring frame_id")
        # Two channels on one topic, as in bags that were merged.
        channels = [writer.register_channel("/one", "cdr", schema) for _ in range(2)]
        for index in range(100):
            data = bytes(typestore().serialize_cdr(header(index), HEADER))
            writer.add_message(channels[index % 2], index, data, index)
        writer.finish()
    bag = Bag(path)
    assert bag.damage is None
    assert bag.counts == {"/one": 100}
    whole = path.read_bytes()
    refused = 0
    for place in range(60, len(whole), 37):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        try:
            refused += Bag(path).damage is not None
        except BagError:
            refused += 1
    assert refused > 20


def test_what_is_no_bag_is_refused(tmp_path: Path, good: Path):
    (tmp_path / "text.mcap").write_text("not a bag, but long enough to be one")
    (tmp_path / "folder").mkdir()
    with BagWriter(tmp_path / "hollow") as bag:
        bag.add_topic("/one", HEADER)
    for name, words in (
        ("missing", "does not exist; expected an mcap file"),
        ("text.mcap", "is no mcap file"),
        ("folder", "holds no .mcap or .db3 file"),
        ("hollow", "holds no messages"),
    ):
        with pytest.raises(BagError) as caught:
            Bag(tmp_path / name)
        assert words in str(caught.value)
        assert name in str(caught.value)


def test_a_bag_is_readable_whatever_interrupts_it(tmp_path: Path):
    def interrupted() -> None:
        with BagWriter(tmp_path / "short") as bag:
            bag.add_topic("/one", HEADER)
            bag.write_message("/one", 1, header(0))
            raise ValueError("stop")

    with pytest.raises(ValueError, match="stop"):
        interrupted()
    assert Bag(tmp_path / "short").counts == {"/one": 1}
