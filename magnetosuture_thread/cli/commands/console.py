"""The command `magnetosuture console`."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from magnetosuture_thread.cli.arguments import whole_number
from magnetosuture_thread.cli.command import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console, make_log

TOKEN = "MAGNETOSUTURE_TOKEN"

DESCRIPTION = f"""\
Serve the operator's page: the dish with needle and thread, the margins, the state of all nodes; steering by
arrow keys, gamepad or mouse; emergency stop, arm and disarm.

Without an option the whole graph is started around a simulated rig, with the coils disarmed, and any set-up
can be chosen on the page. --graph serves the page on the graph that runs on this ROS domain, --replay on a
bag that is played through the nodes over and over, which nobody can steer. Around a simulated rig vision_tracker
and thread_model get a real-time priority, where the system allows any: the browser shall not keep them.

The page is served on this machine alone unless --address and a token say otherwise. Without a token each
start makes its own, which is in the address that is printed. One in the environment, as {TOKEN}, is not shown
to others on this machine, as an option is.

Ctrl-C ends everything that this command has started; a recording that runs is kept.
"""


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = command(subparsers, "console", "serve the operator's page", DESCRIPTION, run)
    parser.add_argument(
        "scenario",
        metavar="SCENARIO",
        nargs="?",
        default="",
        help="a set-up's name or YAML file (default: of a 35 mm dish)",
    )
    either = parser.add_mutually_exclusive_group()
    either.add_argument("--graph", action="store_true", help="on the graph that runs on this ROS domain")
    either.add_argument("--replay", type=Path, metavar="BAG", help="on a bag that is played through the nodes")
    parser.add_argument("--address", help="network address to serve on (default: the set-up's, 127.0.0.1)")
    parser.add_argument("--port", type=whole_number, help="of it; 0 takes a free one (default: the set-up's, 8090)")
    parser.add_argument("--token", help=f"that commands need (default: {TOKEN} in the environment, or a new one)")
    parser.add_argument(
        "--record",
        type=Path,
        default=Path("output/recordings"),
        metavar="DIR",
        help="folder that gets a bag for each recording (default: output/recordings)",
    )


def run(options: argparse.Namespace) -> int:
    """Serve the operator's page."""
    from magnetosuture_thread.jobs.console import console

    console(
        options.scenario,
        running=options.graph,
        bag=options.replay,
        recordings=options.record,
        address=options.address,
        port=options.port,
        token=options.token or os.environ.pop(TOKEN, None) or None,  # no node gets it
        log=make_log(make_console()),
    )
    return DONE
