"""Decides what of an mcap file is used, and says what is broken and lost.

Nothing that may be wrong is used. A chunk with a right checksum is used. What has no checksum (messages outside of
chunks, chunks of writers that make none, and the channels told there) is used only where the checksum of all data
is right, or where the file is whole as far as anybody can see: every record parses, and it has an end and a summary
that agrees with the messages. In a file with any other damage it is not used.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

from mcap.records import Channel, Schema

from magnetosuture_thread.bags.damage import Damage, Place, counted
from magnetosuture_thread.bags.mcap.index import Findings, Piece
from magnetosuture_thread.bags.mcap.inventory import Inventory, compare
from magnetosuture_thread.bags.mcap.summary import Summary
from magnetosuture_thread.bags.notes import NOTES, opened
from magnetosuture_thread.bags.storage import Connection, Definition

UNCHECKED = "has no checksums: damage to it cannot be noticed"
PARTLY_UNCHECKED = "has messages without a checksum: damage to them cannot be noticed"

Recount = Callable[[Piece], Counter[int]]


@dataclass(frozen=True)
class Verdict:
    """What of a file is used.

    Attributes:
        pieces: those to read, in the file's order.
        connections: by channel, as far as they are known for sure.
        counts: messages to read, by channel.
        notes: what our writer said of the bag.
        damage: what is broken; None if nothing is.
        unchecked: why damage may not have been noticed; else empty.
    """

    pieces: list[Piece]
    connections: dict[int, Connection]
    counts: dict[int, int]
    notes: dict[str, str]
    damage: Damage | None
    unchecked: str


def judge(name: str, size: int, found: Findings, summary: Summary | None, recount: Recount) -> Verdict:
    """Return what of a file is used.

    Args:
        name: of the file.
        size: its length in bytes.
        found: by the walk through it.
        summary: what its summary says, if it has one.
        recount: tells how many messages each channel has in a piece.
    """
    trusted = summary if summary is not None and summary.trusted else None
    inventory = compare(found, trusted)
    pieces, counts, unchecked = inventory.pieces, Counter(found.counts), Counter(found.unchecked_counts)
    for piece in inventory.strangers:
        strange = recount(piece)
        counts -= strange
        if not piece.checked:
            unchecked -= strange
    places = _broken(name, found, inventory)
    places = _cut_off(name, size, found, places) if summary is None else places + _ends(name, size, found, summary)
    places += [Place(name, p.offset, p.offset + p.length, inventory.strange) for p in inventory.strangers]
    clean = not found.broken and not found.private and found.ended
    if summary is not None and not places and (problem := _contradiction(summary, pieces, counts)):
        places.append(Place(name, summary.start, summary.end, problem))
        clean = False
    if found.data_crc and not found.data_is_right and not places:
        what = "something that holds no messages is not what was written"
        places.append(Place(name, 0, found.stopped, what))
    known = sum(counts.values())
    vouched = found.data_is_right or not places
    if not vouched and (loose := [piece for piece in pieces if not piece.checked]):
        pieces = [piece for piece in pieces if piece.checked]
        counts -= unchecked
        what = f"{counted(known - sum(counts.values()), 'message')} without a checksum, which may be wrong"
        places.append(Place(name, loose[0].offset, loose[-1].offset + loose[-1].length, what))
    connections = _connections(found, trusted, vouched)
    for channel in sorted(set(+counts) - set(connections)):
        piece = next(piece for piece in pieces if channel in piece.channels)
        what = f"{counted(counts.pop(channel), 'message')} of a topic that is told nowhere, or in two ways"
        places.append(Place(name, piece.offset, piece.offset + piece.length, what))
    damage = None
    if places:
        lost = _lost(trusted, clean or found.data_is_right, known, sum(counts.values()))
        if lost == 0:
            places = [replace(place, first=None, last=None) for place in places]
        broken_bytes = sum(place.end - place.start for place in (*found.broken, *_followed(name, size, summary)))
        chunks = len(inventory.missing) if inventory.is_sure else found.chunks_lost
        damage = Damage(tuple(sorted(places, key=lambda place: place.start)), chunks, broken_bytes, lost)
    return Verdict(
        pieces=pieces,
        connections=connections,
        counts={channel: counts[channel] for channel in connections if counts[channel]},
        notes=_notes(found),
        damage=damage,
        unchecked=_unchecked(found, pieces),
    )


def _broken(name: str, found: Findings, inventory: Inventory) -> list[Place]:
    """Return the broken places, with the times between which messages are missing."""
    places = list(found.broken)
    missing = list(inventory.missing)
    for index, place in enumerate(places):
        inside = [c for c in missing if inventory.in_place and place.start <= c.offset < place.end]
        if inside:
            missing = [c for c in missing if c not in inside]
            first = min(chunk.start for chunk in inside)
            places[index] = replace(place, first=first, last=max(chunk.end for chunk in inside))
        else:
            following = (piece.start for piece in inventory.pieces if piece.offset >= place.end)
            places[index] = replace(place, last=next(following, None))
    if not inventory.in_place and places:
        return places  # they are missing there; which one where is not known
    return places + [
        Place(
            name,
            chunk.offset,
            chunk.offset + chunk.length,
            "a chunk is missing",
            chunk.start,
            chunk.end,
        )
        for chunk in missing
    ]


def _cut_off(name: str, size: int, found: Findings, broken: list[Place]) -> list[Place]:
    """Return the broken places of a file without a summary, its missing end among them."""
    if found.ended:
        return [*broken, Place(name, found.stopped, size, "its summary is missing or broken")]
    if broken and broken[-1].end == size:
        return [*broken[:-1], replace(broken[-1], what="it is cut off or broken from here to its end")]
    return [*broken, Place(name, size, size, "it is cut off", found.pieces[-1].end if found.pieces else None)]


def _ends(name: str, size: int, found: Findings, summary: Summary) -> list[Place]:
    """Return what is wrong with the end of a file that has a summary."""
    places = _followed(name, size, summary)
    if not found.ended and not found.broken:
        places.append(Place(name, found.stopped, found.stopped, "the end of its data is missing"))
    if summary.shifted and not found.broken:
        places.append(Place(name, 0, found.stopped, "bytes are missing in it, or were put in"))
    return places


def _followed(name: str, size: int, summary: Summary | None) -> list[Place]:
    if summary is None or not summary.followed:
        return []
    return [Place(name, size - summary.followed, size, "bytes after its end")]


def _contradiction(summary: Summary, pieces: list[Piece], counts: Counter[int]) -> str:
    """Return in what a summary does not agree with the messages; empty if it does."""
    told = summary.statistics
    if told is None:
        return ""
    if told.message_count != counts.total():
        return f"its summary says {counted(told.message_count, 'message')}, it holds {counts.total()}"
    told_counts = {channel: count for channel, count in told.channel_message_counts.items() if count}
    if told_counts and told_counts != +counts:
        return "its summary says other counts of messages than it holds"
    held = [piece for piece in pieces if piece.channels]
    if held and (told.message_start_time, told.message_end_time) != (
        min(piece.start for piece in held),
        max(piece.end for piece in held),
    ):
        return "its summary says other times than its messages"
    return ""


def _lost(trusted: Summary | None, all_was_seen: bool, known: int, used: int) -> int | None:
    """Return the number of lost messages, where anybody can know.

    Args:
        trusted: the summary, if it can be trusted.
        all_was_seen: whether there can be no messages besides those that were found.
        known: number of messages found.
        used: number of them that are used.
    """
    if trusted is not None and trusted.statistics is not None:
        return max(0, trusted.statistics.message_count - used)
    return known - used if all_was_seen else None


def _connections(found: Findings, trusted: Summary | None, vouched: bool) -> dict[int, Connection]:
    """Return the channels that are told in one way only, by something with a right checksum."""
    sources: list[tuple[dict[int, Schema], dict[int, Channel]]] = [
        (told.schemas, told.channels) for checked, told in found.told.items() if checked or vouched
    ]
    if trusted is not None:
        sources.append((trusted.schemas, trusted.channels))
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    for own_schemas, own_channels in sources:
        wrong_schemas = {key for key, schema in own_schemas.items() if schemas.setdefault(key, schema) != schema}
        wrong = {key for key, channel in own_channels.items() if channels.setdefault(key, channel) != channel}
        found.told[True].schemas_in_two_ways |= wrong_schemas
        found.told[True].channels_in_two_ways |= wrong
    two_ways = [told for checked, told in found.told.items() if checked or vouched]
    bad_channels = set().union(*(told.channels_in_two_ways for told in two_ways))
    bad_schemas = set().union(*(told.schemas_in_two_ways for told in two_ways))
    known: dict[int, Connection] = {}
    for key, channel in channels.items():
        schema = schemas.get(channel.schema_id)
        if key in bad_channels or channel.schema_id in bad_schemas or (channel.schema_id and schema is None):
            continue
        known[key] = Connection(channel.topic, _definition(schema), channel.message_encoding, channel.metadata)
    return known


def _definition(schema: Schema | None) -> Definition:
    if schema is None:
        return Definition("")
    return Definition(schema.name, schema.encoding, schema.data.decode("utf-8", "replace"))


def _notes(found: Findings) -> dict[str, str]:
    for record in found.metadata:
        if record.name == NOTES and (notes := opened(record.metadata, vouched=found.data_is_right)) is not None:
            return notes
    return {}


def _unchecked(found: Findings, pieces: list[Piece]) -> str:
    if found.data_is_right or all(piece.checked for piece in pieces):
        return ""
    return PARTLY_UNCHECKED if any(piece.checked for piece in pieces) else UNCHECKED
