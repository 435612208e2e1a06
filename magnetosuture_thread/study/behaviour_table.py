"""Tables of the thread-behaviour tests."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table

from magnetosuture_thread.study.behaviour_picture import Run


def behaviour_table(runs: Sequence[Run]) -> Table:
    """Return the figures of the thread-behaviour tests as a table."""
    table = Table(title="thread behaviour, closed loop, simulated", title_justify="left", title_style="bold")
    table.caption = "errors: mean (greatest) over time, % of the thread's length; needle: root of the mean square"
    table.add_column("", no_wrap=True)
    for name in ("against the truth", "against the seen", "frames", "needle off its path"):
        table.add_column(name, justify="right")
    for run in runs:
        summary = run.summary
        errors = [
            f"{figures['mean']:.3f} ({figures['maximum']:.3f})" if figures else "none"
            for figures in (summary.error_truth, summary.error_seen)
        ]
        table.add_row(
            summary.setup, *errors, f"{summary.predicted} of {summary.frames}", f"{1e3 * summary.path_error:.2f} mm"
        )
    return table
