"""`magnetosuture bag`: what is in a bag, and a whole one of what is intact."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from mcap.writer import Writer
from rosbags.rosbag2 import Reader

from magnetosuture_thread import cli
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.writer import BagWriter
from test.bags.bags import HEADER, STRING, cdr, read, stamped, write_many_chunks, write_mcap


@pytest.fixture
def damaged(tmp_path: Path) -> Path:
    """Return a bag with a broken chunk and no end."""
    file = write_many_chunks(tmp_path / "damaged")
    data = bytearray(file.read_bytes())
    data[20_000] ^= 1
    file.write_bytes(data[:-30_000])
    return tmp_path / "damaged"


def test_a_whole_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    with BagWriter(tmp_path / "whole", {"setup": "example"}) as bag:
        bag.add_topic("/stamped", HEADER)
        bag.add_topic("/ground_truth/needle", "geometry_msgs/msg/PoseStamped")
        for index, seconds in enumerate((1, 2, 5, 4, 6, 3)):
            bag.write_message("/stamped", 10**9 + index * 5 * 10**8, stamped(seconds))
    found = tmp_path / "found.json"
    assert cli.main(["bag", "check", str(tmp_path / "whole"), "--json", str(found)]) == 0
    shown = capsys.readouterr().out
    assert "nothing is damaged" in shown
    assert "/stamped: 2 stamps are before the one before them" in shown
    topics = {topic["topic"]: topic for topic in json.loads(found.read_text())["topics"]}
    told = topics["/stamped"]
    assert (told["messages"], told["rate_hz"], told["first_s"], told["last_s"]) == (6, 2.0, 0.0, 2.5)
    assert (told["greatest_gap_s"], told["stamps_going_back"]) == (0.5, 2)
    assert (topics["/ground_truth/needle"]["rate_hz"], topics["/ground_truth/needle"]["known"]) == (None, True)


def test_a_silence_is_named_and_a_first_message_at_0_ns_is_no_damage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Clocks that are set after the start give such a bag; its writer took 0 for no time in the summary."""
    messages = [("/text", at, cdr(STRING, "a")) for at in (0, 10**8, 1_700_000_000_200_000_000)]
    file = write_mcap(tmp_path / "zero.mcap", messages, {"/text": STRING})
    found = tmp_path / "found.json"
    assert cli.main(["bag", "check", str(file), "--json", str(found)]) == 0
    shown = capsys.readouterr().out
    assert "no message for 1700000000.1 s from 0.100 s on" in shown
    assert "--start 1700000000.200 begins after it" in shown
    assert "nothing is damaged" in shown
    assert json.loads(found.read_text())["silences"] == [{"begin_s": 0.1, "end_s": pytest.approx(1.7e9 + 0.2)}]


def test_a_damaged_bag_is_shown_all_the_same(damaged: Path, capsys: pytest.CaptureFixture[str]):
    assert cli.main(["bag", "check", str(damaged), "--remap", "camera:=/camera/image_raw"]) == 1
    shown = capsys.readouterr().out
    assert "/camera/image_raw *" in shown
    assert "is damaged" in shown
    assert shown.count("damaged_0.mcap, bytes") >= 3


def test_repair_makes_a_whole_bag_of_what_is_intact(damaged: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    before = {path: path.read_bytes() for path in damaged.iterdir()}
    output = tmp_path / "repaired"
    assert cli.main(["bag", "repair", str(damaged), "--output", str(output)]) == 0
    old, new = Bag(damaged), Bag(output)
    assert (old.damage is None, new.damage) == (False, None)
    assert read(new) == read(old)
    assert {path: path.read_bytes() for path in damaged.iterdir()} == before
    with Reader(output) as reader:
        assert reader.message_count == sum(new.counts.values())
    assert cli.main(["bag", "repair", str(damaged), "--output", str(output)]) == 1
    assert "exists already" in capsys.readouterr().err


def test_a_topic_of_ours_in_another_serialization_is_a_problem(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "other.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        schema = writer.register_schema("geometry_msgs/msg/PoseStamped", "ros2msg", b"string text")
        channel = writer.register_channel("/needle/measured_cp", "cbor", schema)
        writer.add_message(channel, 10, b"\xa0", 10)
        writer.finish()
    found = tmp_path / "found.json"
    cli.main(["bag", "check", str(path), "--json", str(found)])
    (topic,) = json.loads(found.read_text())["topics"]
    assert not topic["known"]
    assert "they are written as 'cbor', expected 'cdr'" in topic["problem"]
