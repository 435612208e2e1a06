"""The command `magnetosuture replay`: a recorded bag through the live graph, or through the same core without one."""

from __future__ import annotations

import argparse
from pathlib import Path

from magnetosuture_thread import ConfigurationError, replay_offline
from magnetosuture_thread.commands import command
from magnetosuture_thread.evaluation.tables import summary_table


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option = parser.add_argument
    option("bag", type=command.bag_location, metavar="BAG", help="an mcap file, or the folder of a bag, or its URL")
    option("--output", type=Path, required=True, metavar="DIR", help="folder to make")
    option("--offline", action="store_true", help="without a graph, as fast as the machine can")
    option("--rate", type=command.number_argument(0.05, 20.0), help="how much faster than recorded (default: 1)")
    option("--loop", action="store_true", help="play over and over, until Ctrl-C")
    command.add_span(parser)
    command.add_source(parser)


def run_replay(options: argparse.Namespace, terminal: command.Terminal) -> None:
    """Play a recorded bag through the live graph, or offline.

    vision_tracker, thread_model and coil_bridge run as processes of their own, on a ROS domain that nobody else
    uses, with simulated time on /clock and no hardware. A bag of needle poses instead of camera frames is played
    without vision_tracker.

    While it plays, the service /replay/pause (std_srvs/SetBool) lets time stand still; the domain to call it on
    is printed at the start. --loop plays over and over: time goes back and the nodes begin anew. The first pass
    is recorded and evaluated; Ctrl-C then ends, and the results are kept.

    --offline puts the bag through the same tracker and model without a graph, as fast as the machine can: the
    same poses, predictions and margins to the last bit, and two runs write the same bag. The coil bridge has no
    part in it, as what it does depends on real time.

    DIR, which must not exist, gets
      bag/           all outputs of the graph, an mcap bag
      summary.json   the figures of the table
      summary.png    the frame with the greatest error, and errors and margins over time
      logs/          what each node printed (live only)
    """
    for name in ("rate", "loop"):
        if options.offline and getattr(options, name):
            raise ConfigurationError(f"--{name}", getattr(options, name), "none with --offline, which knows no time")
    with terminal.progress("replay") as advance:
        chosen = {**command.bag_selection(options), "log": terminal.log, "progress": advance}
        if options.offline:
            summary = replay_offline(options.bag, options.output, **chosen)
        else:
            from magnetosuture_thread.commands.live import replay_live  # late, as it needs ROS

            summary = replay_live(options.bag, options.output, rate=options.rate or 1.0, loop=options.loop, **chosen)
    terminal.print(summary_table(summary))
    terminal.log(f"results: {options.output}")
