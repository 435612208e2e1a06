"""The command `magnetosuture reproduce`."""

from __future__ import annotations

import argparse
from pathlib import Path

from magnetosuture_thread.cli.command import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console, make_log, progress

DESCRIPTION = """\
Reproduce a result of the paper. Everything is simulated.
"""

HERNIA = """\
Replay the paper's simulated hernia repair: a needle steered by hand draws a thread through a
penetration path and around a ring. BAG holds what was asked of the needle, on /operator/servo_cv;
friction slows it and barriers keep it off the obstacles, as they do live. In the thread model alone,
where the needle is a point; `magnetosuture console hernia_ring` is the same with a whole rig.
DIR, which must not exist, gets hernia.json and hernia.png: six instants, and the barriers over time.
"""

THREAD_BEHAVIOR = """\
Run the paper's two thread-behavior tests in a closed loop around the simulated rig, a polyamide thread
of 19 mm and a silk thread of 150 mm in a larger dish, and compare the predicted thread with the truth
and with what the camera sees. DIR, which must not exist, gets a bag of each, behaviour.json and
behaviour.png. Everything is simulated. Takes two minutes.
"""


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = command(subparsers, "reproduce", "reproduce a result of the paper, simulated", DESCRIPTION, run_hernia)
    results = parser.add_subparsers(title="results", metavar="RESULT", required=True)
    hernia = command(results, "hernia", "replay a recorded steering around a hernia", HERNIA, run_hernia)
    hernia.add_argument("bag", type=Path, metavar="BAG", help="a bag with what an operator asked for")
    behavior = command(
        results,
        "thread-behavior",
        "compare prediction and truth in closed loop, by material",
        THREAD_BEHAVIOR,
        run_thread_behavior,
    )
    for result in (hernia, behavior):
        result.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder to make")
    hernia.add_argument("--setup", default="", metavar="NAME", help="set-up or YAML file (default: the bag's)")
    hernia.add_argument("--formulation", choices=("rod", "paper"), default="", help="(default: the set-up's)")
    hernia.add_argument("--animation", action="store_true", help="draw hernia.gif as well")


def run_hernia(options: argparse.Namespace) -> int:
    """Replay a steering around a hernia."""
    from magnetosuture_thread.reproduce.hernia.replay import hernia_lines, hernia_table, replay_hernia

    console = make_console()
    log = make_log(console)
    with progress(console, "hernia") as advance:
        summary = replay_hernia(
            options.bag,
            options.output,
            setup_name=options.setup,
            formulation=options.formulation,
            animation=options.animation,
            log=log,
            progress=advance,
        )
    console.print(hernia_table(summary))
    for line in (*hernia_lines(summary), f"results: {options.output}"):
        log(line)
    return DONE


def run_thread_behavior(options: argparse.Namespace) -> int:
    """Run the thread-behavior tests."""
    from magnetosuture_thread.reproduce.thread_behavior import behavior_table, thread_behavior

    console = make_console()
    log = make_log(console)
    with progress(console, "thread-behavior") as advance:
        runs = thread_behavior(options.output, log=log, progress=advance)
    console.print(behavior_table(runs))
    log(f"results: {options.output}")
    return DONE
