"""The command `magnetosuture replay`."""

from __future__ import annotations

import argparse
from pathlib import Path

from magnetosuture_thread.cli.arguments import add_source, number_argument
from magnetosuture_thread.cli.command import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console, make_log, progress
from magnetosuture_thread.errors import ConfigurationError

DESCRIPTION = """\
Play a bag through the live graph: vision_tracker, thread_model and coil_bridge run as processes of their
own, on a ROS domain that nobody else uses, with simulated time on /clock and no hardware. A bag of needle
poses instead of camera frames is played without vision_tracker.

While it plays, the service /replay/pause (std_srvs/SetBool) lets time stand still; the domain to call it on
is said at the start. --loop plays over and over: time goes back and the nodes begin anew. The first pass
is recorded and judged; Ctrl-C then ends, and the results are kept.

--offline puts the bag through the same tracker and model without a graph, as fast as the machine can: the
same poses, predictions and margins to the last bit, and two runs write the same bag. The coil bridge has no
part in it, as what it does depends on real time.

DIR, which must not exist, gets
  bag/           all outputs of the graph, an mcap bag
  summary.json   the figures of the table
  summary.png    a frame with the predicted thread over the seen one; error and margins over time
  logs/          what each node printed (live only)
"""


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = command(subparsers, "replay", "play a recorded bag through the live graph, or offline", DESCRIPTION, run)
    parser.add_argument("bag", type=Path, metavar="BAG", help="an mcap file, or the folder of a bag")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder to make")
    parser.add_argument(
        "--setup", default="", metavar="NAME", help="a set-up's name or YAML file (default: the one the bag names)"
    )
    parser.add_argument("--offline", action="store_true", help="without a graph, as fast as the machine can")
    parser.add_argument("--rate", type=number_argument(0.05, 20.0), help="how much faster than recorded (default: 1)")
    parser.add_argument("--loop", action="store_true", help="play over and over, until Ctrl-C")
    parser.add_argument("--start", type=number_argument(0.0, 1e6), default=0.0, help="seconds into the bag to begin at")
    parser.add_argument("--duration", type=number_argument(1e-3, 1e6), help="[s] (default: to the bag's end)")
    add_source(parser)


def run(options: argparse.Namespace) -> int:
    """Play a bag through the live graph, or put it through the core alone."""
    for name in ("rate", "loop"):
        if options.offline and getattr(options, name):
            raise ConfigurationError(f"--{name}", getattr(options, name), "none with --offline, which knows no time")

    from magnetosuture_thread.evaluation.tables import summary_table
    from magnetosuture_thread.jobs.replay import replay_live
    from magnetosuture_thread.jobs.replay_offline import replay_offline

    console = make_console()
    log = make_log(console)
    with progress(console, "replay") as advance:
        given = {
            "setup_name": options.setup,
            "source": options.source,
            "start": options.start,
            "duration": options.duration,
            "remap": dict(options.remap),
            "frame": options.frame,
            "log": log,
            "progress": advance,
        }
        if options.offline:
            summary = replay_offline(options.bag, options.output, **given)
        else:
            summary = replay_live(options.bag, options.output, rate=options.rate or 1.0, loop=options.loop, **given)
    console.print(summary_table(summary))
    log(f"results: {options.output}")
    return DONE
