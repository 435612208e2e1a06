"""Records of an mcap file, taken apart strictly: what is not exactly a record is refused.

The package `mcap` parses what a writer meant; it takes short reads and left-over bytes for good. Here a record
must be as long as its head says, since that is how a head that leads astray is noticed.

Source: the MCAP specification, https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from io import BytesIO
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC = b"\x89MCAP0\r\n"  # an mcap file's first and last bytes
HEAD = struct.Struct("<BQ")  # of every record: kind and length of what follows
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; then the data
PRIVATE = 0x80  # kinds of records from here on are anybody's own
LARGEST = 1 << 30  # bytes of a chunk, packed or not, that are taken into memory

_READERS: dict[int, Callable[[ReadDataStream], Any]] = {
    Opcode.HEADER: Header.read,
    Opcode.FOOTER: Footer.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.MESSAGE_INDEX: MessageIndex.read,
    Opcode.CHUNK_INDEX: ChunkIndex.read,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex.read,
    Opcode.STATISTICS: Statistics.read,
    Opcode.METADATA: Metadata.read,
    Opcode.METADATA_INDEX: MetadataIndex.read,
    Opcode.SUMMARY_OFFSET: SummaryOffset.read,
    Opcode.DATA_END: DataEnd.read,
}


class BrokenError(Exception):
    """Bytes that are not what they should be; the text says what they are instead."""


def is_kind(opcode: int) -> bool:
    """Return whether there is such a kind of record."""
    return Opcode.HEADER <= opcode <= Opcode.DATA_END or opcode >= PRIVATE


def parse(opcode: int, body: bytes) -> Any:
    """Return a record of the package `mcap`, or None where nothing of it is needed.

    Raises:
        BrokenError: the bytes are no such record.
    """
    reader = _READERS.get(opcode)
    if reader is None:
        return None
    stream = ReadDataStream(BytesIO(body))
    name = Opcode(opcode).name.lower().replace("_", " ")
    try:
        record = reader(stream)
    except (McapError, struct.error, UnicodeDecodeError, MemoryError, OverflowError):
        raise BrokenError(f"a broken {name}") from None
    if stream.count != len(body):
        raise BrokenError(f"a {name} of a wrong length")
    return record


def records_in(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Go through the records of a chunk: kind, start and end of what follows the head.

    Raises:
        BrokenError: they do not fill the chunk exactly.
    """
    position, size = 0, len(content)
    while position < size:
        if position + HEAD.size > size:
            raise BrokenError("a chunk with a broken record")
        opcode, length = HEAD.unpack_from(content, position)
        start = position + HEAD.size
        position = start + length
        if position > size or (opcode == Opcode.MESSAGE and length < MESSAGE.size):
            raise BrokenError("a chunk with a broken record")
        yield opcode, start, position
