"""What tests of several folders share."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import pytest

ROOT = Path(__file__).parents[1]
Value = TypeVar("Value")


def known(value: Value | None) -> Value:
    """Return a value, which must be there."""
    assert value is not None
    return value


def load_module(path: Path) -> ModuleType:
    """Return the module of a file that is in no package."""
    spec = known(importlib.util.spec_from_file_location(path.stem.replace(".", "_"), path))
    module = importlib.util.module_from_spec(spec)
    known(spec.loader).exec_module(module)
    return module


def run_python(
    *arguments: object, cwd: Path | None = None, environment: Mapping[str, str] | None = None, warns: bool = False
) -> str:
    """Run Python with arguments in a process of its own, which must succeed, and warn of nothing; return its output."""
    command = [sys.executable, *map(str, arguments)]
    env = {**os.environ, **(environment or {})}
    done = subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (warns and "Traceback" not in done.stderr) or not done.stderr
    return done.stdout


def wait_until(condition: Callable[[], object], what: str, timeout: float = 30.0, interval: float = 0.005) -> None:
    """Wait until a condition holds."""
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, f"waited {timeout:g} s for {what}"
        time.sleep(interval)


def check_refused(kind: type[Exception], call: Callable[[], Any], start: str, words: str = "", most: int = 500) -> None:
    """Check that something is refused in one short line, which begins with `start` and has some words in it."""
    with pytest.raises(kind) as caught:
        call()
    text = str(caught.value)
    assert text.startswith(start)
    assert words in text
    assert "\n" not in text
    assert len(text) < most
