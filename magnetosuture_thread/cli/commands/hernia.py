"""The command `magnetosuture hernia`."""

from __future__ import annotations

import argparse
from pathlib import Path

from magnetosuture_thread.cli.command import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console, progress, sayer

DESCRIPTION = """\
Replay the paper's simulated hernia repair: a needle steered by hand draws a thread through a
penetration path and around a ring. BAG holds what was asked of the needle, on /operator/servo_cv;
friction slows it and barriers keep it off the obstacles, as they do live. In the thread model alone,
where the needle is a point; `magnetosuture console hernia_ring` is the same with a whole rig.
DIR, which must not exist, gets hernia.json and hernia.png: six instants, and the barriers over time.
"""


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = command(subparsers, "hernia", "replay a recorded steering around a hernia", DESCRIPTION, run)
    parser.add_argument("bag", type=Path, metavar="BAG", help="a bag with what an operator asked for")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder to make")
    parser.add_argument("--setup", default="", metavar="NAME", help="set-up or YAML file (default: the bag's)")
    parser.add_argument("--formulation", choices=("rod", "paper"), default="", help="(default: the set-up's)")
    parser.add_argument("--animation", action="store_true", help="draw hernia.gif as well")


def run(options: argparse.Namespace) -> int:
    """Replay a steering around a hernia."""
    from magnetosuture_thread.jobs.hernia import hernia
    from magnetosuture_thread.study.hernia.table import hernia_lines, hernia_table

    console = make_console()
    say = sayer(console)
    with progress(console, "hernia") as advance:
        summary = hernia(
            options.bag,
            options.output,
            setup_name=options.setup,
            formulation=options.formulation,
            animation=options.animation,
            say=say,
            progress=advance,
        )
    console.print(hernia_table(summary))
    for line in hernia_lines(summary):
        say(line)
    say(f"results: {options.output}")
    return DONE
