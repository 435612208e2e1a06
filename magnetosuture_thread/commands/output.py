"""Files and folders that a command makes whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from magnetosuture_thread.bags.writer import RecordingEndedError
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.outputs import output_problem


@contextmanager
def whole_folder(output: Path, *, is_recording: bool = False) -> Iterator[Path]:
    """Yield a folder to fill; it is renamed to its final name only when the block ends without an error.

    Args:
        output: the folder to make; must not exist.
        is_recording: whether it is a recording, which cannot be made again: when the disk is full, what was
            recorded before stays.

    Yields:
        A hidden folder beside it. Whatever else ends the block early, nothing of it is left.

    Raises:
        RecordingEndedError: the disk is full; what was recorded is in the output.
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
    except RecordingEndedError as error:
        if partial is None:
            raise
        if not is_recording:  # nothing of it stays: no file is named
            raise BagError(output, f"cannot be written: {error.cause}") from None
        partial.rename(output)
        made = []
        raise RecordingEndedError(output, error.cause, output / error.file.relative_to(partial)) from None
    except OSError as error:
        raise BagError(output, f"cannot be written: {error.strerror or error}") from None
    finally:
        if partial is not None:
            shutil.rmtree(partial, ignore_errors=True)
        for folder in made:
            if folder.exists() and not any(folder.iterdir()):
                folder.rmdir()


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a file to write; it is renamed to its final name only when the block ends without an error.

    Args:
        path: the file to make; a regular one that is there is replaced then.

    Yields:
        A hidden file beside it.

    Raises:
        BagError: it cannot be written, or is something else than a regular file.
    """
    partial: Path | None = None
    try:
        if problem := output_problem(path):
            raise BagError(path, problem)
        handle, made = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.absolute().parent)
        os.close(handle)
        partial = Path(made)
        yield partial
        partial.chmod(0o644)
        partial.replace(path)
        partial = None
    except OSError as error:
        raise BagError(path, f"cannot be written: {error.strerror or error}") from None
    finally:
        if partial is not None:
            partial.unlink(missing_ok=True)
