"""`bag repair` neither vouches for what it cannot know nor changes what it copies."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import StoragePlugin

from magnetosuture_thread import cli
from magnetosuture_thread.bags.message_types import MESSAGES, typestore
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.messages.building import MessageBuilder
from test.bags.bags import STRING, cdr, read, texts, write_rosbag

PATH = "nav_msgs/msg/Path"
BINARY = bytes(range(256)) * 3
OWN_RECORDS = ("rosbag2", "magnetosuture")


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


def content(path: Path) -> dict[str, Any]:
    """Return all of an mcap file but how it is stored, by the package `mcap`."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        found = [
            (schema.name if schema else "", schema.encoding if schema else "", schema.data if schema else b"", message)
            for schema, _, message in reader.iter_messages()
        ]
        return {
            "schemas": {each[:3] for each in found},
            "messages": [(m.log_time, m.publish_time, m.sequence, m.data) for *_, m in found],
            "attachments": list(reader.iter_attachments()),
            "metadata": [
                record for record in reader.iter_metadata() if record.name not in ("rosbag2", "magnetosuture")
            ],
        }


@pytest.mark.parametrize("packed", [b"", b"\x28\xb5\x2f\xfd"])
def test_bytes_stay_bytes(tmp_path: Path, packed: bytes, capsys: pytest.CaptureFixture[str]):
    path = foreign(tmp_path / "a.mcap", packed)
    assert cli.main(["bag", "repair", str(path), "--output", str(tmp_path / "new")]) == 0
    assert "is not damaged: the new bag holds the same" in capsys.readouterr().out
    assert content(tmp_path / "new" / "new_0.mcap") == content(path)
    assert Bag(tmp_path / "new").damage is None


def test_what_nothing_vouches_for_is_not_kept_and_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = foreign(tmp_path / "a.mcap", b"")
    data = bytearray(path.read_bytes())
    place = data.index(b"photo.bin") + 200
    data[place] ^= 1
    path.write_bytes(data)
    assert cli.main(["bag", "repair", str(path), "--output", str(tmp_path / "new")]) == 0
    said = capsys.readouterr().out
    assert "not kept: 1 of this: corrupt or oversized attachment" in said
    assert "not damaged" not in said


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
    """The profile and entries of metadata.yaml; the library that wrote it goes into a note."""
    folder = tmp_path / "bag"
    folder.mkdir()
    with (folder / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start("lab-7", library="recorder of a lab")
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
    assert (new.profile, new.notes["recorder"]) == ("lab-7", "recorder of a lab")
    assert new.custom_data == {"operator": "nobody"}
    assert "reliable" in next(iter(new.connections())).metadata["offered_qos_profiles"]


def test_the_mark_of_an_unverified_bag_outlives_its_notes(tmp_path: Path):
    """In metadata.yaml and in the record of notes it may be damaged or lost; each chunk has it once more."""
    messages = [thread(index, [(0.001 * k, 0.0, 0.0) for k in range(5)]) for index in range(20)]
    with BagWriter(tmp_path / "bag", {"unverified": "salvaged without checksums"}) as writer:
        writer.add_topic("/thread/measured", PATH)
        for message in messages:
            writer.write(*message)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    file = tmp_path / "bag" / "bag_0.mcap"
    data = bytearray(file.read_bytes())
    data[data.index(b"unverified") + 20] ^= 1  # in the record of notes
    file.write_bytes(data)
    bag = Bag(file)
    assert "unverified" not in bag.notes
    assert bag.unverified == "salvaged without checksums"
