"""Reads files that a user or a parameter names: whatever they are, reading them ends."""

from __future__ import annotations

import errno
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, cast

from magnetosuture_thread.settings.errors import BagError, RecordingEndedError
from magnetosuture_thread.settings.outputs import output_problem

RANGE_BYTES = 1 << 20  # read at once, at least, of a file that a URL names
# What often stands in the place of a file, by its first bytes: what it is, and what to do.
_SUBSTITUTES = {
    b"version https://git-lfs": "is a pointer of Git LFS, not the file itself; fetch that by: git lfs pull",
    b"#ROSBAG V": "is a bag of ROS 1; convert it by: rosbags-convert --src FILE.bag --dst FOLDER",
}
HEAD_BYTES = max(map(len, _SUBSTITUTES))


def parse_location(text: str) -> Path:
    """Return a path, or for a URL what has the methods of one, such as `open` and `iterdir`; needs the extra `cluster`.

    Args:
        text: a path, or a URL of a file system that fsspec knows, for example `s3://bucket/runs`.

    Raises:
        ValueError: the file system of the URL is not known.
    """
    if "://" not in text:
        return Path(text)
    from upath import UPath

    return cast(Path, UPath(text))


def is_url(path: object) -> bool:
    """Return whether a path was parsed from a URL, so that it is no path of this machine."""
    return not isinstance(path, Path)


def open_ranges(path: Path) -> BinaryIO:
    """Open a file that is read in parts; of a URL only ranges are fetched, of `RANGE_BYTES` beyond what is asked for.

    Raises:
        OSError: it cannot be opened.
    """
    if not is_url(path):
        return path.open("rb")
    opened: BinaryIO = cast(Any, path).open("rb", block_size=RANGE_BYTES, cache_type="readahead")
    return opened


def substitute_problem(head: bytes) -> str:
    """Return what stands in the place of a file by its first `HEAD_BYTES`, and what to do; empty if nothing does."""
    return next((problem for magic, problem in _SUBSTITUTES.items() if head.startswith(magic)), "")


def read_regular(path: Path, max_bytes: int) -> bytes:
    """Return the content of a regular file.

    A pipe without a writer would block whoever opens it, and a device may never end.

    Args:
        path: the file.
        max_bytes: that it may have.

    Raises:
        OSError: it cannot be read, is a folder, pipe or device, is larger, or a pointer of Git LFS stands in its place;
            `strerror` says which.
    """
    if is_url(path):
        with open_ranges(path) as stream:
            return _checked(stream.read(max_bytes + 1), path, max_bytes)
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
    return _checked(b"".join(parts), path, max_bytes)


def _checked(content: bytes, path: Path, max_bytes: int) -> bytes:
    if len(content) > max_bytes:
        raise OSError(errno.EFBIG, "a larger file", str(path))
    if problem := substitute_problem(content):
        raise OSError(errno.EINVAL, f"it {problem}", str(path))
    return content


def _require_regular(status: os.stat_result, path: Path) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "a folder, pipe or device", str(path))


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
