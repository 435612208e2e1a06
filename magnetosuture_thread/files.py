"""Reads files that a user or a parameter names: whatever they are, reading them ends."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path


def read_regular(path: Path, max_bytes: int) -> bytes:
    """Return the content of a regular file.

    A pipe without a writer would block whoever opens it, and a device may never end.

    Args:
        path: the file.
        max_bytes: that it may have.

    Raises:
        OSError: it cannot be read, is a folder, pipe or device, or is larger; `strerror` says which.
    """
    _require_regular(os.stat(path), path)  # before it is opened, which may do something to a device
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _require_regular(os.fstat(descriptor), path)
        parts, left = [], max_bytes + 1
        while left and (part := os.read(descriptor, left)):
            parts.append(part)
            left -= len(part)
    finally:
        os.close(descriptor)
    if not left:
        raise OSError(errno.EFBIG, "a larger file", str(path))
    return b"".join(parts)


def _require_regular(status: os.stat_result, path: Path) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "a folder, pipe or device", str(path))
