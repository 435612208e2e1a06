"""Compiled functions: one decorator, so that every kernel is compiled and cached alike."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

PACKAGE = Path(__file__).parent
MARK = b"magnetosuture_thread.compiled"

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """Compile a function at its first call, with numpy's rules for division by zero.

    The result is cached beside the source file, so only the first start of a node on a machine pays.
    """
    return cast(_Function, numba.njit(cache=True, error_model="numpy")(function))


def forget_stale_kernels(package: Path = PACKAGE) -> bool:
    """Delete the cache where a file with compiled functions has changed since; return whether it had to.

    numba looks at a function's own file only. But a kernel holds the code of all that it calls, from other
    files too, and would go on with what these were.
    """
    state = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        if MARK in path.read_bytes():
            status = path.stat()
            state.update(f"{path.relative_to(package)} {status.st_mtime_ns} {status.st_size}\n".encode())
    stamp = package / "__pycache__" / "kernels.stamp"
    with contextlib.suppress(OSError):
        if stamp.read_text() == state.hexdigest():
            return False
    # Where nothing can be written, there is no such cache either: numba's is then in the user's home.
    with contextlib.suppress(OSError):
        for kernel in [*package.rglob("__pycache__/*.nbi"), *package.rglob("__pycache__/*.nbc")]:
            kernel.unlink(missing_ok=True)
        stamp.parent.mkdir(exist_ok=True)
        written = stamp.with_suffix(f".{os.getpid()}")
        written.write_text(state.hexdigest())
        written.replace(stamp)
    return True


forget_stale_kernels()
