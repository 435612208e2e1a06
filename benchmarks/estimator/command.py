"""Measure the thread estimator against ground truth, beside the prediction alone.

The truth is the rod of the simulated rig behind a needle that wanders through the dish; the camera gives points of it,
with correlated noise, gaps and outliers. Errors are distances of nodes from the truth, in % of the thread's length.
"""

from __future__ import annotations

import argparse
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.estimator.cases import CASES
from benchmarks.estimator.measurements import THREADS, measure_case, measure_cost
from benchmarks.estimator.rendered import measure_rendered
from magnetosuture_thread.commands.command import make_log, progress


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--count", type=int, default=2, metavar="N", help="runs of each case and thread (default: 2)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="of the first run (default: 1)")
    parser.add_argument("--cases", nargs="+", choices=list(CASES), metavar="CASE", help="only these; default: all")
    parser.add_argument("--segments", type=int, default=25, metavar="N", help="of the model (default: 25)")
    parser.add_argument(
        "--rendered", type=int, default=0, metavar="N", help="also N seeds of unknown posts, by rendered frames"
    )


def run(options: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Measure the cases; return the figures, and whether all limits hold."""
    names = options.cases or list(CASES)
    total, done = len(names) * len(THREADS) * options.count, 0
    figures = []
    with progress(console, "estimator") as advance:

        def step() -> None:
            nonlocal done
            advance(done / total)
            done += 1

        for name in names:
            case = CASES[name]
            figures.append(measure_case(case, options.count, options.seed, options.segments, step))
        more: dict[str, Any] = {"cost": measure_cost(81, options.seed)}
        if options.rendered:
            more["rendered"] = measure_rendered(options.rendered, options.seed, lambda: None)
    console.print(_table(figures))
    log, cost = make_log(console), more["cost"]
    extra = cost["estimate_s"] - cost["prediction_s"]
    log(
        f"n = 81, {cost['points']:.0f} points: {1e6 * cost['estimate_s']:.0f} us a frame,"
        f" {1e6 * extra:.0f} us more than the prediction alone"
    )
    if "rendered" in more:
        found = more["rendered"]
        log(
            f"rendered frames: {found['found']} of {found['runs']} posts found within 0.5 s, {found['late']} later"
            f" (needle not tracked at {found['untracked_at_contact']} contacts), {found['early']} before;"
            f" {found['false_reports']} of {found['runs_without_post']} runs without a post with a false report;"
            f" estimate {found['estimate_mean']:.3f}, {found['estimate_maximum']:.2f}"
        )
    return {"cases": figures, **more}, all(each["met"] for each in figures)


def _table(figures: list[dict[str, Any]]) -> Table:
    table = Table(title="mean, greatest error in % of the length", title_justify="left", title_style="bold")
    table.add_column("case", no_wrap=True)
    for name in ("limit", "estimate", "prediction", "consistent", "found", "met"):
        table.add_column(name, justify="right", no_wrap=True)
    for each in figures:
        pairs = each["limits"], each["estimate"].values(), each["prediction"].values()
        table.add_row(
            each["name"],
            *("{:.3f} {:6.2f}".format(*pair) for pair in pairs),
            f"{100.0 * each['consistent']:.0f} %",
            f"{each['found']} of {each['runs']}" if each["name"] == "unknown post" else "",
            "yes" if each["met"] else "no",
        )
    return table
