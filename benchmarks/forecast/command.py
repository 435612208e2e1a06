"""Time forecasts, and compare them with what then happened on the simulated rig in closed loop.

Times: one forecast of 3 s in steps at 66 Hz of a thread of 81 segments among three posts, on one core; the same by
stepping filter and predictor from Python; a batch of 64 of 40 segments, on all cores; and both in steps at 33 Hz, with
how far the threads end from those in steps at 66 Hz, over the batch. Errors: of forecasts from
random moments of runs of the shipped procedures in the loop of a campaign, and of a path follower, under the commands
that were then sent, in per cent of the thread's length. What a seed varies (viscosity, stiffness, friction, coils) the
nodes do not know.
"""

from __future__ import annotations

import argparse
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.forecast.closed_loop import measure_accuracy
from benchmarks.forecast.timing import measure_times
from magnetosuture_thread.cli.terminal import make_log

LOOPS = ("hernia", "slalom", "figure_eight", "dead_end", "wrap_and_tighten", "petri_35mm_polyamide_post")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    option = parser.add_argument
    option("--repeats", type=int, default=50, metavar="N", help="of each time (default: 50)")
    option("--forecasts", type=int, default=100, metavar="N", help="at random moments of each loop (default: 100)")
    option("--seed", type=int, default=0, metavar="N", help="of the loops and moments (default: 0)")
    option(
        "--loops",
        nargs="*",
        default=LOOPS,
        metavar="NAME",
        help=f"procedures, or setups whose path follower steers (default: {' '.join(LOOPS)})",
    )


def run(options: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Measure; return the figures."""
    log = make_log(console)
    times = measure_times(options.repeats)
    table = Table(title="time of 3 s in steps at 66 Hz [ms]")
    for name in ("", "median", "minimum", "processor time, all cores"):
        table.add_column(name, justify="left" if not name else "right")
    for key, text in (
        ("single_ms", "one forecast, n = 81, one core"),
        ("by_hand_ms", "the same stepped from Python"),
        ("batch_ms", f"{times['batch_size']} forecasts, n = 40, {times['cores']} cores"),
        ("coarse_single_ms", "one forecast at 33 Hz, n = 81, one core"),
        ("coarse_batch_ms", f"{times['batch_size']} forecasts at 33 Hz, n = 40, {times['cores']} cores"),
    ):
        table.add_row(text, *(f"{times[key][name]:.1f}" for name in ("median", "minimum", "processor")))
    console.print(table)
    mean, largest = times["coarse_apart_mean_percent"], times["coarse_apart_max_percent"]
    log(f"at 33 Hz the threads end {mean:.3f} % of the length from those at 66 Hz in the mean, {largest:.3f} % at most")
    loops = []
    for name in options.loops:
        log(f"the loop of {name}, and {options.forecasts} forecasts from it")
        loops.append(measure_accuracy(name, options.forecasts, 3.0, options.seed))
    table = Table(title="forecasts 3 s ahead against the simulated rig, in % of the length")
    for name in ("loop", "error, mean", "median", "95 %", "of the needle, mean", "the thread moved, mean"):
        table.add_column(name, justify="left" if name == "loop" else "right")
    for loop in loops:
        keys = [
            f"{key}_percent" for key in ("error_mean", "error_median", "error_p95", "needle_error_mean", "moved_mean")
        ]
        table.add_row(loop["loop"], *(f"{loop[key]:.2f}" for key in keys))
    console.print(table)
    return {"times": times, "loops": loops}, True
