"""Writes what is intact in a bag into a new one that is whole."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.storage import Connection
from magnetosuture_thread.bags.writer import BagWriter, our_definition


def repair(
    bag: Bag,
    folder: Path,
    name: str,
    refused: Counter[str],
    progress: Callable[[float], None] = lambda share: None,
) -> int:
    """Write every intact message of a bag into a new one, with its notes and definitions.

    Types keep the bag's own definitions; only where it has none and we know the type, ours is written. Packed
    messages are unpacked, and topics have the names that they were remapped to.

    Args:
        bag: the old one.
        folder: of the new one; must be empty.
        name: of the new one.
        refused: to count messages in, by the reason, that cannot be unpacked.
        progress: called with the share done, 0 to 1.

    Returns:
        The number of messages.

    Raises:
        BagError: the new bag cannot be written.
    """
    numbers: dict[Connection, int] = {}
    count = 0
    with BagWriter(folder, bag.notes, name=name) as writer:
        for connection in bag.connections():
            if connection not in numbers:
                numbers[connection] = writer.add_connection(_told(bag, connection))
        for connection, record in bag.every_record(refused):
            writer.write_to(numbers[connection], record.time, record.data)
            count += 1
            progress((record.time - bag.start) / max(bag.end - bag.start, 1))
    return count


def _told(bag: Bag, connection: Connection) -> Connection:
    """Return a connection as the new bag tells it."""
    definition = connection.definition
    if not definition.text:
        definition = our_definition(definition.type_name)
    return replace(connection, topic=bag.name_of(connection), definition=definition)
