"""The decorators of compiled functions, and their cache."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Protocol, TypeVar, cast

import numba
from numba.core import event

PACKAGE = Path(__file__).parents[1]
COMPILED_MARK = b"magnetosuture_thread.geometry.compiled"
_IMPORT = re.compile(rb"^\s*(?:from|import) magnetosuture_thread\.([\w.]+)", re.MULTILINE)

_Function = TypeVar("_Function", bound=Callable[..., Any])


_EVENTS = cast(Any, event)  # without types
_COMPILATIONS = _EVENTS.RecordingListener()
_EVENTS.register("numba:compile", _COMPILATIONS)


class _Decorator(Protocol):
    def __call__(self, function: _Function, /) -> _Function: ...


def _decorator(**options: Any) -> _Decorator:
    """Return numba's decorator with numpy's rules for division by zero and, but for what is inlined, a cache.

    Options are said of every function, as numba takes them over from whatever calls one first where they are not.
    Nobody takes the address of a function, and an entry for that takes as long to compile as the function itself.
    """
    decorator = cast(Any, numba.njit)  # the stubs do not know all options
    return cast(_Decorator, decorator(error_model="numpy", no_cfunc_wrapper=True, **options))


compiled = _decorator(cache=True, _nrt=True)
"""Compile a function at its first call.

The result is cached beside the source file, so that only the first start of a node on a machine compiles.
"""

compiled_inline = _decorator(forceinline=True, _nrt=False)
"""Compile a function into each function that calls it, without counting references to arrays.

For small functions that kernels call with tuples of arrays, a thousand times a step, and that make no arrays: each
array of a tuple is counted twice a call, by atomic operations, which took six times as long as the contacts that
were looked for. numba does not document `_nrt`; one that has it no longer would refuse it by its name.
"""

compiled_uncounted = _decorator(cache=True, _nrt=False)
"""Compile a function as `compiled` does, without counting references to arrays; see `compiled_inline`.

For kernels of which a step calls dozens with tuples of arrays. They may neither make arrays, which numba refuses,
nor return any, whose references nobody would have counted.
"""

compiled_inner = _decorator(cache=True, _nrt=False, no_cpython_wrapper=True)
"""Compile a function as `compiled_uncounted` does, for compiled code alone: to call it from Python is a crash."""

compiled_within = _decorator(inline="always", _nrt=False)
"""Compile a function as a part of the one kernel that calls it, without counting references to arrays.

What is compiled apart is compiled once by itself, and then again within each kernel that leads to it. For a function
with one caller; the same done for one with several would compile it in each.
"""

compiled_without_gil = _decorator(cache=True, _nrt=True, nogil=True)
"""Compile a function as `compiled` does, to run without Python's lock: several threads then run it at once.

For functions that are called from Python, write into memory of their own thread only, and take milliseconds.
"""

compiled_uncounted_without_gil = _decorator(cache=True, _nrt=False, nogil=True)
"""Compile a function as `compiled_uncounted` does, to run without Python's lock; see `compiled_without_gil`."""


def compilations() -> int:
    """Return a number that grows with each function that is compiled, and not with those that the cache has."""
    return len(_COMPILATIONS.buffer)


def _dependencies(package: Path) -> dict[Path, set[Path]]:
    """Return each source file that has compiled functions, with all files of the package that it imports and itself."""
    imports: dict[Path, set[Path]] = {}
    kernels: set[Path] = set()
    for path in package.rglob("*.py"):
        text = path.read_bytes()
        if COMPILED_MARK in text:
            kernels.add(path)
        found = {package.joinpath(*module.decode().split(".")).with_suffix(".py") for module in _IMPORT.findall(text)}
        imports[path] = {file if file.exists() else file.with_suffix("") / "__init__.py" for file in found}
    closure: dict[Path, set[Path]] = {}
    for path in kernels:
        reached, waiting = {path}, [path]
        while waiting:
            new = imports.get(waiting.pop(), set()) - reached
            reached |= new
            waiting += new
        closure[path] = {file for file in reached if file in imports}
    return closure


def delete_stale_cache(package: Path = PACKAGE) -> bool:
    """Delete cached functions of files of which any import has changed since; return whether there were such files.

    numba checks the file of a function only. But a compiled function contains the code of all functions and constants
    that it uses, from other files too, and would keep their old values.
    """

    def state_of(files: Iterable[Path]) -> str:
        told = ((file.relative_to(package), file.stat()) for file in sorted(files))
        return hashlib.sha256("".join(f"{n} {s.st_mtime_ns} {s.st_size}\n" for n, s in told).encode()).hexdigest()

    stamp = package / "__pycache__" / "kernels.json"
    before: dict[str, str] = {}
    with contextlib.suppress(OSError, ValueError):
        before = dict(json.loads(stamp.read_text()))
    states = {"package": state_of(package.rglob("*.py"))}
    if before.get("package") == states["package"]:
        return False
    states |= {str(path.relative_to(package)): state_of(files) for path, files in _dependencies(package).items()}
    stale = [package / name for name in states if name != "package" and before.get(name) != states[name]]
    # Where nothing can be written, there is no such cache either: numba's is then in the user's home.
    with contextlib.suppress(OSError):
        for path in stale:
            for kernel in path.parent.glob(f"__pycache__/{path.stem}.*.nb[ci]"):
                kernel.unlink(missing_ok=True)
        stamp.parent.mkdir(exist_ok=True)
        written = stamp.with_suffix(f".{os.getpid()}")
        written.write_text(json.dumps(states))
        written.replace(stamp)
    return bool(stale)


delete_stale_cache()
