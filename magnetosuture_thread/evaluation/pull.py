"""How far the predicted pull of the thread upon the needle is from that of the ground truth."""

from __future__ import annotations

import math

import numpy as np

from magnetosuture_thread.evaluation.frames import TimeSeries

COLUMNS = ("pull", "true_pull", "pull_error")


def pull_error_percent(series: TimeSeries) -> float:
    """Return the root mean square of the difference of both forces, in % of the true pull's peak.

    Over the frames with both; nan where there are none, or where nothing pulls.
    """
    if "pull_error" not in series.names or not series.has("pull_error"):
        return math.nan
    error, true = series.column("pull_error"), series.column("true_pull")
    peak = float(np.nanmax(true))
    return 100.0 * float(np.sqrt(np.nanmean(error**2))) / peak if peak > 0.0 else math.nan
