"""The command `magnetosuture behaviour`."""

from __future__ import annotations

import argparse
from pathlib import Path

from magnetosuture_thread.cli.command import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console, progress, sayer

DESCRIPTION = """\
Run the paper's two thread-behaviour tests in a closed loop around the simulated rig, a polyamide thread
of 19 mm and a silk thread of 150 mm in a larger dish, and compare the predicted thread with the truth
and with what the camera sees. DIR, which must not exist, gets a bag of each, behaviour.json and
behaviour.png. Everything is simulated. Takes two minutes.
"""


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = command(
        subparsers, "behaviour", "compare prediction and truth in closed loop, by material", DESCRIPTION, run
    )
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder to make")


def run(options: argparse.Namespace) -> int:
    """Run the thread-behaviour tests."""
    from magnetosuture_thread.jobs.behaviour import behaviour
    from magnetosuture_thread.study.behaviour_table import behaviour_table

    console = make_console()
    say = sayer(console)
    with progress(console, "behaviour") as advance:
        runs = behaviour(options.output, say=say, progress=advance)
    console.print(behaviour_table(runs))
    say(f"results: {options.output}")
    return DONE
