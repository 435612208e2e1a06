"""Messages that a recorder packed one by one (rosbag2's compression mode `message`)."""

from __future__ import annotations

import zstandard

from magnetosuture_thread.errors import BagError

_ZSTD = b"\x28\xb5\x2f\xfd"  # no CDR message begins like this: its first byte is 0
_MAX_MESSAGE_BYTES = 1 << 30  # bytes of a message


def unpacked(topic: str, data: bytes) -> bytes:
    """Return a message as it was before the recorder packed it, if it did.

    Raises:
        BagError: it cannot be unpacked.
    """
    if not data.startswith(_ZSTD):
        return data
    try:
        if zstandard.frame_content_size(data) > _MAX_MESSAGE_BYTES:
            raise BagError(topic, f"a packed message is larger than {_MAX_MESSAGE_BYTES} bytes")
        # Without a size in it, a frame is unpacked to this many bytes at most.
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=1 << 27)
    except (zstandard.ZstdError, MemoryError) as error:
        raise BagError(topic, f"a packed message cannot be unpacked: {error}") from None
