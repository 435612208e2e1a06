"""Measure the thread estimator against ground truth, beside the prediction alone, the camera alone and a registration.

The truth is the rod of the simulated rig behind a needle that wanders through the dish; the camera gives points of it,
with correlated noise, gaps and outliers. Errors are distances of nodes from the truth, in % of the thread's length.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.estimator.cases import CASES
from benchmarks.estimator.measurements import (
    THREADS,
    CaseFigures,
    Errors,
    as_json,
    measure_case,
    measure_cost,
    measure_long,
    measure_references,
)
from benchmarks.estimator.rendered import measure_rendered
from benchmarks.estimator.slow import measure_slow
from magnetosuture_thread.cli.terminal import make_log, progress


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--count", type=int, default=2, metavar="N", help="runs of each case and thread (default: 2)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="of the first run (default: 1)")
    parser.add_argument("--cases", nargs="+", choices=list(CASES), metavar="CASE", help="only these; default: all")
    parser.add_argument("--segments", type=int, default=25, metavar="N", help="of the model (default: 25)")
    parser.add_argument(
        "--trackers", action="store_true", help="compare with the camera alone and a registration tracker"
    )
    parser.add_argument("--references", type=Path, metavar="DIR", help="also on the reference trajectories of a folder")
    parser.add_argument("--slow", action="store_true", help="also what is learned on line of thread and liquid")
    parser.add_argument(
        "--rendered", type=int, default=0, metavar="N", help="also N seeds of unknown posts, by rendered frames"
    )
    parser.add_argument("--long", type=float, default=0.0, metavar="MINUTES", help="also one long run")


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
            figures.append(measure_case(case, options.count, options.seed, options.segments, options.trackers, step))
        more: dict[str, Any] = {"cost": measure_cost(81, options.seed)}
        if options.references:
            more["references"] = measure_references(options.references, options.seed, lambda: None)
        if options.slow:
            more["slow_parameters"] = measure_slow(options.count, options.seed, lambda: None)
        if options.rendered:
            more["rendered"] = measure_rendered(options.rendered, options.seed, lambda: None)
        if options.long > 0.0:
            more["long"] = measure_long(options.long, options.seed, options.segments)
    console.print(_table(figures, options.trackers))
    log, cost = make_log(console), more["cost"]
    extra = cost["estimate_s"] - cost["prediction_s"]
    log(
        f"n = 81, {cost['points']:.0f} points: {1e6 * cost['estimate_s']:.0f} us a frame,"
        f" {1e6 * extra:.0f} us more than the prediction alone"
    )
    for name, found in more.get("references", {}).items():
        log(
            f"{name}: estimate {found['estimate_mean']:.3f}, {found['estimate_maximum']:.2f};"
            f" prediction {found['prediction_mean']:.3f}, {found['prediction_maximum']:.2f}"
        )
    for found in more.get("slow_parameters", []):
        log(
            f"{found['case']}, {found['material']}: {found['parameter']} off by {found['error_mean']:.2g} in the mean,"
            f" half interval {found['half_interval_mean']:.2g}, {100.0 * found['coverage']:.0f} % inside"
        )
    if "rendered" in more:
        found = more["rendered"]
        log(
            f"rendered frames: {found['found']} of {found['runs']} posts found within 0.5 s, {found['late']} later"
            f" (needle not tracked at {found['untracked_at_contact']} contacts), {found['early']} before;"
            f" {found['false_reports']} of {found['runs_without_post']} runs without a post with a false report;"
            f" estimate {found['estimate_mean']:.3f}, {found['estimate_maximum']:.2f}"
        )
    if "long" in more:
        found = more["long"]
        log(
            f"{found['minutes']:g} minutes, stiffness x 5: first minute {found['first_minute_mean']:.3f},"
            f" last {found['last_minute_mean']:.3f}, greatest {found['maximum']:.2f}"
        )
    return {"cases": as_json(figures), **more}, all(each.met for each in figures)


def _table(figures: list[CaseFigures], with_trackers: bool) -> Table:
    table = Table(title="mean, greatest error in % of the length", title_justify="left", title_style="bold")
    table.add_column("case", no_wrap=True)
    for name in ("limit", "estimate", "prediction", *(("camera", "registration") if with_trackers else ())):
        table.add_column(name, justify="right", no_wrap=True)
    for name in ("consistent", "found", "met"):
        table.add_column(name, justify="right", no_wrap=True)
    for each in figures:
        limit, trackers = Errors(*each.limits), (each.camera, each.registration) if with_trackers else ()
        table.add_row(
            each.name,
            *(_pair(errors) for errors in (limit, each.estimate, each.prediction, *trackers) if errors),
            f"{100.0 * each.consistent:.0f} %",
            f"{each.found} of {each.runs}" if each.name == "unknown post" else "",
            "yes" if each.met else "no",
        )
    return table


def _pair(errors: Errors) -> str:
    return f"{errors.mean:.3f} {errors.maximum:6.2f}"
