"""Damaged bags: every intact chunk is recovered, nothing wrong is passed on, and what is lost is said.

Where the chunks are is found out on the undamaged file, by the package `mcap` and not by our scanner.
"""

from __future__ import annotations

import contextlib
import random
import struct
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.settings.errors import BagError
from test.bags.bags import SECOND, STRING, Message, cdr, chunks_of, read, texts, write_many_chunks, write_mcap

Untouched = Callable[[int, int], bool]


def outside(first: int, after: int) -> Untouched:
    """Return what says of a chunk whether it lies before `first` or from `after` on."""
    return lambda start, end: end <= first or start >= after


class Whole:
    """An undamaged bag, and what must be true of a damaged copy of it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = path.read_bytes()
        self.chunks = list(chunks_of(path))
        self.messages = Counter(message for _, _, messages in self.chunks for message in messages)
        bag = Bag(path)
        self.notes, self.topics = bag.notes, bag.topics

    def judge(self, path: Path, data: bytes | bytearray, untouched: Untouched) -> Bag | None:
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
    """Anywhere, and in each byte of a chunk's head, of the file's head and of the summary."""
    chance = random.Random(1)
    start, _, _ = whole.chunks[3]
    size = len(whole.data)
    places = [chance.randrange(size) for _ in range(250)]
    for place in (*places, *range(start, start + 60), *range(size - 900, size, 4), *range(50)):
        data = bytearray(whole.data)
        data[place] ^= 1 << chance.randrange(8)
        bag = whole.judge(tmp_path / "flip.mcap", data, outside(place, place + 1))
        assert bag is not None
        assert bag.damage is not None, f"byte {place} is not noticed"
        assert bag.damage.messages is not None


def test_cut_bags_and_bytes_put_in_or_taken_away(whole: Whole, tmp_path: Path):
    chance = random.Random(5)
    for _ in range(50):
        place, size = chance.randrange(len(whole.data)), chance.randrange(1, 9000)
        cut = whole.judge(tmp_path / "cut.mcap", whole.data[:place], outside(place, len(whole.data)))
        # What says that a bag is simulated must not be the first that goes.
        assert cut is None or (cut.damage is not None and cut.notes == whole.notes != {})
        grown = whole.data[:place] + chance.randbytes(size) + whole.data[place:]
        bag = whole.judge(tmp_path / "grown.mcap", grown, outside(place, place))
        assert bag is not None
        assert bag.damage is not None
        shrunk = whole.data[:place] + whole.data[place + size :]
        whole.judge(tmp_path / "shrunk.mcap", shrunk, outside(place, place + size))


def test_chunks_that_are_swapped_or_there_twice(whole: Whole, tmp_path: Path):
    (a, b, _), (c, d, _) = whole.chunks[10], whole.chunks[20]
    swapped = whole.data[:a] + whole.data[c:d] + whole.data[b:c] + whole.data[a:b] + whole.data[d:]
    twice = whole.data[:d] + whole.data[a:d] + whole.data[d:]
    for data in (swapped, twice, twice[:-200]):
        bag = whole.judge(tmp_path / "moved.mcap", data, lambda a, b: True)
        assert bag is not None
        assert Counter(read(bag)) == whole.messages
    assert Bag(tmp_path / "moved.mcap").damage is not None


def test_damage_says_where_and_when(whole: Whole, tmp_path: Path):
    start, end, messages = whole.chunks[7]
    data = bytearray(whole.data)
    data[end - 5] ^= 1
    bag = whole.judge(tmp_path / "one.mcap", data, lambda a, b: a != start)
    assert bag is not None
    assert bag.damage is not None
    assert (bag.damage.chunks, bag.damage.messages) == (1, len(messages))
    (place,) = bag.damage.regions
    times = [time for _, time, _ in messages]
    assert (place.start, place.first, place.last) == (start, min(times), max(times))
    words = f"{len(messages)} messages in 1 chunk are lost"
    assert words in str(bag.damage)
    assert "\n" not in str(bag.damage)


@settings(max_examples=100, deadline=None)
@given(data=st.binary(max_size=300))
def test_arbitrary_bytes_are_refused_in_one_line(tmp_path_factory: pytest.TempPathFactory, data: bytes):
    for begin in (b"", b"\x89MCAP0\r\n"):
        path = tmp_path_factory.mktemp("fuzz") / "fuzz.mcap"
        path.write_bytes(begin + data)
        with pytest.raises(BagError) as caught:
            Bag(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("data_crc", [False, True])
def test_other_writers_with_checksums(tmp_path: Path, compression: CompressionType, data_crc: bool):
    messages = texts(300)
    path = write_mcap(
        tmp_path / "other.mcap", messages, {"/text": STRING}, compression=compression, enable_data_crcs=data_crc
    )
    assert (Bag(path).damage, Bag(path).unchecked) == (None, "")
    other = Whole(path)
    chance = random.Random(7)
    for _ in range(150):
        place = chance.randrange(len(other.data))
        data = bytearray(other.data)
        data[place] ^= 1 << chance.randrange(8)
        other.judge(tmp_path / "flip.mcap", data, outside(place, place + 1))


BARE = pytest.mark.parametrize("options", [{"enable_crcs": False}, {"use_chunking": False}])


@BARE
def test_without_checksums_a_whole_bag_is_read_and_a_damaged_one_gives_nothing(
    tmp_path: Path, options: dict[str, bool]
):
    messages = texts(300)
    path = write_mcap(tmp_path / "bare.mcap", messages, {"/text": STRING}, **options)
    bag = Bag(path)
    assert read(bag) == messages
    assert bag.damage is None
    assert "no checksums" in bag.unchecked
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(BagError, match="which may be wrong"):
        Bag(path)


@BARE
def test_a_checksum_of_all_data_vouches_for_what_has_none(tmp_path: Path, options: dict[str, bool]):
    messages = texts(300)
    path = write_mcap(tmp_path / "bare.mcap", messages, {"/text": STRING}, enable_data_crcs=True, **options)
    whole = path.read_bytes()
    assert Bag(path).unchecked == ""
    path.write_bytes(whole + b"garbage")
    bag = Bag(path)
    assert read(bag) == messages
    assert bag.damage is not None
    chance = random.Random(8)
    for _ in range(100):
        data = bytearray(whole)
        data[chance.randrange(len(whole))] ^= 1 << chance.randrange(8)
        path.write_bytes(data)
        with contextlib.suppress(BagError):
            assert set(read(Bag(path))) <= set(messages)


def test_a_message_index_that_becomes_a_message_is_not_passed_on(tmp_path: Path):
    """Kinds 7 and 5 differ by one bit, and the bytes of an index make a message of a channel that there is."""
    messages: list[Message] = texts(300)
    path = write_mcap(tmp_path / "index.mcap", messages, {"/text": STRING}, compression=CompressionType.ZSTD)
    whole = path.read_bytes()
    _, end, _ = list(chunks_of(path))[2]
    assert whole[end] == 7
    path.write_bytes(whole[:end] + b"\5" + whole[end + 1 :])
    bag = Bag(path)
    assert sorted(read(bag)) == sorted(messages)
    assert bag.damage is not None


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_chunk_whose_records_are_shorter_than_it_says_is_corrupt(tmp_path: Path, compression: CompressionType):
    path = write_mcap(tmp_path / "long.mcap", texts(300), {"/text": STRING}, compression=compression)
    data = bytearray(path.read_bytes())
    start, _, messages = list(chunks_of(path))[2]
    name = 0 if compression is CompressionType.NONE else len(compression.name)
    at = start + 9 + 32 + name  # of the length of its records
    data[at : at + 8] = struct.pack("<Q", struct.unpack_from("<Q", data, at)[0] + 1000)
    path.write_bytes(data)
    damage = Bag(path).damage
    assert damage is not None
    assert damage.messages == len(messages)


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
