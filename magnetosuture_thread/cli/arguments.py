"""Types of arguments on the command line: each refuses what it cannot be, in words."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path


def number(low: float, high: float) -> Callable[[str], float]:
    """Return an argument type: a number within bounds."""

    def within(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is no number from {low:g} to {high:g}")
        return value

    return within


def whole_number(text: str) -> int:
    """Return a whole number of at least 0: an argument type."""
    if not (text.isascii() and text.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number of at least 0")
    return int(text)


def segments(text: str) -> int:
    """Return a number of segments: an argument type."""
    count = whole_number(text)
    if not 3 <= count <= 2000:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of segments from 3 to 2000")
    return count


def output_file(text: str) -> Path:
    """Return a file to write, in a folder that exists: an argument type."""
    path = Path(text)
    if not path.parent.is_dir() or path.is_dir():
        raise argparse.ArgumentTypeError(f"{text!r} is no file in a folder that exists")
    return path
