"""The command `magnetosuture reproduce`."""

from __future__ import annotations

import argparse
from pathlib import Path

from magnetosuture_thread.commands.command import DONE, Terminal, add_actions


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    text = "Reproduce a result of the paper, simulated."
    results = {"hernia": run_hernia, "thread_behavior": run_thread_behavior}
    hernia, behavior = add_actions(parser, text, "results", "RESULT", **results)
    hernia.add_argument("bag", type=Path, metavar="BAG", help="a bag with an operator's velocity commands")
    for result in (hernia, behavior):
        result.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder to make")
    default = "(default: the bag's, with the paper's 40 segments)"
    hernia.add_argument("--setup", default="", metavar="NAME", help=f"setup or YAML file {default}")
    hernia.add_argument("--formulation", choices=("rod", "paper"), default="", help="(default: the setup's)")
    hernia.add_argument("--animation", action="store_true", help="draw hernia.gif as well")


def run_hernia(options: argparse.Namespace, terminal: Terminal) -> int:
    """Replay a recorded steering around a hernia.

    The paper's simulated hernia repair: a needle steered by hand draws a thread through a penetration path and
    around a ring. BAG holds the commanded velocities of the needle, on /operator/servo_cv; friction slows it and
    barriers keep it off the obstacles, as they do live. In the thread model alone, where the needle is a point;
    `magnetosuture console hernia_ring` is the same with a whole rig.
    DIR, which must not exist, gets hernia.json and hernia.png: six instants, and the barriers over time.
    """
    from magnetosuture_thread.commands.reproduce_hernia import hernia_lines, hernia_table, replay_hernia

    given = {"setup_name": options.setup, "formulation": options.formulation, "animation": options.animation}
    with terminal.progress("hernia") as advance:
        summary = replay_hernia(options.bag, options.output, log=terminal.log, progress=advance, **given)
    terminal.print(hernia_table(summary))
    for line in (*hernia_lines(summary), f"results: {options.output}"):
        terminal.log(line)
    return DONE


def run_thread_behavior(options: argparse.Namespace, terminal: Terminal) -> int:
    """Compare prediction and ground truth in closed loop, by material.

    The paper's two thread-behavior tests in a closed loop around the simulated rig, a polyamide thread of 19 mm and
    a silk thread of 150 mm in a larger dish: the predicted thread against ground truth and against what the camera
    measures. DIR, which must not exist, gets a bag of each, behaviour.json and behaviour.png. Everything is
    simulated. Takes two minutes.
    """
    from magnetosuture_thread.commands.reproduce_thread_behavior import behavior_table, thread_behavior

    with terminal.progress("thread-behavior") as advance:
        runs = thread_behavior(options.output, log=terminal.log, progress=advance)
    terminal.print(behavior_table(runs))
    terminal.log(f"results: {options.output}")
    return DONE
