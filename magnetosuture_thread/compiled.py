"""The decorator of all compiled functions, and their cache."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba import _dynfunc
from numba.core import event
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder, _LowerResult
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering

PACKAGE = Path(__file__).parent
COMPILED_MARK = b"magnetosuture_thread.compiled"
_IMPORT = re.compile(rb"^\s*(?:from|import) magnetosuture_thread\.([\w.]+)", re.MULTILINE)

_Function = TypeVar("_Function", bound=Callable[..., Any])

# Said of every function, as numba takes it over from whatever calls one first where it is not said.
# Nobody takes the address of a function, and an entry for that takes as long to compile as the function itself.
_OPTIONS: dict[str, Any] = {"error_model": "numpy", "no_cfunc_wrapper": True}
_EVENTS = cast(Any, event)  # without types
_COMPILATIONS = _EVENTS.RecordingListener()
_EVENTS.register("numba:compile", _COMPILATIONS)


class _LinkedLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Code of a function that another one calls: optimised and assembled as a part of the one called from Python.

    numba optimises and assembles each function by itself, then again in each that calls it, and so on: in a tree of
    calls four deep all code four times.
    """

    def finalize(self) -> None:
        """Link the code of what the function calls, and leave it as it is."""
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _LinkedLowering(NativeLowering):  # type: ignore[misc]
    """Lower a function to code that is linked; see `_LinkedLibrary`."""

    _name = "linked_lowering"

    def run_pass(self, state: Any) -> bool:
        """Lower, and make the function known to those that call it."""
        state.library = library = _LinkedLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        described, helper, _, environment = state["cr"]
        # The key by which numba finds the code is a function of Python without an address.
        key = _dynfunc.make_function(described.lookup_module(), described.qualname, "", 0, environment, (library,))
        state.targetctx.insert_user_function(key, described, [library])
        state["cr"] = _LowerResult(described, helper, cfunc=key, env=environment)
        return True


class _LinkedCompiler(CompilerBase):  # type: ignore[misc]
    """Compiles functions that only compiled code calls."""

    def define_pipelines(self) -> list[Any]:
        """Return numba's own passes with the last but one replaced."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(_LinkedLowering, NativeLowering)
        passes.passes = [each for each in passes.passes if each[0] is not NativeLowering]
        passes.finalize()
        return [passes]


def _linked(function: _Function, **options: Any) -> Any:
    """Return a function for compiled code alone."""
    chosen = {**_OPTIONS, "no_cpython_wrapper": True, **options}
    return numba.njit(pipeline_class=_LinkedCompiler, **chosen)(function)


def _kernel(function: _Function, counted: bool, **options: Any) -> _Function:
    """Return a function for Python, whose code is cached, and for compiled code, that links it."""
    called = numba.njit(cache=True, _nrt=counted, **_OPTIONS, **options)(function)
    linked = _linked(function, _nrt=counted)
    called.get_call_template, called.get_overload = linked.get_call_template, linked.get_overload
    return cast(_Function, called)


def compiled(function: _Function) -> _Function:
    """Compile a function with numba at its first call, with numpy's rules for division by zero.

    The result is cached beside the source file, so that only the first start of a node on a machine compiles. What
    only compiled code calls has neither an entry from Python nor a cache of its own.
    """
    return _kernel(function, True)


def compiled_inline(function: _Function) -> _Function:
    """Compile a function into each that calls it, as `compiled_uncounted` does.

    For small functions that kernels call with tuples of arrays, a thousand times a step.
    """
    return cast(_Function, _linked(function, _nrt=False, forceinline=True))


def compiled_uncounted(function: _Function) -> _Function:
    """Compile a function as `compiled` does, without counting references to arrays.

    For kernels of which a step calls dozens with tuples of arrays: each array is counted twice a call, by atomic
    operations. They may neither make arrays, which numba refuses, nor return any, whose references nobody would have
    counted. numba does not document `_nrt`; one that has it no longer would refuse it by its name.
    """
    return _kernel(function, False)


def compiled_without_gil(function: _Function) -> _Function:
    """Compile a function as `compiled` does, to run without Python's lock: several threads then run it at once.

    For functions that are called from Python, write into memory of their own thread only, and take milliseconds.
    """
    return _kernel(function, True, nogil=True)


def compiled_uncounted_without_gil(function: _Function) -> _Function:
    """Compile a function as `compiled_uncounted` does, to run without Python's lock; see `compiled_without_gil`."""
    return _kernel(function, False, nogil=True)


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
