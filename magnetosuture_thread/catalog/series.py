"""The figures of a bag by seconds: what a catalog keeps of its frames."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from magnetosuture_thread.barrier import BUILT_IN
from magnetosuture_thread.evaluation.frames import MARGIN, Array
from magnetosuture_thread.evaluation.metrics import TARGETS, RunMetrics, finite_or_none

# By column of the table: column of the metrics, and how the frames of a second become one number.
COLUMNS: dict[str, tuple[str, Callable[[Array], float]]] = {
    **{f"error_{target}_percent": (f"error_{target}", np.nanmean) for target in TARGETS},
    **{f"estimate_error_{target}_percent": (f"estimate_error_{target}", np.nanmean) for target in TARGETS},
    "seen_share": ("seen_share", np.nanmean),
    "hidden_share": ("hidden", np.nanmean),
    "innovation_squared": ("innovation_squared", np.nanmean),
    "stretch_max": ("strain", np.nanmax),
    "tension_max_n": ("tension", np.nanmax),
    "needle_pull_max_n": ("pull", np.nanmax),
    **{f"least_{barrier}_m": (f"{MARGIN}{barrier}", np.nanmin) for barrier in BUILT_IN},
}
COUNTS = ("frames", "predicted")


def second_rows(metrics: RunMetrics) -> list[dict[str, float | int | None]]:
    """Return a row for each second of a run in which there are frames; None where there is no value.

    A row has `second`, whole seconds since the bag's start, the numbers of frames and of predictions, and `COLUMNS`.

    Args:
        metrics: of the run.
    """
    observed = np.floor(metrics.observed.times).astype(int)
    predicted = np.floor(metrics.series.times).astype(int)
    known = {name: metrics.series.column(name) for name in metrics.series.names}
    rows = []
    for second in np.unique(observed):
        inside = predicted == second
        row: dict[str, float | int | None] = {"second": int(second), "frames": int((observed == second).sum())}
        row["predicted"] = int(inside.sum())
        for column, (name, reduce) in COLUMNS.items():
            values = known[name][inside] if name in known else np.empty(0)
            values = values[np.isfinite(values)]
            row[column] = finite_or_none(float(reduce(values))) if len(values) else None
        rows.append(row)
    return rows
