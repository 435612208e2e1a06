"""What a command shows while it runs and when it is done."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.segment import Segment

from magnetosuture_thread.texts import printable


class _PlainConsole(Console):
    """A console on which no name of a file, topic or frame moves the cursor, changes colours or turns text around."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """Render; control characters in texts become escape sequences, those of the console itself stay."""
        for segment in super().render(renderable, options):
            text, style, control = segment
            yield segment if control or text.isprintable() else Segment(printable(text), style)


def make_console(*, errors: bool = False) -> Console:
    """Return the console of a command: numbers and paths in no colours of their own, control characters escaped.

    Args:
        errors: whether it writes to standard error, in place of standard output.
    """
    return _PlainConsole(highlight=False, emoji=False, stderr=errors, soft_wrap=errors)


def make_log(console: Console) -> Callable[[str], None]:
    """Return what prints a line as it is, however long."""
    return lambda text: console.print(text, soft_wrap=True, markup=False)


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
        from magnetosuture_thread.jobs.output import whole_file

        with whole_file(path) as partial:
            partial.write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n")
