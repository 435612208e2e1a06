"""Types of arguments on the command line: each refuses what it cannot be, in words."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from magnetosuture_thread.bags.remap import parse_remap
from magnetosuture_thread.errors import ConfigurationError


def number_argument(low: float, high: float) -> Callable[[str], float]:
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


def add_remap(parser: argparse._ActionsContainer) -> None:
    """Add the option --remap, which may come again; its value is a list of pairs, old name and new."""
    parser.add_argument(
        "--remap",
        type=remap,
        action="append",
        default=[],
        metavar="FROM:=TO",
        help="another name for a bag's topic; may come again",
    )


def add_source(parser: argparse._ActionsContainer) -> None:
    """Add --source, --remap and --frame: what of a bag to go by."""
    parser.add_argument(
        "--source",
        choices=("auto", "camera", "poses"),
        default="auto",
        help="what to go by: the camera's frames, or the recorded poses (default: the camera where there are frames)",
    )
    add_remap(parser)
    parser.add_argument("--frame", default="dish", metavar="NAME", help="a bag's name of the dish frame")


def remap(text: str) -> tuple[str, str]:
    """Return a topic's name and its new one: an argument type."""
    try:
        return parse_remap(text)
    except ConfigurationError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not {error.expectation}") from None
