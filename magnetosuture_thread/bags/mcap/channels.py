"""Channels and schemas of an mcap file, and conflicts between their definitions."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from mcap.records import Channel, Schema

from magnetosuture_thread.bags.storage import Connection, MessageDefinition


@dataclass
class ChannelTable:
    """Channels and schemas as they are defined in some part of a file.

    Attributes:
        schemas: definitions by schema id; two or more conflict.
        channels: definitions by channel id; two or more conflict.
    """

    schemas: dict[int, list[Schema]] = field(default_factory=dict)
    channels: dict[int, list[Channel]] = field(default_factory=dict)

    def add(self, record: Schema | Channel) -> None:
        """Add a definition unless the same one is known."""
        table: dict[int, list[Any]] = self.schemas if isinstance(record, Schema) else self.channels
        versions = table.setdefault(record.id, [])
        if len(versions) < 2 and record not in versions:  # two are a conflict already
            versions.append(record)

    def update(self, other: ChannelTable) -> None:
        """Add all definitions of another table."""
        tables: list[dict[int, list[Any]]] = [other.schemas, other.channels]
        for record in (record for table in tables for versions in table.values() for record in versions):
            self.add(record)

    def connections(self) -> dict[int, Connection]:
        """Return the channels whose definition, and that of their schema, is without conflict."""
        known: dict[int, Connection] = {}
        for number, versions in self.channels.items():
            channel = versions[0]
            schemas = self.schemas.get(channel.schema_id, [])
            if len(versions) > 1 or len(schemas) > 1 or (channel.schema_id and not schemas):
                continue
            definition = MessageDefinition("")
            if schemas:
                text = schemas[0].data.decode("utf-8", "replace")
                definition = MessageDefinition(schemas[0].name, schemas[0].encoding, text)
            known[number] = Connection(channel.topic, definition, channel.message_encoding, channel.metadata)
        return known
