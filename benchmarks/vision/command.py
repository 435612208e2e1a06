"""Hold the vision tracker against rendered frames of many classes, whose ground truth is known.

A frame is drawn by the rig's camera, varied at random, and given to a tracker that has seen no other. Passed if no pose
is reversed. 20 frames of each class take ten minutes.
"""

from __future__ import annotations

import argparse
from typing import Any

import cv2
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from benchmarks.vision.cases import CLASSES
from benchmarks.vision.measurements import frame_of, measure_vision
from benchmarks.vision.photographs import PHOTOGRAPHS, RIGHT, measure_photographs
from magnetosuture_thread.commands.command import count_argument, make_log, progress, whole_number
from magnetosuture_thread.settings.errors import ConfigurationError

FAMILIES = ", ".join(dict.fromkeys(name.partition("_")[0] for name in CLASSES))
TOTALS = ("frames", "found", "unknown", "wrong", "reversed", "misplaced", "incomplete", "not_free")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    count = count_argument("frames", 1, 100_000)
    parser.add_argument("--count", type=count, default=20, metavar="N", help="frames of each class (default: 20)")
    parser.add_argument("--seed", type=whole_number, default=1, metavar="S", help="of the variation (default: 1)")
    parser.add_argument(
        "--classes", nargs="+", default=[""], metavar="PREFIX", help="only classes whose names begin so (default: all)"
    )
    parser.add_argument(
        "--photographs", action="store_true", help="only the dish, in drawn photographs of dishes as people take them"
    )
    parser.add_argument(
        "--save", nargs=3, metavar=("CLASS", "INDEX", "FILE"), help="only write one frame of a class as a PNG file"
    )


def run(options: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Measure; return the figures and whether no pose was reversed."""
    if options.photographs:
        return _photographs(options, console)
    if options.save:
        name, index, file = options.save
        return _save(name, index, file, options.seed), True
    names = [name for name in CLASSES if name.startswith(tuple(options.classes))]
    if not names:
        raise ConfigurationError("--classes", " ".join(options.classes), f"beginnings of names: {FAMILIES}")
    with progress(console, "vision") as advance:
        rows, figures = measure_vision(names, options.count, options.seed, advance)
    title = f"on rendered frames, {options.count} of each class"
    console.print(_table(f"the needle {title}", NEEDLE, figures["rows"], POSES))
    console.print(_table(f"the thread {title}", THREAD, figures["rows"], PIECES))
    total = {name: sum(getattr(row, name) for row in rows) for name in TOTALS}
    make_log(console)(", ".join(f"{value} {name}" for name, value in total.items()))
    return {**figures, "total": total}, total["reversed"] == 0


def _photographs(options: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Look for the dish in photographs; return the figures and whether nine tenths are found and right."""
    names = [name for name in PHOTOGRAPHS if name.startswith(tuple(options.classes))]
    if not names:
        raise ConfigurationError("--classes", " ".join(options.classes), f"beginnings of {', '.join(PHOTOGRAPHS)}")
    figures = measure_photographs(names, options.count, options.seed)
    console.print(_table(f"the dish in {options.count} drawn photographs of each class", PHOTOGRAPH, figures["rows"]))
    right, count = sum(row["right"] for row in figures["rows"]), options.count * len(names)
    make_log(console)(f"{right} of {count} found within {RIGHT:.0%} of the radius")
    return figures, right >= 0.9 * count


def _save(name: str, index: str, file: str, seed: int) -> dict[str, Any]:
    """Write a frame; return what is known of it."""
    if name not in CLASSES:
        raise ConfigurationError("--save", name, f"a whole name, which begin with {FAMILIES}")
    case, image = frame_of(name, whole_number(index), seed)
    if not cv2.imwrite(file, image):
        raise ConfigurationError("--save", file, "a PNG file in a folder that exists")
    needle = case.needle
    return {"tail": needle.tail.tolist(), "heading": needle.heading, "thread": case.thread.tolist(), **case.labels}


POSES = """unkn: heading unknown by its covariance; wrong: tail off by 2 px or heading by 5 degrees; rev: by 90; >cov:
by more than the covariance says; px, deg: RMS of the others"""
PIECES = """line: visible thread that is followed from the tail; pcs: that is on pieces; off: share of pieces where no
thread is; mis: pieces of a place that is wrong; all: frames said to show all of the thread; free: ends said to be its
own; dev: RMS of errors over their standard deviation"""


# Columns of the tables: what is shown, and how.
NEEDLE = {
    **{"pose": ("found", ""), "unkn": ("unknown", ""), "wrong": ("wrong", ""), "rev": ("reversed", "")},
    **{">cov": ("dishonest", ""), "px": ("tail_px", ".2f"), "deg": ("angle_deg", ".2f"), "ms": ("median_ms", ".1f")},
}
THREAD = {
    **{"line": ("covered", ".0%"), "pcs": ("pieces", ".0%"), "off": ("wrong_pieces", ".1%"), "mis": ("misplaced", "")},
    **{"all": ("complete", ""), "not all": ("incomplete", ""), "free": ("free", ""), "not free": ("not_free", "")},
    "dev": ("normalised", ".1f"),
}
PHOTOGRAPH = {"found": ("found", ""), "right": ("right", ""), "ms": ("median_ms", ".1f"), "max ms": ("max_ms", ".1f")}


def _table(
    title: str, columns: dict[str, tuple[str, str]], rows: list[dict[str, Any]], caption: str | None = None
) -> Table:
    """Return rows of figures as a table."""
    result = Table(title=title, box=SIMPLE_HEAD, padding=(0, 1, 0, 0), caption=caption, caption_justify="left")
    result.add_column("class", no_wrap=True)
    for name in columns:
        result.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        shown = [(row[field], form) for field, form in columns.values()]
        result.add_row(row["name"], *("" if value is None else format(value, form) for value, form in shown))
    return result
