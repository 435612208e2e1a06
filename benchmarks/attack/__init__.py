"""Attack the package with hostile input, varied at random, and hold it against what is promised.

`bags`: mcap and sqlite3 bags with flipped bits, cuts, blocks of zeros, moved and repeated bytes. Each is read, repaired
and salvaged by a process of its own. No altered message may be accepted as sound, none may be lost silently, and no bag
may take more than 5 s or 300 MB. 2,000 bags take six minutes. Only files in a temporary folder are written.

`nodes`: hostile requests, messages and times for all nodes around a simulated rig, on a ROS domain of its own that does
not leave this machine. No node may end or be silent for more than 0.5 s, and the emergency stop must be answered within
0.2 s throughout. 20,000 attacks take five minutes.
"""

from __future__ import annotations

import argparse
import random
from typing import Any

from magnetosuture_thread.commands.command import Terminal, count_argument, whole_number

TARGETS = ("bags", "nodes")
MAX_LINES = 20  # on broken promises that are shown; `--json` writes all


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("target", choices=TARGETS, metavar="TARGET", help=f"one of {', '.join(TARGETS)}")
    count = count_argument("attacks", 1, 1_000_000)
    parser.add_argument("--count", type=count, default=2000, metavar="N", help="of attacks (default: 2000)")
    parser.add_argument("--seed", type=whole_number, default=1, metavar="S", help="of the variation (default: 1)")


def run(options: argparse.Namespace, terminal: Terminal) -> tuple[dict[str, Any], bool]:
    """Attack; return the figures and whether all promises were kept."""
    with terminal.progress(f"attack {options.target}") as advance:
        if options.target == "bags":
            from benchmarks.attack.bags import attack_bags

            figures, lines = attack_bags(options.count, options.seed, advance)
        else:
            from benchmarks.attack.nodes import Attack  # needs ROS

            attack, with_clock = Attack(options.count, advance), round(0.25 * options.count)
            # First by the time of the day, then by a simulated clock.
            for number, clock in ((options.count - with_clock, False), (with_clock, True)):
                if number:
                    attack.attack(number, random.Random(f"{options.seed} {clock}"), clock)
            figures, lines = attack.figures()
    for line in (*lines, *figures["broken"][:MAX_LINES]):
        terminal.log(line)
    chosen = {"target": options.target, "count": options.count, "seed": options.seed}
    return {**chosen, **figures}, not figures["broken"]
