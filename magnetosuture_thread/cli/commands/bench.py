"""The command `magnetosuture bench`."""

from __future__ import annotations

import argparse
import json

from magnetosuture_thread.cli.arguments import output_file, whole_number
from magnetosuture_thread.cli.command import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console, progress, sayer, write_json

DESCRIPTION = """\
Time the thread model on this machine: one whole step (barriers, obstacles and solves) and the solve
alone, by number of segments, dimension, obstacles and solver, with the largest residual beside every
time. Single thread, wall clock; the machine's other work shows in the 99th percentile.

With --bridge, time the coil bridge instead: how long until the duties of two simulated RoboClaw boards, on
pseudo-terminals, are zero, after a commander fell silent and after kill -9 of commander, tracker and bridge;
how even its loop is; and what 10,000 hostile messages can do. Meanwhile all cores are kept busy. Takes nine
minutes.

With --console, time the operator's page instead, in Chromium without a window, on the whole graph around the
simulated rig with 81 segments: from a key press to the filtered velocity at the bridge, and the pictures that
the page draws; by the stamps of who sends. Needs chromium and playwright. Takes three minutes.
"""


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = command(subparsers, "bench", "time the model on this machine", DESCRIPTION, run)
    parser.add_argument(
        "--peers", action="store_true", help="time other solvers and simulators too (needs the extra `peers`)"
    )
    either = parser.add_mutually_exclusive_group()
    either.add_argument("--bridge", action="store_true", help="time the coil bridge instead, with simulated boards")
    either.add_argument("--console", action="store_true", help="time the operator's page instead, in a browser")
    parser.add_argument(
        "--presses", type=whole_number, default=200, metavar="N", help="of --console: of a key (default: 200)"
    )
    for name, default, what in (
        ("trials", 500, "a commander that falls silent"),
        ("kills", 20, "kill -9 of each process"),
        ("hostile", 10_000, "hostile messages"),
    ):
        parser.add_argument(
            f"--{name}",
            type=whole_number,
            default=default,
            metavar="N",
            help=f"of --bridge: {what} (default: {default})",
        )
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write the figures to a file")


def run(options: argparse.Namespace) -> int:
    """Time the model, the coil bridge, or the operator's page."""
    if options.console:
        return _bench_console(options)
    return _bench_bridge(options) if options.bridge else _bench_model(options)


def _bench_model(options: argparse.Namespace) -> int:
    from magnetosuture_thread.study.bench.run import bench
    from magnetosuture_thread.study.bench.table import bench_lines, bench_table

    console = make_console()
    say = sayer(console)
    with progress(console, "bench") as advance:
        report = bench(peers=options.peers, progress=advance)
    console.print(bench_table(report))
    for line in bench_lines(report):
        say(line)
    write_json(options.json, report.to_json())
    return DONE


def _bench_bridge(options: argparse.Namespace) -> int:
    from magnetosuture_thread.jobs.bench_bridge import bench_bridge
    from magnetosuture_thread.study.bridge_report import bridge_table

    console = make_console()
    with progress(console, "bench") as advance:
        report = bench_bridge(options.trials, options.kills, options.hostile, say=sayer(console), progress=advance)
    console.print(bridge_table(report))
    write_json(options.json, json.dumps(report.to_json(), indent=2, allow_nan=False))
    return DONE


def _bench_console(options: argparse.Namespace) -> int:
    from magnetosuture_thread.jobs.bench_console import bench_console
    from magnetosuture_thread.study.console_report import console_lines, console_table

    console = make_console()
    say = sayer(console)
    with progress(console, "bench") as advance:
        report = bench_console(options.presses, say=say, progress=advance)
    console.print(console_table(report))
    for line in console_lines(report):
        say(line)
    write_json(options.json, json.dumps(report.to_json(), indent=2, allow_nan=False))
    return DONE
