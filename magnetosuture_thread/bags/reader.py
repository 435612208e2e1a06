"""Reads mcap bags, with every checksum checked."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.exceptions import McapError
from mcap.reader import McapReader, NonSeekingReader, make_reader
from zstandard import ZstdError

from magnetosuture_thread.bags.types import typestore
from magnetosuture_thread.bags.writer import NOTES
from magnetosuture_thread.errors import BagError

MAGIC = b"\x89MCAP0\r\n"  # an mcap file's first and last bytes
# What the mcap package raises on damaged files; some of it is not its own.
DAMAGE = (
    McapError,
    ZstdError,
    struct.error,
    ArithmeticError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    EOFError,
)


@dataclass(frozen=True)
class Record:
    """One recorded message.

    Attributes:
        topic: with its leading slash.
        type_name: for example `sensor_msgs/msg/Image`.
        time: when it was recorded [ns].
        data: CDR bytes.
    """

    topic: str
    type_name: str
    time: int
    data: bytes

    def decode(self) -> Any:
        """Return the message as an object of the type store.

        Raises:
            BagError: the bytes are not of the type, or the type is not known.
        """
        try:
            return typestore().deserialize_cdr(self.data, self.type_name)
        except Exception as error:  # The decoder raises whatever the bytes make it stumble over.
            raise BagError(self.topic, f"a message cannot be decoded as {self.type_name}: {error}") from None


class Bag:
    """A recorded bag.

    Args:
        path: an mcap file, or a folder that holds one.

    Attributes:
        topics: type of each topic.
        counts: number of messages of each topic.
        start: time of the first message [ns].
        duration: from the first to the last message [s].
        notes: what was written about the bag by our writer.

    Raises:
        BagError: there is no such bag, it is no mcap, it is cut off, damaged or empty.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = _mcap_file(path)
        _check_ends(self.file)
        try:
            with self.file.open("rb") as stream:
                reader = make_reader(stream, validate_crcs=True)
                summary = reader.get_summary()
                notes = [record.metadata for record in reader.iter_metadata() if record.name == NOTES]
        except DAMAGE as error:
            raise BagError(self.file, _damaged(error)) from None
        if summary is None or summary.statistics is None:
            raise BagError(self.file, "has no summary with statistics, so that nothing says whether it is whole")
        statistics = summary.statistics
        if not statistics.message_count:
            raise BagError(self.file, "holds no messages")
        names = {schema.id: schema.name for schema in summary.schemas.values()}
        self.topics: dict[str, str] = {}
        self.counts: Counter[str] = Counter()
        for channel in summary.channels.values():
            type_name = names.get(channel.schema_id, "")
            if self.topics.setdefault(channel.topic, type_name) != type_name:
                types = f"{self.topics[channel.topic]} and {type_name}"
                raise BagError(self.file, f"topic {channel.topic} has two types, {types}; expected one")
            self.counts[channel.topic] += statistics.channel_message_counts.get(channel.id, 0)
        self.start = statistics.message_start_time
        self._end = statistics.message_end_time
        self.duration = (self._end - self.start) * 1e-9
        self.notes: dict[str, str] = notes[0] if notes else {}

    def records(self, topics: Collection[str] | None = None) -> Iterator[Record]:
        """Go through the messages by time.

        Args:
            topics: only these; all if None.

        Raises:
            BagError: a chunk is damaged.
        """
        try:
            with self.file.open("rb") as stream:
                reader: McapReader = make_reader(stream, validate_crcs=True)
                for schema, channel, message in reader.iter_messages(topics=topics):
                    name = schema.name if schema is not None else ""
                    yield Record(channel.topic, name, message.log_time, message.data)
        except DAMAGE as error:
            raise BagError(self.file, _damaged(error)) from None

    def check(self) -> None:
        """Read all of it once, so that damage is known before anything is made of it.

        The chunks have checksums. The summary, from which topics, types, counts and times come, is held
        against what stands before it.

        Raises:
            BagError: a chunk is damaged, or the summary does not fit the messages.
        """
        found: Counter[tuple[str, str]] = Counter()
        times: list[int] = []
        try:
            with self.file.open("rb") as stream:
                reader = NonSeekingReader(stream, validate_crcs=True)
                for schema, channel, message in reader.iter_messages(log_time_order=False):
                    found[channel.topic, schema.name if schema is not None else ""] += 1
                    time = message.log_time
                    times = [min(times[0], time), max(times[1], time)] if times else [time, time]
        except DAMAGE as error:
            raise BagError(self.file, _damaged(error)) from None
        promised = Counter({(topic, self.topics[topic]): count for topic, count in self.counts.items() if count})
        if found != promised or times != [self.start, self._end]:
            held = f"{sum(found.values())} messages on {len(found)} topics"
            told = f"{sum(promised.values())} on {len(promised)}"
            raise BagError(self.file, f"is damaged: it holds {held}, its summary says {told}, or other types or times")

    def require(self, topic: str, type_name: str) -> None:
        """Raise `BagError` unless the bag has messages of this type on a topic."""
        if not self.counts.get(topic):
            present = ", ".join(sorted(self.topics)) or "none"
            raise BagError(self.path, f"has no messages on {topic} ({type_name}); its topics: {present}")
        if self.topics[topic] != type_name:
            raise BagError(self.path, f"topic {topic} is of type {self.topics[topic]}, expected {type_name}")


def _mcap_file(path: Path) -> Path:
    try:
        path.stat()
        files = [path] if path.is_file() else sorted(path.glob("*.mcap"))
    except FileNotFoundError:
        raise BagError(path, "does not exist; expected an mcap file or the folder of a bag") from None
    except (OSError, ValueError) as error:
        raise BagError(path, f"cannot be read: {error}") from None
    if not files:
        raise BagError(path, "holds no .mcap file")
    if len(files) > 1:
        raise BagError(path, f"holds {len(files)} .mcap files; name one of them")
    return files[0]


def _check_ends(path: Path) -> None:
    """Refuse a file that does not begin or end as an mcap file does."""
    try:
        with path.open("rb") as stream:
            begins = stream.read(len(MAGIC))
            size = stream.seek(0, 2)
            stream.seek(max(0, size - len(MAGIC)))
            ends = stream.read()
    except OSError as error:
        raise BagError(path, f"cannot be read: {error.strerror}") from None
    if begins != MAGIC:
        raise BagError(path, "is no mcap file" if begins else "is empty, expected an mcap file")
    if ends != MAGIC:
        raise BagError(path, f"is cut off after {size} bytes: its end is missing")


def _damaged(error: BaseException) -> str:
    return f"is damaged: {type(error).__name__} {error}".rstrip()
