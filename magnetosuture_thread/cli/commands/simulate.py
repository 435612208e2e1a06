"""The command `magnetosuture simulate`."""

from __future__ import annotations

import argparse
from pathlib import Path

from magnetosuture_thread.cli.arguments import number_argument, output_file
from magnetosuture_thread.cli.command import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console, make_log, progress, write_json

DESCRIPTION = """\
Run the whole graph without a robot: rig_simulator stands in for coils, dish, needle, thread and camera;
vision_tracker, thread_model and coil_bridge are the ones that run on a robot; path_follower asks for
needle velocities along the scenario's path. All are processes of their own, on a ROS domain that nobody
else uses. Everything is simulated, and the bag says so.

SCENARIO is a set-up with waypoints in its section path_follower. BAG, which must not exist, gets all that
was said, the truth included, and the nodes' logs; `replay` takes it. Ctrl-C ends the run, and what was
recorded stays. The first run on a machine compiles for a minute before it begins.
"""


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = command(subparsers, "simulate", "run the whole graph around a simulated rig", DESCRIPTION, run)
    parser.add_argument("scenario", metavar="SCENARIO", help="a set-up's name or YAML file")
    parser.add_argument("--output", type=Path, required=True, metavar="BAG", help="folder of the bag to make")
    parser.add_argument(
        "--duration",
        type=number_argument(0.1, 1e5),
        help="end after this many seconds (default: at the end of the path)",
    )
    either = parser.add_mutually_exclusive_group()
    either.add_argument(
        "--rate",
        type=number_argument(0.5, 5.0),
        help="run with a simulated clock, this much faster than real time (default: in real time)",
    )
    either.add_argument(
        "--boards", action="store_true", help="drive simulated RoboClaw boards, by the driver for real ones"
    )
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write the figures to a file")


def run(options: argparse.Namespace) -> int:
    """Run the whole graph around a simulated rig."""
    from magnetosuture_thread.evaluation.tables import loop_table
    from magnetosuture_thread.jobs.simulate import simulate

    console = make_console()
    log = make_log(console)
    new = not options.output.exists()
    try:
        with progress(console, "simulate") as advance:
            summary = simulate(
                options.scenario,
                options.output,
                duration=options.duration,
                rate=options.rate,
                boards=options.boards,
                log=log,
                progress=advance,
            )
    except KeyboardInterrupt:
        if new and options.output.exists():
            log(f"what was recorded is in {options.output}")
        raise
    console.print(loop_table(summary))
    log(f"bag: {options.output}")
    write_json(options.json, summary.to_json())
    return DONE
