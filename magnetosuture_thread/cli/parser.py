"""What can be written on the command line."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from magnetosuture_thread.cli import commands

DESCRIPTION = """\
Predicts where a suture thread goes behind a magnetically steered needle.

Research software, no medical device. Lengths are in metres and times in seconds throughout.
"""

RECORD = """\
Render a reference trajectory as the overhead camera would see it, and write a bag: JPEG frames,
camera_info, the needle velocity commands that the trajectory amounts to, and the truth. Everything in
the bag is simulated; its notes say so, and `replay` repeats it.
"""

REPLAY = """\
Play an mcap bag through the live graph: vision_tracker, thread_model and coil_bridge run as processes
of their own, on a ROS domain that nobody else uses, with simulated time on /clock and no hardware.

DIR, which must not exist, gets
  bag/           all outputs of the graph, an mcap bag
  summary.json   the figures of the table
  summary.png    a frame with the predicted thread over the seen one; error and margins over time
  logs/          what each node printed
"""

EVALUATE = """\
Score the thread model on reference trajectories: files DIR/*.npz with the needle's poses and the thread
that followed (arrays t, pose, X and meta, as for `record`). The model starts from the first thread, is
driven by the poses and nothing else, with each file's own thread and parameters, and is compared at every
sample. Errors are mean distances of the nodes in % of the thread's length.
"""

BENCH = """\
Time the thread model on this machine: one whole step (barriers, obstacles and solves) and the solve
alone, by number of segments, dimension, obstacles and solver, with the largest residual beside every
time. Single thread, wall clock; the machine's other work shows in the 99th percentile.
"""

EXIT_CODES = "exit codes: 0 done, 1 the job failed, 2 wrong use"


def make_parser() -> argparse.ArgumentParser:
    """Return the parser; each command sets `run` to what it does."""
    parser = argparse.ArgumentParser(
        prog="magnetosuture",
        description=DESCRIPTION,
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    replay = _command(subparsers, "replay", "play a recorded bag through the live graph", REPLAY, commands.replay)
    replay.add_argument("bag", type=Path, metavar="BAG", help="an mcap file, or the folder of a bag")
    replay.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder to make")
    replay.add_argument(
        "--setup", default="", metavar="NAME", help="a set-up's name or YAML file (default: the one the bag names)"
    )
    replay.add_argument(
        "--rate", type=number(0.05, 20.0), default=1.0, help="how much faster than recorded (default: 1)"
    )
    record = _command(subparsers, "record", "write a bag of simulated camera frames", RECORD, commands.record)
    record.add_argument("reference", type=Path, metavar="REFERENCE", help="a reference trajectory (.npz)")
    record.add_argument("--output", type=Path, required=True, metavar="BAG", help="folder of the bag to make")
    record.add_argument("--setup", required=True, metavar="NAME", help="a set-up's name or YAML file")
    record.add_argument("--start", type=number(0.0, 1e6), default=0.0, help="time in the trajectory to begin at [s]")
    record.add_argument("--duration", type=number(1e-3, 1e6), help="[s] (default: to the trajectory's end)")
    record.add_argument("--rate", type=number(1.0, 240.0), default=30.0, help="frames a second (default: 30)")
    record.add_argument(
        "--quality",
        type=int,
        choices=range(1, 101),
        default=85,
        metavar="1..100",
        help="of the JPEG frames (default: 85)",
    )
    record.add_argument("--seed", type=whole_number, default=0, help="of dust and sensor noise (default: 0)")
    evaluate = _command(
        subparsers, "evaluate", "score the model on reference trajectories", EVALUATE, commands.evaluate
    )
    evaluate.add_argument("folder", type=Path, metavar="DIR", help="folder of trajectories, or one .npz file")
    evaluate.add_argument(
        "--formulation", choices=("rod", "paper"), default="rod", help="how a step is written (default: rod)"
    )
    evaluate.add_argument(
        "--solver", choices=("banded", "osqp"), default="banded", help="what solves a step (default: banded)"
    )
    evaluate.add_argument(
        "--segments", type=segments, metavar="N", help="number of segments (default: the paper's, as each file says)"
    )
    evaluate.add_argument("--json", type=output_file, metavar="FILE", help="write the figures to a file")
    evaluate.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw each case into a folder")
    bench = _command(subparsers, "bench", "time the model on this machine", BENCH, commands.bench)
    bench.add_argument(
        "--peers", action="store_true", help="time other solvers and simulators too (needs the extra `peers`)"
    )
    bench.add_argument("--json", type=output_file, metavar="FILE", help="write the figures to a file")
    return parser


def _command(
    subparsers: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    summary: str,
    description: str,
    run: Callable[[argparse.Namespace], int],
) -> argparse.ArgumentParser:
    parser = subparsers.add_parser(
        name,
        help=summary,
        description=description,
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


def number(low: float, high: float) -> Callable[[str], float]:
    """Return an argument type: a number within bounds."""

    def within(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is no number from {low:g} to {high:g}")
        return value

    return within


def whole_number(text: str) -> int:
    """Return a whole number of at least 0: an argument type."""
    if not (text.isascii() and text.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number of at least 0")
    return int(text)


def segments(text: str) -> int:
    """Return a number of segments: an argument type."""
    count = whole_number(text)
    if not 3 <= count <= 2000:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of segments from 3 to 2000")
    return count


def output_file(text: str) -> Path:
    """Return a file to write, in a folder that exists: an argument type."""
    path = Path(text)
    if not path.parent.is_dir() or path.is_dir():
        raise argparse.ArgumentTypeError(f"{text!r} is no file in a folder that exists")
    return path
