"""Repairs a bag: writes its intact messages into a new one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from magnetosuture_thread.bags.message_types import own_definition
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.storage import Connection
from magnetosuture_thread.bags.writer import BagWriter


def write_repaired_bag(
    bag: Bag,
    folder: Path,
    name: str,
    refused: Counter[str],
    progress: Callable[[float], None] = lambda fraction: None,
) -> int:
    """Write every intact message of a bag into a new one, with its notes and definitions.

    Types keep the definitions of the bag; ours is written where it has none and we know the type. Compressed messages
    are decompressed, and topics have their remapped names.

    Args:
        bag: the bag to repair.
        folder: of the new one; must be empty.
        name: of the new one.
        refused: counts the messages that cannot be decompressed, by reason.
        progress: called with the completed fraction, 0 to 1.

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
                numbers[connection] = writer.add_connection(_defined(bag, connection))
        for connection, record in bag.every_record(refused):
            writer.write_to(numbers[connection], record.time, record.data)
            count += 1
            progress((record.time - bag.start) / max(bag.end - bag.start, 1))
    return count


def _defined(bag: Bag, connection: Connection) -> Connection:
    """Return a connection as it is written to the new bag."""
    definition = connection.definition
    if not definition.text:
        definition = own_definition(definition.type_name)
    return replace(connection, topic=bag.name_of(connection), definition=definition)
