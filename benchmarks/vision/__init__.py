"""Hold the vision tracker against rendered frames of many classes, whose ground truth is known.

A frame is drawn by the rig's camera, varied at random, and given to a tracker that has seen no other. Passed if no pose
is reversed. 20 frames of each class take ten minutes.
"""

from __future__ import annotations

import argparse
from typing import Any

import cv2
from rich.table import Table

from benchmarks.vision.cases import CLASSES
from benchmarks.vision.measurements import frame_of, measure, row_of
from magnetosuture_thread.commands.command import Terminal, count_argument, make_table, whole_number
from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.vision.tracker import warm_up

FAMILIES = ", ".join(dict.fromkeys(name.partition("_")[0] for name in CLASSES))
TOTALS = ("frames", "found", "unknown", "wrong", "reversed", "misplaced", "incomplete", "not_free")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    count = count_argument("frames", 1, 100_000)
    option = parser.add_argument
    option("--count", type=count, default=20, metavar="N", help="frames of each class (default: 20)")
    option("--seed", type=whole_number, default=1, metavar="S", help="of the variation (default: 1)")
    prefixes = "only classes whose names begin so (default: all)"
    option("--classes", nargs="+", default=[""], metavar="PREFIX", help=prefixes)
    save = "only write one frame of a class as a PNG file"
    option("--save", nargs=3, metavar=("CLASS", "INDEX", "FILE"), help=save)


def run(options: argparse.Namespace, terminal: Terminal) -> tuple[dict[str, Any], bool]:
    """Measure; return the figures and whether no pose was reversed."""
    if options.save:
        name, index, file = options.save
        return _save(name, index, file, options.seed), True
    names = [name for name in CLASSES if name.startswith(tuple(options.classes))]
    if not names:
        raise ConfigurationError("--classes", " ".join(options.classes), f"beginnings of names: {FAMILIES}")
    warm_up()
    rows = []
    with terminal.progress("vision") as advance:
        for number, name in enumerate(names, 1):
            frames = (frame_of(name, index, options.seed) for index in range(options.count))
            rows.append(row_of(name, [measure(*frame) for frame in frames]))
            advance(number / len(names))
    title = f"on rendered frames, {options.count} of each class"
    terminal.print(_table(f"the needle {title}", NEEDLE, rows, POSES))
    terminal.print(_table(f"the thread {title}", THREAD, rows, PIECES))
    total = {name: sum(row[name] for row in rows) for name in TOTALS}
    terminal.log(", ".join(f"{value} {name}" for name, value in total.items()))
    return {"count": options.count, "seed": options.seed, "rows": rows, "total": total}, total["reversed"] == 0


def _save(name: str, index: str, file: str, seed: int) -> dict[str, Any]:
    """Write a frame; return what is known of it."""
    if name not in CLASSES:
        raise ConfigurationError("--save", name, f"a whole name, which begin with {FAMILIES}")
    case, image = frame_of(name, whole_number(index), seed)
    if not cv2.imwrite(file, image):
        raise ConfigurationError("--save", file, "a PNG file in a folder that exists")
    needle = case.needle
    return {"tail": needle.tail.tolist(), "heading": needle.heading, "thread": case.thread.tolist(), **case.labels}


POSES = (
    "unkn: heading unknown by its covariance; wrong: tail off by 2 px or heading by 5 degrees; rev: by 90; "
    ">cov: by more than the covariance says; px, deg: RMS of the others"
)
PIECES = (
    "line: visible thread that is followed from the tail; pcs: that is on pieces; off: share of pieces where no thread "
    "is; mis: pieces of a place that is wrong; all: frames said to show all of the thread; free: ends said to be its "
    "own; dev: RMS of errors over their standard deviation"
)
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


def _table(title: str, columns: dict[str, tuple[str, str]], rows: list[dict[str, Any]], caption: str) -> Table:
    """Return rows of figures as a table; what has no value is empty."""
    cells = [
        (row["name"], *("" if row[name] is None else format(row[name], form) for name, form in columns.values()))
        for row in rows
    ]
    return make_table(title, ("class", *columns), cells, caption)
