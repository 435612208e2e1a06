"""Errors with the value that was refused, where, and what was expected; texts from outside as they may be shown."""

from __future__ import annotations

import copyreg
import re
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path
from typing import Any

MAX_NAME_CHARS = 300  # of what an error is about; the name may hold the path of a file
MAX_REASON_CHARS = 400  # of a reason, a status or a value, whatever is in it


def printable(text: str) -> str:
    r"""Return a text without control characters, characters that turn its direction, and what no encoding has.

    A name in a bag or of a file may hold any of them; each becomes its escape sequence. Line feeds and tabs stay.

    >>> printable("a\x1b[31m")
    'a\\x1b[31m'
    """
    if text.isprintable():
        return text
    return "".join(sign if sign.isprintable() or sign in "\n\t" else ascii(sign)[1:-1] for sign in text)


def one_line(text: str) -> str:
    """Return a name as `printable`, in one line."""
    return printable(text).replace("\n", "\\n").replace("\t", "\\t")


def shortened(text: str, max_chars: int = 100) -> str:
    """Return a text from outside as `one_line`, of at most so many characters, to store, log, publish or draw.

    >>> shortened("frame" * 1000, 12)
    'frameframef…'
    """
    line = one_line(text[: max_chars + 1])
    return line if len(line) <= max_chars else line[: max_chars - 1] + "…"


def missing_module(error: ModuleNotFoundError) -> str:
    """Return what to do about a module that is not there: the line that installs it."""
    module = str(error.name).split(".")[0]
    # Modules of the extra `cluster`.
    if module in ("dask", "distributed", "fsspec", "pyarrow", "s3fs", "upath"):
        return f"{error}; clusters and bags by URL need the extra: pip install '.[cluster]'"
    ros = r"rcl.*|ros.*_(interfaces|py)|rpyutils|(ament|launch|tf2|rosidl)_?.*|.+_(msgs|srvs|interfaces)(_py)?"
    if re.fullmatch(ros, module):
        sourced = "source the setup.bash of ROS, and of the workspace where this package is built"
        return f"{error}; nodes and the live graph need ROS 2 Jazzy: {sourced}; without ROS: pip install '.[ros]'"
    names = {"cv2": "opencv-python-headless", "PIL": "pillow", "serial": "pyserial", "yaml": "PyYAML"}
    name = names.get(module, module)
    with suppress(PackageNotFoundError):
        needs = [line.split(";")[0].strip() for line in requires("magnetosuture_thread") or ()]
        name = next((need for need in needs if re.split("[^A-Za-z0-9_.-]", need)[0].lower() == name.lower()), name)
    return f"{error}; a Python package is missing: pip install '{name}'; see docs/how_to/installation.md"


class MagnetosutureError(Exception):
    """Base of every error that this package raises on purpose; its text is one line for a person."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what it is unpickled from, as from a worker: `__init__` takes others than what is in `args`."""
        return copyreg.__newobj__, (type(self), *self.args), vars(self)  # type: ignore[attr-defined]


class ConfigurationError(MagnetosutureError):
    """A configuration value that cannot be used.

    Args:
        name: the parameter, with the node or group it belongs to, for example `thread_model.length`.
        value: the value that was given.
        expectation: what would have been accepted, with its unit.
        source: the file that the value came from, if there is one.
    """

    def __init__(self, name: str, value: object, expectation: str, source: str = "") -> None:
        self.name, self.value, self.expectation, self.source = name, value, expectation, source
        where = f"{shortened(source, MAX_NAME_CHARS)}: " if source else ""
        what = shortened(name, MAX_NAME_CHARS)
        super().__init__(f"{where}{what}: got {shortened(repr(value))}, expected {expectation}")


class BagError(MagnetosutureError):
    """A bag or a reference file that cannot be read or written.

    Args:
        path: the file.
        problem: what is wrong with it and what was expected.
    """

    def __init__(self, path: object, problem: str) -> None:
        self.path, self.problem = str(path), problem
        super().__init__(f"{path}: {problem}")


class RecordingEndedError(BagError):
    """The disk is full, or fails; what was recorded before can be read.

    Args:
        folder: of the bag.
        cause: what ended it.
        file: that holds what was recorded before.
    """

    def __init__(self, folder: Path, cause: str, file: Path) -> None:
        self.cause, self.file = cause, file
        super().__init__(folder, f"{cause}; what was recorded before can be read: {file}")


class InvalidInputError(MagnetosutureError):
    """A message or sample that must not be used.

    Args:
        field: what is wrong, for example `needle/measured_cp.pose.position`.
        value: the value that was given.
        expectation: what would have been accepted, with its unit.
    """

    def __init__(self, field: str, value: object, expectation: str) -> None:
        self.field, self.value, self.expectation = field, value, expectation
        super().__init__(f"{shortened(field, MAX_NAME_CHARS)}: got {shortened(str(value))}, expected {expectation}")


class SolverError(MagnetosutureError):
    """A program whose solution did not pass its own residual check.

    Args:
        solver: the solver's name.
        status: the solver's own word.
        residual: the largest scaled residual.
        tolerance: the largest residual that would have been accepted.
    """

    def __init__(self, solver: str, status: str, residual: float, tolerance: float) -> None:
        self.solver, self.status, self.residual, self.tolerance = solver, status, residual, tolerance
        words = f"{solver} ended with status {status!r} and residual {residual:.1e}"
        super().__init__(f"{words}, expected at most {tolerance:.1e}")


class GraphError(MagnetosutureError):
    """A node or a part of the running graph that failed."""


class DriverError(MagnetosutureError):
    """A coil driver that can never work as it is configured.

    Args:
        driver: its name.
        problem: what is wrong and what was expected.
    """

    def __init__(self, driver: str, problem: str) -> None:
        self.driver, self.problem = driver, problem
        super().__init__(f"driver {driver}: {problem}")
