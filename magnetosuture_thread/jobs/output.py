"""Folders that a job makes whole or not at all."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from magnetosuture_thread.errors import BagError


@contextmanager
def whole_folder(output: Path) -> Iterator[Path]:
    """Give a folder to fill, which takes its name only when the block ends without an error.

    Args:
        output: the folder to make; must not exist.

    Yields:
        A hidden folder beside it. Whatever ends the block early, nothing of it is left.

    Raises:
        BagError: the output exists or cannot be written.
    """
    partial = output.with_name(f".{output.name}.partial")
    made: list[Path] = []
    try:
        if output.exists() or output.is_symlink():
            raise BagError(output, "exists already; expected a new folder")
        shutil.rmtree(partial, ignore_errors=True)
        made = [folder for folder in output.absolute().parents if not folder.exists()]
        partial.mkdir(parents=True)
        yield partial
        partial.rename(output)
        made = []
    except OSError as error:
        raise BagError(output, f"cannot be written: {error.strerror or error}") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        for folder in made:
            if folder.exists() and not any(folder.iterdir()):
                folder.rmdir()
