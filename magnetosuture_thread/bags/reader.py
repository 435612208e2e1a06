"""Reads bags: looks through all of one as it is opened, then goes through its messages by time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

from magnetosuture_thread.bags.damage import Damage, Place, together
from magnetosuture_thread.bags.definitions import Decoder
from magnetosuture_thread.bags.folder import bag_files
from magnetosuture_thread.bags.mcap.file import McapFile
from magnetosuture_thread.bags.message_packing import unpacked
from magnetosuture_thread.bags.remap import renamed
from magnetosuture_thread.bags.sqlite import SqliteFile
from magnetosuture_thread.bags.storage import CDR, Connection, Definition, Item, Storage, in_order
from magnetosuture_thread.errors import BagError

Progress = Callable[[float], None]
_decoder = cache(Decoder)


@dataclass(slots=True)  # not frozen: such a one takes four times as long to make, and a bag has many
class Record:
    """One recorded message; nobody changes one.

    Attributes:
        topic: with its leading slash.
        type_name: for example `sensor_msgs/msg/Image`.
        time: when it was recorded [ns].
        data: CDR bytes.
        definition: of its type, as the bag has it; ours if None.
    """

    topic: str
    type_name: str
    time: int
    data: bytes
    definition: Definition | None = field(default=None, repr=False, compare=False)

    @property
    def decoder(self) -> Decoder:
        """Return what decodes messages of this type."""
        return _decoder(self.definition or Definition(self.type_name))

    def decode(self) -> Any:
        """Return the message as an object of a type store.

        Raises:
            BagError: the bytes are not of the type, or the type is not known.
        """
        return self.decoder.decode(self.topic, self.data)


class Bag:
    """A recorded bag: mcap or sqlite3, one file or several, whole or damaged.

    It is looked through as it is opened, with every checksum, so that damage is known before anything is made of
    the bag. What is intact is read; nothing that may be wrong is (see `bags/mcap/verdict.py` for the rule).

    Args:
        path: a file, or the folder of a bag.
        remap: new name of a topic by its recorded name.
        progress: called with the share looked through, 0 to 1.

    Attributes:
        path: as it was given.
        topics: type of each topic, but for those in `conflicts`.
        conflicts: types of each topic that has more than one.
        counts: number of messages of each topic.
        start: time of the first message [ns].
        end: time of the last message [ns].
        duration: from the first to the last message [s].
        notes: what was written about the bag by our writer.
        damage: what is broken and lost; None if the bag is whole. Its text is one line for a person.
        unchecked: why damage may not have been noticed, in one line; empty if it would have been.
        facts: of each file, for a person: name and value.

    Raises:
        BagError: there is no such bag, it cannot be read, nothing intact is in it, or there is no such topic to
            remap.
    """

    def __init__(
        self, path: Path, *, remap: Mapping[str, str] | None = None, progress: Progress = lambda share: None
    ) -> None:
        self.path = path
        found = bag_files(path)
        self._storages, problems = _open(found.files, progress)
        places = [Place(name, 0, 0, "it is missing") for name in found.missing]
        lost = [Damage((place,), 0, place.end, None) for place in (*places, *problems)]
        self.damage = together([*(storage.damage for storage in self._storages), *lost])
        self.unchecked = next((storage.unchecked for storage in self._storages if storage.unchecked), "")
        self.facts = [{"file": storage.path.name, **storage.facts} for storage in self._storages]
        self.notes = next((storage.notes for storage in self._storages if storage.notes), found.notes)
        if not any(storage.counts for storage in self._storages):
            raise BagError(found.files[0], f"{self.damage}; nothing intact" if self.damage else "holds no messages")
        filled = [storage for storage in self._storages if storage.counts]
        self.start = min(storage.start for storage in filled)
        self.end = max(storage.end for storage in filled)
        self.duration = (self.end - self.start) * 1e-9
        recorded = {c.topic for storage in self._storages for c in storage.connections.values()}
        self._names = renamed(path, recorded, remap or {})
        self.counts: Counter[str] = Counter()
        types: dict[str, dict[str, None]] = {}
        for storage in self._storages:
            for number, connection in storage.connections.items():
                name, count = self._names[connection.topic], storage.counts.get(number, 0)
                self.counts[name] += count
                types.setdefault(name, {})[connection.type_name] = None
        self.topics = {name: next(iter(own)) for name, own in types.items() if len(own) == 1}
        self.conflicts = {name: tuple(own) for name, own in types.items() if len(own) > 1}

    def records(
        self,
        topics: Collection[str] | None = None,
        *,
        start: float = 0.0,
        duration: float | None = None,
        refused: Counter[str] | None = None,
    ) -> Iterator[Record]:
        """Go through the messages by time, without ever holding more than some chunks in memory.

        Args:
            topics: only these; all that have one type if None. Those that the bag lacks give nothing.
            start: only messages from this time on [s since the bag's start].
            duration: only messages until this time after `start` [s]; all that follow if None.
            refused: to count messages in, by the reason, that cannot be unpacked or are no CDR; None to raise.

        Raises:
            BagError: one of the topics has two types, or the bag has changed since it was opened.
        """
        for topic in topics or ():
            self._refuse_two_types(topic)
        return self._records(set(self.topics if topics is None else topics), start, duration, refused)

    def every_record(self, refused: Counter[str]) -> Iterator[tuple[Connection, Record]]:
        """Go through all messages by time, each with where it comes from.

        Those of topics with two types, and those that are no CDR, are among them.

        Args:
            refused: to count messages in, by the reason, that cannot be unpacked.
        """
        for item in self._items(set(self.counts), 0.0, None):
            record = self._unless_refused(item, refused)
            if record is not None:
                yield item.connection, record

    def connections(self) -> Iterable[Connection]:
        """Return what each publisher said on each topic, under its recorded name."""
        return [connection for storage in self._storages for connection in storage.connections.values()]

    def name_of(self, connection: Connection) -> str:
        """Return the name of a connection's topic once it is remapped."""
        return self._names[connection.topic]

    def require(self, topic: str, type_name: str) -> None:
        """Raise `BagError` unless the bag has messages of this type on a topic."""
        if not self.counts.get(topic):
            present = ", ".join(sorted({*self.topics, *self.conflicts})) or "none"
            raise BagError(self.path, f"has no messages on {topic} ({type_name}); its topics: {present}")
        self._refuse_two_types(topic)
        if self.topics[topic] != type_name:
            raise BagError(self.path, f"topic {topic} is of type {self.topics[topic]}, expected {type_name}")

    def _refuse_two_types(self, topic: str) -> None:
        if topic in self.conflicts:
            types = " and ".join(self.conflicts[topic])
            raise BagError(self.path, f"topic {topic} has two types, {types}; expected one")

    def _records(
        self, topics: Collection[str], start: float, duration: float | None, refused: Counter[str] | None
    ) -> Iterator[Record]:
        for item in self._items(topics, start, duration):
            record = self._unless_refused(item, refused, only=CDR)
            if record is not None:
                yield record

    def _unless_refused(self, item: Item, refused: Counter[str] | None, only: str = "") -> Record | None:
        """Return a message; None, once it is counted, if it cannot be unpacked or is written in another way."""
        connection = item.connection
        topic = self._names[connection.topic]
        try:
            if only and connection.serialization != only:
                raise BagError(topic, f"its messages are written as {connection.serialization!r}, expected {only!r}")
            data = unpacked(topic, item.data)
        except BagError as error:
            if refused is None:
                raise
            refused[str(error)] += 1
            return None
        return Record(topic, connection.type_name, item.time, data, connection.definition)

    def _items(self, topics: Collection[str], start: float, duration: float | None) -> Iterator[Item]:
        first = self.start + round(start * 1e9)
        last = self.end if duration is None else first + round(duration * 1e9)
        parts = []
        for storage in sorted(self._storages, key=lambda storage: storage.start):
            told = storage.connections.items()
            wanted = [number for number, connection in told if self._names[connection.topic] in topics]
            if wanted:
                parts.append((storage.start, partial(storage.items, wanted, first, last)))
        return in_order(parts)


def _open(files: list[Path], progress: Progress) -> tuple[list[Storage], list[Place]]:
    """Open the files of a bag; of several, those that cannot be read at all are told as broken places."""
    storages: list[Storage] = []
    problems: list[Place] = []
    total, done = sum(_size(file) for file in files), 0

    def come_on(count: int) -> None:
        nonlocal done
        done += count
        progress(min(1.0, done / max(total, 1)))

    for file in files:
        try:
            storages.append(SqliteFile(file, come_on) if file.suffix == ".db3" else McapFile(file, come_on))
        except BagError as error:
            if len(files) == 1:
                raise
            problems.append(Place(file.name, 0, _size(file), error.problem))
    if not storages:
        raise BagError(files[0].parent, f"holds no file that can be read; {problems[0]}")
    return storages, problems


def _size(file: Path) -> int:
    try:
        return file.stat().st_size
    except OSError:
        return 0
