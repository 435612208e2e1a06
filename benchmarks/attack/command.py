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
from collections.abc import Callable
from typing import Any

from rich.console import Console

from benchmarks.attack.bags import attack_bags
from magnetosuture_thread.cli.arguments import count_argument, whole_number
from magnetosuture_thread.cli.terminal import make_log, progress

# Each returns its figures, its lines for a person, and whether all promises were kept.
Attack = Callable[[int, int, Callable[[float], None]], tuple[dict[str, Any], list[str], bool]]


def _attack_nodes(count: int, seed: int, progress: Callable[[float], None]) -> tuple[dict[str, Any], list[str], bool]:
    from benchmarks.attack.nodes import attack_nodes  # needs ROS

    return attack_nodes(count, seed, progress)


ATTACKS: dict[str, Attack] = {"bags": attack_bags, "nodes": _attack_nodes}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("target", choices=sorted(ATTACKS), metavar="TARGET", help=f"one of {', '.join(ATTACKS)}")
    count = count_argument("attacks", 1, 1_000_000)
    parser.add_argument("--count", type=count, default=2000, metavar="N", help="of attacks (default: 2000)")
    parser.add_argument("--seed", type=whole_number, default=1, metavar="S", help="of the variation (default: 1)")


def run(options: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Attack; return the figures and whether all promises were kept."""
    with progress(console, f"attack {options.target}") as advance:
        figures, lines, passed = ATTACKS[options.target](options.count, options.seed, advance)
    for line in lines:
        make_log(console)(line)
    return {"target": options.target, "count": options.count, "seed": options.seed, **figures}, passed
