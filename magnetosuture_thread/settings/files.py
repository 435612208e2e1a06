"""Files: what may be read and how much of it, what may be written and when, and the files that ship with the package.

A file of a few bytes may ask for hours or gigabytes: an endless device, aliases in aliases, lists in lists. Every
reader goes through `read_regular` and `check_yaml`, which refuse what is past the bounds below in one line.
"""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import stat
import sysconfig
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import cast

import yaml

from magnetosuture_thread.settings.errors import BagError, ConfigurationError, RecordingEndedError
from magnetosuture_thread.settings.interface import STORAGE_SUFFIXES

MAX_FILE_BYTES = 1 << 26  # of a file or message that is read whole
MAX_TEXT_BYTES = 4_000_000  # of a setup, scene, metadata.yaml or table; 80,000 lines of 50 characters
MAX_PIXELS = 25_000_000  # of a picture: with 16 bits for each of three colours 150 MB
MAX_YAML_DEPTH = 20
MAX_YAML_EVENTS = 500_000  # values, keys, beginnings and ends of lists: 2 s
# Numbers of YAML 1.1 that are not written in decimal digits alone: binary, octal, hexadecimal, in sixties, spaced by _.
_NOT_DECIMAL = re.compile(
    r"[-+]?(?:0b[01_]+|0[0-7_]+|0x[0-9a-fA-F_]+|[1-9][0-9]*_[0-9_:]*|[1-9][0-9]*(?::[0-5]?[0-9])+)"
)
# What often stands in the place of a file, by its first bytes: what it is, and what to do.
_SUBSTITUTES = {
    b"version https://git-lfs": "is a pointer of Git LFS, not the file itself; fetch that by: git lfs pull",
    b"#ROSBAG V": "is a bag of ROS 1; convert it by: rosbags-convert --src FILE.bag --dst FOLDER",
}
HEAD_BYTES = max(map(len, _SUBSTITUTES))
# Where files of a kind are in the share directory, and how their names end.
_YAML = (".yaml", ".yml")
_SHIPPED = {
    "setup": ("config", _YAML),
    "scene": ("config/scenes", (*_YAML, ".json", ".geojson")),
    "procedure": ("config/procedures", _YAML),
}


class BudgetError(Exception):
    """Input that asks for more than it may; the text says of what, and how much it may."""


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


def substitute_problem(head: bytes) -> str:
    """Return what stands in the place of a file by its first `HEAD_BYTES`, and what to do; empty if nothing does."""
    return next((problem for magic, problem in _SUBSTITUTES.items() if head.startswith(magic)), "")


def read_regular(path: Path, max_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Return the content of a regular file.

    A pipe without a writer would block whoever opens it, and a device may never end or do something when opened.

    Args:
        path: the file.
        max_bytes: that it may have.

    Raises:
        OSError: it cannot be read, is a folder, pipe or device, is larger, or a pointer of Git LFS stands in its place;
            `strerror` says which.
    """
    if not is_url(path) and not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "a folder, pipe or device", str(path))
    with path.open("rb") as stream:
        content = stream.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise OSError(errno.EFBIG, "a larger file", str(path))
    if problem := substitute_problem(content):
        raise OSError(errno.EINVAL, f"it {problem}", str(path))
    return content


def check_yaml(text: str, *, plain: bool = False) -> None:
    """Refuse a YAML text that becomes much larger when it is read, or that nests too deep.

    Args:
        text: from outside.
        plain: whether tags, and numbers that are not written in decimal digits, are refused too.

    Raises:
        BudgetError: with the line.
        yaml.YAMLError: it is no YAML.
    """
    depth = 0
    for count, event in enumerate(yaml.parse(text, Loader=yaml.CSafeLoader)):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        value = event.value if plain and isinstance(event, yaml.ScalarEvent) and event.implicit[0] else ""
        problem = ""
        if depth > MAX_YAML_DEPTH:
            problem = f"lists and mappings {depth} deep"
        elif getattr(event, "anchor", None) is not None:  # each alias may double what is read
            problem = "an anchor or alias (& or *)"
        elif plain and getattr(event, "tag", None) not in (None, "!"):
            problem = "a tag (!)"
        elif _NOT_DECIMAL.fullmatch(value):
            problem = f"{value[:40]}, which is no decimal number"
        elif count > MAX_YAML_EVENTS:
            problem = f"more than {MAX_YAML_EVENTS} values"
        if problem:
            line = f" in line {event.start_mark.line + 1}" if event.start_mark else ""
            raise BudgetError(problem + line)


def output_problem(path: Path) -> str:
    """Return why a file must not or cannot be written in the place of what a path names; empty where it can.

    A device, pipe or link would be replaced by a file: `--output /dev/null` as root would break the machine.
    """
    if path.is_symlink():
        return "is a symbolic link; expected a new file, or a regular one to replace"
    if path.exists() and not path.is_file():
        kind = "folder" if path.is_dir() else "device, pipe or socket"
        return f"is a {kind}; expected a new file, or a regular one to replace"
    folder = next(folder for folder in path.absolute().parents if folder.exists())
    return "" if os.access(folder, os.W_OK) else "is in a folder that cannot be written; expected another place"


def input_problem(output: Path, inputs: Iterable[Path]) -> str:
    """Return why an output would damage an input; empty where it does not.

    Args:
        output: a file or folder to write.
        inputs: files and folders that are read.
    """
    folders = [folder for folder in output.absolute().parents if folder.exists()]
    for source in inputs:
        with suppress(OSError, ValueError):
            if not source.exists():
                continue
            if output.exists() and os.path.samefile(output, source):
                return f"is the input {source}; expected another place"
            depth = next((i for i, folder in enumerate(folders) if os.path.samefile(folder, source)), -1)
            # Beside several bags or other inputs in a folder there is room; within a bag there is none.
            if any(_is_bag(folder) for folder in folders[: depth + 1]):
                return f"is inside of the input {source}; expected a place outside"
    return ""


def _is_bag(folder: Path) -> bool:
    return any(file.name.endswith((*STORAGE_SUFFIXES, "metadata.yaml")) for file in folder.iterdir())


def _partial(path: Path) -> Path:
    """Return a hidden name beside a path, of this run alone: two runs to one output must not share it."""
    return path.absolute().with_name(f".{path.stem}.{secrets.token_hex(4)}{path.suffix}")


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
    partial = _partial(path)
    try:
        if problem := output_problem(path):
            raise BagError(path, problem)
        partial.touch(exist_ok=False)
        yield partial
        partial.replace(path)
    except OSError as error:
        raise BagError(path, f"cannot be written: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            partial.unlink()


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
    if os.path.lexists(output):
        raise BagError(output, "exists already; expected a new folder")
    partial = _partial(output)
    missing = [folder for folder in partial.parents if not os.path.exists(folder)]
    try:
        partial.mkdir(parents=True)
        yield partial
        partial.rename(output)
    except RecordingEndedError as error:
        if not is_recording:  # nothing of it stays: no file is named
            raise BagError(output, f"cannot be written: {error.cause}") from None
        partial.rename(output)
        raise RecordingEndedError(output, error.cause, output / error.file.relative_to(partial)) from None
    except OSError as error:
        raise BagError(output, f"cannot be written: {error.strerror or error}") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        for folder in missing:
            with suppress(OSError):  # it is not empty
                folder.rmdir()


def share_directory(package: str) -> Path:
    """Return the share directory of a package.

    In a source checkout that is the checkout itself; otherwise `share/` below a prefix that ROS names
    in AMENT_PREFIX_PATH, or below a place that pip installs into.

    Raises:
        FileNotFoundError: the package is not installed.
    """
    prefixes = [prefix for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]
    schemes = [scheme for scheme in sysconfig.get_scheme_names() if scheme.startswith("posix")]
    prefixes += [sysconfig.get_path("data", scheme) for scheme in schemes]
    checkout = Path(__file__).resolve().parents[2] / ("msg_defs" if package == "magnetosuture_msgs" else "")
    folders = [checkout, *(Path(prefix) / "share" / package for prefix in prefixes)]
    for folder in folders:
        if (folder / "package.xml").is_file():
            return folder
    raise FileNotFoundError(f"{package} is not installed: no package.xml in any of {list(map(str, folders))}")


def shipped_names(kind: str) -> list[str]:
    """Return the names of the setups, scenes or procedures that ship with the package.

    Args:
        kind: `setup`, `scene` or `procedure`.
    """
    folder = share_directory("magnetosuture_thread") / _SHIPPED[kind][0]
    return sorted(path.stem for path in folder.glob("*.yaml"))


def find_file(kind: str, name: str) -> Path:
    """Return the file of a setup, scene or procedure.

    Args:
        kind: `setup`, `scene` or `procedure`.
        name: of one that ships with the package, or a path.

    Raises:
        ConfigurationError: there is no such file.
    """
    folder, endings = _SHIPPED[kind]
    is_path = Path(name).suffix in endings or os.sep in name
    path = Path(name) if is_path else share_directory("magnetosuture_thread") / folder / f"{name}.yaml"
    with suppress(OSError, ValueError):  # no name that a file could have
        if path.is_file():
            return path
    formats = "YAML or GeoJSON" if ".geojson" in endings else "YAML"
    raise ConfigurationError(kind, name, f"a {formats} file, or one of {', '.join(shipped_names(kind))}")
