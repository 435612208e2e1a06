"""The decorators of compiled functions, and their cache."""

from __future__ import annotations

import hashlib
import inspect
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, TypeVar, cast

import numba
from numba.core import event, types

PACKAGE = Path(__file__).parents[1]
# A module, and the names after `import`, which may be modules too.
_IMPORT = re.compile(rb"^\s*from magnetosuture_thread\.([\w.]+) import (?=\(?([\w\s,]+))", re.MULTILINE)

_Function = TypeVar("_Function", bound=Callable[..., Any])
_COMPILATIONS = cast(Any, event).RecordingListener()
cast(Any, event).register("numba:compile", _COMPILATIONS)


@cache
def _read(path: Path, package: Path) -> tuple[bytes, frozenset[Path]]:
    """Return the digest of a source file, and the files of the package that it imports."""
    text, files = path.read_bytes(), set[Path]()
    for module, names in _IMPORT.findall(text):
        place = package.joinpath(*module.decode().split("."))
        submodules = {(place / name.strip().decode()).with_suffix(".py") for name in re.split(rb"[\s,]+", names)}
        files |= {place.with_suffix(".py"), place / "__init__.py"} | submodules
    return hashlib.sha256(text).digest(), frozenset(file for file in files if file.is_file())


def source_digest(path: Path, package: Path = PACKAGE) -> str:
    """Return a digest of a source file and of all files of the package that it imports, directly or not.

    Compiled code contains the functions and constants that it uses, from other files too.
    """
    reached, waiting = {path}, [path]
    while waiting:
        new = _read(waiting.pop(), package)[1] - reached
        reached |= new
        waiting += new
    return hashlib.sha256(b"".join(_read(file, package)[0] for file in sorted(reached))).hexdigest()


@contextmanager
def _guarded(file: Any) -> Iterator[None]:
    """Load or save a kernel; a full disk means none in the cache, and an index that a power cut has emptied goes."""
    try:
        yield
    except (EOFError, UnpicklingError):
        Path(file._index_path).unlink(missing_ok=True)
    except OSError:
        pass


def _decorator(*, keeps: bool = False, **options: Any) -> Callable[[_Function], _Function]:
    """Return numba's decorator with numpy's rules for division by zero and, but for what is inlined, a cache.

    Options are said of every function, as numba takes them over from whatever calls one first where they are not.
    Nobody takes the address of a function, and an entry for that takes as long to compile as the function itself.
    A number that is written out has a type of its own in numba, for which a function would be compiled once more.
    """
    decorator, unliteral = cast(Any, numba.njit), cast(Any, types).unliteral  # the stubs do not know all options

    def decorate(function: _Function) -> _Function:
        dispatcher = decorator(error_model="numpy", no_cfunc_wrapper=True, **options)(function)
        if dispatcher is function:  # as NUMBA_DISABLE_JIT says, for a debugger or a coverage of lines
            return function
        resolve = dispatcher.get_call_template
        dispatcher.get_call_template = lambda types_of, named: resolve(tuple(map(unliteral, types_of)), named)
        if options.get("no_cpython_wrapper"):
            # Python's call of it would be a crash, and is one of a function with a wrapper instead.
            wrapped = cache(lambda: decorator(error_model="numpy", _nrt=options["_nrt"])(function))
            dispatcher._insert = lambda *given, **named: None
            dispatcher._compile_for_args = lambda *given, **named: wrapped()
        if keeps:
            # Where neither the package nor the user's cache can be written, each process compiles for itself.
            with suppress(RuntimeError):
                dispatcher.enable_caching()
                dispatcher._cache._guard_against_spurious_io_errors = partial(_guarded, dispatcher._cache._cache_file)
                # numba itself looks at the function's own file only, and would run old code of the others.
                dispatcher._cache._cache_file._source_stamp = source_digest(Path(inspect.getfile(function)))
        return cast(_Function, dispatcher)

    return decorate


compiled = _decorator(keeps=True, _nrt=True)
"""Compile a function at its first call.

The result is cached beside the source file, so that only the first start of a node on a machine compiles.
"""

compiled_inline = _decorator(forceinline=True, _nrt=False)
"""Compile a function into each function that calls it, without counting references to arrays.

For small functions that kernels call with tuples of arrays, a thousand times a step, and that make no arrays: each
array of a tuple is counted twice a call, by atomic operations, which took six times as long as the contacts that
were looked for. numba does not document `_nrt`; one that has it no longer would refuse it by its name.
"""

compiled_uncounted = _decorator(keeps=True, _nrt=False)
"""Compile a function as `compiled` does, without counting references to arrays; see `compiled_inline`.

For kernels of which a step calls dozens with tuples of arrays. They may neither make arrays, which numba refuses,
nor return any, whose references nobody would have counted.
"""

compiled_inner = _decorator(keeps=True, _nrt=False, no_cpython_wrapper=True)
"""Compile a function as `compiled_uncounted` does, for compiled code: to call it from Python compiles it once more."""

compiled_within = _decorator(inline="always", _nrt=False)
"""Compile a function as a part of the one kernel that calls it, without counting references to arrays.

What is compiled apart is compiled once by itself, and then again within each kernel that leads to it. For a function
with one caller; the same done for one with several would compile it in each.
"""

compiled_without_gil = _decorator(keeps=True, _nrt=True, nogil=True)
"""Compile a function as `compiled` does, to run without Python's lock: several threads then run it at once.

For functions that are called from Python, write into memory of their own thread only, and take milliseconds.
"""

compiled_uncounted_without_gil = _decorator(keeps=True, _nrt=False, nogil=True)
"""Compile a function as `compiled_uncounted` does, to run without Python's lock; see `compiled_without_gil`."""


def compilations() -> int:
    """Return a number that grows with each function that is compiled, and not with those that the cache has."""
    return len(_COMPILATIONS.buffer)


class TypedKernel:
    """A compiled function whose arguments have the same types in every call: these are determined in the first alone.

    numba determines the types of arguments in each call, and of named tuples in Python: 20 us for the sixty arrays of
    a step's buffers, which is longer than the step of a thread takes. The types have to be the same each time: numbers
    are floats or integers, arrays contiguous.

    Args:
        kernel: the compiled function.
    """

    def __init__(self, kernel: Callable[..., Any]) -> None:
        self._kernel: Any = kernel
        self._code: Any = None

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        if self._code is None and not hasattr(self._kernel, "compile"):
            self._code = self._kernel
        if self._code is None:
            signature = tuple(cast(Any, numba).typeof(argument) for argument in arguments)
            self._kernel.compile(signature)
            self._code = self._kernel.overloads[signature].entry_point
        return self._code(*arguments)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how to make it again by the function's name, for `copy` and `pickle`."""
        function = getattr(self._kernel, "py_func", self._kernel)
        return _typed_kernel, (function.__module__, function.__name__)


def _typed_kernel(module: str, name: str) -> TypedKernel:
    return TypedKernel(getattr(import_module(module), name))
