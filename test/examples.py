"""The examples as modules: what users are shown, the tests use."""

from __future__ import annotations

from types import ModuleType

from test.shared import ROOT, load_module

FOLDER = ROOT / "examples"


def load_example(name: str) -> ModuleType:
    """Return the module of an example by its path without the suffix."""
    return load_module(FOLDER / f"{name}.py")
