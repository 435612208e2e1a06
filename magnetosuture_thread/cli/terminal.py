"""What a command shows while it runs and when it is done."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn


def make_console() -> Console:
    """Return the console of a command: standard output, numbers and paths in no colours of their own."""
    return Console(highlight=False)


def make_log(console: Console) -> Callable[[str], None]:
    """Return what prints a line as it is, however long; what cannot be printed, as an escape sequence."""
    return lambda text: console.print(printable(text), soft_wrap=True, markup=False)


def printable(text: str) -> str:
    """Return a text without control characters and what no encoding has, which names in a bag may hold."""
    return "".join(sign if sign.isprintable() or sign == "\n" else ascii(sign)[1:-1] for sign in text)


@contextmanager
def progress(console: Console, name: str) -> Iterator[Callable[[float], None]]:
    """Show a progress bar; the block gets a function that sets its fraction, 0 to 1."""
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(name, total=1.0)
        yield lambda share: bar.update(task, completed=share)


def write_json(path: Path | None, figures: Any) -> None:
    """Write figures to the file given by --json, if any."""
    if path:
        path.write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n")
