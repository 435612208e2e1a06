"""Room on a disk that is kept for when it is full."""

from __future__ import annotations

import os
from pathlib import Path


class Reserve:
    """A file that holds nothing but room.

    Args:
        path: the file; made when there is something to keep, and deleted by `release`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._size = 0

    def grow(self, size: int) -> None:
        """Keep this many bytes at least.

        Raises:
            OSError: there is no more room.
        """
        if size <= self._size:
            return
        size = 2 * size  # and for a while to come
        with self._path.open("ab") as stream:
            os.posix_fallocate(stream.fileno(), 0, size)
        self._size = size

    def release(self) -> None:
        """Give the room free."""
        self._path.unlink(missing_ok=True)
