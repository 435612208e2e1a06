"""Track rendered frames of many kinds, and compare with the ground truth: poses, headings, the thread's centreline.

Folded threads, crossings, sizes of image, colours and widths of thread, covers, a second needle, tilted cameras, and
others. Every frame is simulated, tracked for itself, and the same for the same seed. Ends with 1 if any pose is wrong.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cv2
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from benchmarks.vision.cases import CLASSES, render
from benchmarks.vision.measurements import ClassResult, measure_classes, random_of
from magnetosuture_thread.cli.arguments import whole_number
from magnetosuture_thread.cli.terminal import progress


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument(
        "--count", type=whole_number, default=20, metavar="N", help="frames of each class (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of the variation (default: %(default)s)")
    parser.add_argument(
        "--classes", nargs="+", default=[""], metavar="PREFIX", help="only classes whose names begin so (default: all)"
    )
    parser.add_argument(
        "--save", type=Path, metavar="FOLDER", help="write the first frame of each class as a picture, and track none"
    )


def run(options: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Track the frames; return the figures, and whether no pose is wrong."""
    names = [name for name in CLASSES if name.startswith(tuple(options.classes))]
    if options.save is not None:
        options.save.mkdir(parents=True, exist_ok=True)
        for name in names:
            frame = render(CLASSES[name], random_of(name, options.seed, 0))
            cv2.imwrite(str(options.save / f"{name}.png"), frame.image)
        return {"classes": []}, True
    with progress(console, "vision") as advance:
        results = measure_classes(names, options.count, options.seed, advance)
    console.print(_table(results))
    figures = {"seed": options.seed, "classes": [each.to_json() for each in results]}
    return figures, not any(each.wrong for each in results)


def _table(results: list[ClassResult]) -> Table:
    table = Table(title="simulated frames, each tracked for itself", title_justify="left", box=SIMPLE_HEAD, padding=0)
    table.add_column("class", no_wrap=True)
    for name in ("n", "found", "unk", "wrong", "rev", "tail", "turn", "seen", ">90", "off", "ms"):
        table.add_column(name, justify="right", no_wrap=True)
    table.caption = (
        "n: frames; unk: heading said to be unknown; rev: reversed; tail: RMS error of\n"
        "right poses in px, turn: in degrees; seen: % of the visible thread followed;\n"
        ">90: % of frames with 90 % of it; off: % of the centreline off the thread"
    )
    table.caption_justify = "left"
    for each in results:
        table.add_row(
            each.name,
            str(each.frames),
            str(each.found),
            str(each.unknown),
            str(each.wrong),
            str(each.is_reversed),
            _number(each.tail_rms_px, 2),
            _number(each.heading_rms_deg, 2),
            f"{100.0 * each.covered:.0f}",
            f"{100.0 * each.mostly:.0f}",
            _number(None if each.astray is None else 100.0 * each.astray, 1),
            f"{each.milliseconds:.1f}",
        )
    return table


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
