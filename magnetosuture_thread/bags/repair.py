"""Writes what of a bag can be vouched for into a new one, as it was stored."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from magnetosuture_thread.bags.bag_folder import QOS, UNCHECKED_NOTE, UNVERIFIED_NOTE, jazzy_qos_profiles
from magnetosuture_thread.bags.mcap.writer import LIBRARY
from magnetosuture_thread.bags.message_types import own_definition
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.sanity import SanityCheck
from magnetosuture_thread.bags.storage import CDR, Connection
from magnetosuture_thread.bags.writer import MAX_TIME, BagWriter
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.texts import shortened

RECORDER_NOTE = "recorder"  # note of a repaired bag: which library wrote the one before


@dataclass
class RepairReport:
    """What became of a bag.

    Attributes:
        messages: that the new bag holds.
        refused: messages that it does not, by reason.
        dropped: other records that it does not, by kind.
        unpacked: messages that the recorder had packed one by one, and that are not in the new bag.
        defined: types that had no definition, and have ours.
        kept: attachments and metadata records.
        rewritten: topics whose quality of service is written by name, as Jazzy reads it.
    """

    messages: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    unpacked: int = 0
    defined: list[str] = field(default_factory=list)
    kept: int = 0
    rewritten: list[str] = field(default_factory=list)

    @property
    def is_same(self) -> bool:
        """Return whether the new bag holds everything, as it was."""
        return not (self.refused or self.dropped or self.unpacked or self.defined or self.rewritten)


def write_repaired_bag(
    bag: Bag,
    folder: Path,
    name: str,
    *,
    unverified: bool = False,
    progress: Callable[[float], None] = lambda fraction: None,
) -> RepairReport:
    """Write every message of a bag that can be vouched for into a new one, with its notes, definitions and attachments.

    The bytes of messages, definitions, attachments and metadata records stay as they are; so do times and numbers of
    messages, the profile, and entries of others in metadata.yaml. Messages that the recorder packed one by one, as the
    storage says, are unpacked, and topics have their remapped names. Types keep the definitions of the bag; ours is
    written where it has none and we know the type. Chunks, indices, statistics and metadata.yaml are made anew.

    Args:
        bag: the bag to repair.
        folder: of the new one; must be empty.
        name: of the new one.
        unverified: whether to salvage from a damaged bag without checksums what passes `SanityCheck`. The new bag is
            marked by a note, so that it is never taken for sound.
        progress: called with the completed fraction, 0 to 1.

    Raises:
        BagError: nothing vouches for the bag and `unverified` is not given, or the new bag cannot be written.
    """
    if bag.unverified and not unverified:
        problem = f"is {bag.unverified}; --unverified salvages what passes checks of its values, marked as unverified"
        raise BagError(bag.path, problem)
    notes = dict(bag.notes)
    if bag.unverified:
        notes[UNVERIFIED_NOTE] = bag.unverified
    elif bag.unchecked:
        notes.setdefault(UNCHECKED_NOTE, f"made by `bag repair` from a bag that {bag.unchecked}")
    if bag.library and bag.library != LIBRARY:
        notes.setdefault(RECORDER_NOTE, shortened(bag.library))
    check = SanityCheck(bag) if bag.unverified else None
    report = RepairReport()
    numbers: dict[Connection, int] = {}
    with BagWriter(folder, notes, name=name, profile=shortened(bag.profile), custom_data=bag.custom_data) as writer:
        for extra in bag.extras(report.dropped):
            writer.add_extra(extra)
            report.kept += 1
        for connection in bag.connections():
            if connection not in numbers:
                numbers[connection] = writer.add_connection(_defined(bag, connection, report))
        for item in bag.stored():
            try:
                problem = check.problem(item) if check is not None else ""
                if problem or item.time > MAX_TIME:
                    raise BagError(bag.name_of(item.connection), problem or "a time that cannot be")
                data = bag.load(item)
            except BagError as error:
                report.refused[str(error)] += 1
                continue
            writer.write_to(
                numbers[item.connection], item.time, data, publish_time=item.publish_time, sequence=item.sequence
            )
            report.messages += 1
            report.unpacked += data is not item.data
            progress((item.time - bag.start) / max(bag.end - bag.start, 1))
    return report


def _defined(bag: Bag, connection: Connection, report: RepairReport) -> Connection:
    """Return a connection as it is written to the new bag."""
    definition = connection.definition
    if not definition.text and connection.serialization == CDR:
        own = own_definition(definition.type_name)
        if own.text:
            definition = own
            report.defined.append(own.type_name)
    profiles = connection.metadata.get(QOS, "")
    if jazzy_qos_profiles(profiles) != profiles:
        report.rewritten.append(bag.name_of(connection))
    return replace(connection, topic=bag.name_of(connection), definition=definition)
