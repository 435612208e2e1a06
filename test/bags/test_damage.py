"""Damaged bags: every intact chunk is recovered, nothing wrong is passed on, and what is lost is said.

Where the chunks are is found out on the undamaged file, by the package `mcap` and not by our scanner.
"""

from __future__ import annotations

import contextlib
import random
import re
import struct
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.settings.errors import BagError
from test.bags.bags import SECOND, STRING, cdr, chunks_of, read, texts, write_many_chunks, write_mcap
from test.shared import known

Untouched = Callable[[int, int], bool]


def outside(first: int, after: int) -> Untouched:
    """Return what says of a chunk whether it lies before `first` or from `after` on."""
    return lambda start, end: end <= first or start >= after


def flipped(data: bytes, place: int, chance: random.Random) -> bytes:
    """Return bytes with one bit of one of them flipped."""
    return data[:place] + bytes([data[place] ^ 1 << chance.randrange(8)]) + data[place + 1 :]


class Whole:
    """An undamaged bag, and what must be true of a damaged copy of it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = path.read_bytes()
        self.chunks = list(chunks_of(path))
        self.messages = Counter(message for _, _, messages in self.chunks for message in messages)
        bag = Bag(path)
        self.notes, self.topics = bag.notes, bag.topics

    def judge(self, path: Path, data: bytes, untouched: Untouched) -> Bag | None:
        """Read a damaged copy and hold it against the original.

        Args:
            path: to write the copy to.
            data: its bytes.
            untouched: whether the chunk between two places of the original is as it was.

        Returns:
            The bag; None if it was refused.
        """
        path.write_bytes(data)
        intact = Counter(m for start, end, messages in self.chunks if untouched(start, end) for m in messages)
        try:
            bag = Bag(path)
        except BagError:
            assert not intact, "an intact chunk is not recovered"
            return None
        found = Counter(read(bag))
        assert not found - self.messages, "passed on what was never written, or twice"
        assert not intact - found, "an intact chunk is not recovered"
        assert bag.notes in ({}, self.notes)
        assert bag.topics.items() <= self.topics.items()
        if bag.damage is None:
            assert found == self.messages
            assert bag.notes == self.notes
        elif bag.damage.messages is not None:
            assert bag.damage.messages == (self.messages - found).total()
        assert dict(bag.counts - Counter()) == Counter(topic for topic, _, _ in found.elements())
        return bag


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    return Whole(write_many_chunks(tmp_path_factory.mktemp("damage") / "whole"))


def test_no_flipped_bit_passes_on_a_wrong_value(whole: Whole, tmp_path: Path):
    """Anywhere, and in each byte of a chunk's head, and in the heads of the file, of the summary and of its end."""
    chance = random.Random(1)
    start, _, _ = whole.chunks[3]
    size = len(whole.data)
    places = [chance.randrange(size) for _ in range(120)]
    for place in (*places, *range(start, start + 60), *range(size - 1200, size, 7), *range(0, 130, 4)):
        bag = whole.judge(tmp_path / "flip.mcap", flipped(whole.data, place, chance), outside(place, place + 1))
        assert known(bag).damage is not None, f"byte {place} is not noticed"


def test_cut_bags_and_bytes_put_in_or_taken_away(whole: Whole, tmp_path: Path):
    chance = random.Random(5)
    ends = [*range(1, 40, 6), len(whole.data) - 1, *(place for _, place, _ in whole.chunks[:3])]
    for place in (*ends, *(chance.randrange(len(whole.data)) for _ in range(30))):
        size = chance.randrange(1, 9000)
        cut = whole.judge(tmp_path / "cut.mcap", whole.data[:place], outside(place, len(whole.data)))
        # What says that a bag is simulated must not be the first that goes.
        assert cut is None or (cut.damage is not None and cut.notes == whole.notes != {})
        grown = whole.data[:place] + chance.randbytes(size) + whole.data[place:]
        assert known(whole.judge(tmp_path / "grown.mcap", grown, outside(place, place))).damage is not None
        shrunk = whole.data[:place] + whole.data[place + size :]
        whole.judge(tmp_path / "shrunk.mcap", shrunk, outside(place, place + size))


def test_chunks_that_are_swapped_or_there_twice(whole: Whole, tmp_path: Path):
    (a, b, _), (c, d, _) = whole.chunks[10], whole.chunks[20]
    swapped = whole.data[:a] + whole.data[c:d] + whole.data[b:c] + whole.data[a:b] + whole.data[d:]
    twice = whole.data[:d] + whole.data[a:d] + whole.data[d:]
    for data in (swapped, twice, twice[:-200], whole.data + whole.data):
        bag = known(whole.judge(tmp_path / "moved.mcap", data, lambda a, b: True))
        assert bag.damage is not None
        assert Counter(read(bag)) == whole.messages
    # A copy that destroys a chunk, so that there are as many as the summary counts.
    within = (whole.chunks[15][0] + whole.chunks[15][1]) // 2
    data = whole.data[:within] + whole.data[a:b] + whole.data[within:]
    assert known(whole.judge(tmp_path / "moved.mcap", data, outside(within, within))).damage is not None


def test_damage_says_where_and_when(whole: Whole, tmp_path: Path):
    start, end, messages = whole.chunks[7]
    bag = whole.judge(tmp_path / "one.mcap", flipped(whole.data, end - 5, random.Random(2)), lambda a, b: a != start)
    damage = known(known(bag).damage)
    assert (damage.chunks, damage.messages) == (1, len(messages))
    (place,) = damage.regions
    before, after = (max(time for _, time, _ in whole.chunks[6][2]), min(time for _, time, _ in whole.chunks[8][2]))
    assert (place.start, place.first, place.last) == (start, before, after)
    assert f"{len(messages)} messages in 1 chunk are lost" in str(damage)
    assert "\n" not in str(damage)


@settings(max_examples=60, deadline=None)
@given(data=st.binary(max_size=300))
def test_arbitrary_bytes_are_refused_in_one_line(tmp_path_factory: pytest.TempPathFactory, data: bytes):
    for begin in (b"", b"\x89MCAP0\r\n"):
        path = tmp_path_factory.mktemp("fuzz") / "fuzz.mcap"
        path.write_bytes(begin + data)
        with pytest.raises(BagError) as caught:
            Bag(path)
        assert "\n" not in str(caught.value)


WRITERS: list[dict[str, Any]] = [
    *({"compression": compression} for compression in CompressionType),
    {"enable_data_crcs": True},
    {"use_statistics": False},
    {"index_types": IndexType.NONE, "use_summary_offsets": False, "repeat_channels": False, "repeat_schemas": False},
]


@pytest.mark.parametrize("options", WRITERS, ids=str)
def test_other_writers_with_checksums(tmp_path: Path, options: dict[str, Any]):
    """Times go back and forth, two channels have one topic."""
    messages = sorted([*texts(200), *texts(100, "/other", SECOND + 1)], key=lambda message: message[1] % 97)
    path = write_mcap(tmp_path / "other.mcap", messages, {"/text": STRING, "/other": STRING}, **options)
    bag = Bag(path)
    assert (bag.damage, bag.has_no_checksum) == (None, "")
    assert read(bag) == sorted(messages, key=lambda message: message[1])
    if "index_types" in options:
        return
    other, chance = Whole(path), random.Random(7)
    heads = [start + offset for start, _, _ in other.chunks[:3] for offset in range(20)]
    for place in (*heads, *(chance.randrange(len(other.data)) for _ in range(60))):
        other.judge(tmp_path / "flip.mcap", flipped(other.data, place, chance), outside(place, place + 1))


def test_no_chunk_is_lost_unnoticed_without_a_summary(tmp_path: Path):
    path = write_mcap(tmp_path / "bare.mcap", texts(100), {"/text": STRING}, **WRITERS[-1], use_statistics=False)
    whole = path.read_bytes()
    starts = [match.start() for match in re.finditer(rb"\x06.{6}\0\0.{28}\0{4}", whole, re.DOTALL)]
    assert len(starts) > 3
    for start in starts:
        for bit in range(8):
            path.write_bytes(whole[:start] + bytes([6 ^ 1 << bit]) + whole[start + 1 :])
            with contextlib.suppress(BagError):
                assert Bag(path).damage is not None


BARE: list[dict[str, Any]] = [{"enable_crcs": False}, {"use_chunking": False}]


@pytest.mark.parametrize("options", BARE, ids=str)
def test_without_checksums_a_whole_bag_is_read_and_a_damaged_one_gives_nothing(tmp_path: Path, options: dict[str, Any]):
    path = write_mcap(tmp_path / "bare.mcap", texts(300), {"/text": STRING}, **options)
    bag = Bag(path)
    assert read(bag) == texts(300)
    assert bag.damage is None
    assert "no checksums" in bag.has_no_checksum
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(BagError, match="which may be wrong"):
        Bag(path)


@pytest.mark.parametrize("options", BARE, ids=str)
def test_a_checksum_of_all_data_vouches_for_what_has_none(tmp_path: Path, options: dict[str, Any]):
    path = write_mcap(tmp_path / "bare.mcap", texts(300), {"/text": STRING}, enable_data_crcs=True, **options)
    whole = path.read_bytes()
    assert Bag(path).has_no_checksum == ""
    path.write_bytes(whole + b"garbage")
    bag = Bag(path)
    assert read(bag) == texts(300)
    assert bag.damage is not None
    chance = random.Random(8)
    for _ in range(60):
        path.write_bytes(flipped(whole, chance.randrange(len(whole)), chance))
        with contextlib.suppress(BagError):
            assert set(read(Bag(path))) <= set(texts(300))


def other_opcode(path: Path) -> None:
    """Make a message of a message index: their opcodes differ by one bit, and its channel exists."""
    data, (_, end, _) = path.read_bytes(), list(chunks_of(path))[2]
    assert data[end] == 7
    path.write_bytes(data[:end] + b"\5" + data[end + 1 :])


def longer(path: Path) -> None:
    """Let a chunk claim more records than it has."""
    data, (start, _, _) = bytearray(path.read_bytes()), list(chunks_of(path))[2]
    at = start + 9 + 32 + int.from_bytes(data[start + 37 : start + 41], "little")  # of the length of its records
    data[at : at + 8] = struct.pack("<Q", struct.unpack_from("<Q", data, at)[0] + 1000)
    path.write_bytes(data)


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize(("change", "lost"), [(other_opcode, False), (longer, True)])
def test_a_record_that_is_not_what_it_says_is_damage(
    tmp_path: Path, compression: CompressionType, change: Callable[[Path], None], lost: bool
):
    path = write_mcap(tmp_path / "odd.mcap", texts(300), {"/text": STRING}, compression=compression)
    chunks = list(chunks_of(path))
    change(path)
    bag = Bag(path)
    assert bag.damage is not None
    assert read(bag) == [m for number, chunk in enumerate(chunks) for m in chunk[2] if number != 2 or not lost]


@pytest.mark.parametrize("kind", ["truncated", "no checksums"])
def test_without_an_index_chunks_that_differ_only_in_their_content_are_no_copies(tmp_path: Path, kind: str):
    messages = [("/text", SECOND, cdr(STRING, letter)) for letter in "abcd"]
    path = write_mcap(
        tmp_path / "alike.mcap", messages, {"/text": STRING}, chunk_size=1, enable_crcs=kind != "no checksums"
    )
    chunks = list(chunks_of(path))
    assert len(chunks) == 4
    if kind == "truncated":
        path.write_bytes(path.read_bytes()[: chunks[-1][1]])
    bag = Bag(path)
    assert sorted(read(bag)) == messages
    assert (bag.damage is None) == (kind == "no checksums")
