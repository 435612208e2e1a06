"""Folders that a job makes whole or not at all."""

from __future__ import annotations

import shutil
import tempfile
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
    partial: Path | None = None
    made: list[Path] = []
    try:
        if output.exists() or output.is_symlink():
            raise BagError(output, "exists already; expected a new folder")
        parent = output.absolute().parent
        made = [folder for folder in (parent, *parent.parents) if not folder.exists()]
        parent.mkdir(parents=True, exist_ok=True)
        # A name of its own for every run: two runs to one output must not take each other's folder.
        partial = Path(tempfile.mkdtemp(prefix=f".{output.name}.", dir=parent))
        partial.chmod(0o755)
        yield partial
        partial.rename(output)
        made = []
    except OSError as error:
        raise BagError(output, f"cannot be written: {error.strerror or error}") from None
    finally:
        if partial is not None:
            shutil.rmtree(partial, ignore_errors=True)
        for folder in made:
            if folder.exists() and not any(folder.iterdir()):
                folder.rmdir()
