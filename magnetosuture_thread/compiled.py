"""The decorator of all compiled functions, and their cache."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import event

PACKAGE = Path(__file__).parent
COMPILED_MARK = b"magnetosuture_thread.compiled"

_Function = TypeVar("_Function", bound=Callable[..., Any])


# Said of every function, as numba takes it over from whatever calls one first where it is not said.
_COUNTED: dict[str, Any] = {"_nrt": True}
_UNCOUNTED: dict[str, Any] = {"_nrt": False}
_EVENTS = cast(Any, event)  # without types
_COMPILATIONS = _EVENTS.RecordingListener()
_EVENTS.register("numba:compile", _COMPILATIONS)


def compiled(function: _Function) -> _Function:
    """Compile a function with numba at its first call, with numpy's rules for division by zero.

    The result is cached beside the source file, so that only the first start of a node on a machine compiles.
    """
    return cast(_Function, numba.njit(cache=True, error_model="numpy", **_COUNTED)(function))


def compiled_inline(function: _Function) -> _Function:
    """Compile a function as `compiled` does, into each function that calls it, without counting references to arrays.

    For small functions that kernels call with tuples of arrays, a thousand times a step, and that make no arrays: each
    array of a tuple is counted twice a call, by atomic operations, which took six times as long as the contacts that
    were looked for. numba does not document `_nrt`; one that has it no longer would refuse it by its name.
    """
    return cast(_Function, numba.njit(error_model="numpy", forceinline=True, **_UNCOUNTED)(function))


def compiled_uncounted(function: _Function) -> _Function:
    """Compile a function as `compiled` does, without counting references to arrays; see `compiled_inline`.

    For kernels of which a step calls dozens with tuples of arrays. They may neither make arrays, which numba refuses,
    nor return any, whose references nobody would have counted.
    """
    return cast(_Function, numba.njit(cache=True, error_model="numpy", **_UNCOUNTED)(function))


def compiled_without_gil(function: _Function) -> _Function:
    """Compile a function as `compiled` does, to run without Python's lock: several threads then run it at once.

    For functions that are called from Python, write into memory of their own thread only, and take milliseconds.
    """
    return cast(_Function, numba.njit(cache=True, error_model="numpy", nogil=True, **_COUNTED)(function))


def compilations() -> int:
    """Return a number that grows with each function that is compiled, and not with those that the cache has."""
    return len(_COMPILATIONS.buffer)


def delete_stale_cache(package: Path = PACKAGE) -> bool:
    """Delete the cache where a file with compiled functions has changed since; return whether it had to.

    numba checks the file of a function only. But a compiled function contains the code of all functions that it calls,
    from other files too, and would keep their old code.
    """
    state = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        if COMPILED_MARK in path.read_bytes():
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


delete_stale_cache()
