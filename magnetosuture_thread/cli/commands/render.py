"""The command `magnetosuture render`."""

from __future__ import annotations

import argparse
from pathlib import Path

from magnetosuture_thread.cli.arguments import number_argument, whole_number
from magnetosuture_thread.cli.command import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console, make_log, progress
from magnetosuture_thread.errors import ConfigurationError

DESCRIPTION = """\
Render a reference trajectory as the overhead camera would see it, and write a bag: JPEG frames,
camera_info, the needle velocity commands that the trajectory amounts to, and the truth. With --poses, needle
poses and seen threads take the place of frames. Everything in the bag is simulated; its notes say so, and
`replay` repeats it.
"""


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = command(subparsers, "render", "write a bag of simulated camera frames, or poses", DESCRIPTION, run)
    parser.add_argument("reference", type=Path, metavar="REFERENCE", help="a reference trajectory (.npz)")
    parser.add_argument("--output", type=Path, required=True, metavar="BAG", help="folder of the bag to make")
    parser.add_argument("--setup", required=True, metavar="NAME", help="a set-up's name or YAML file")
    parser.add_argument(
        "--start", type=number_argument(0.0, 1e6), default=0.0, help="time in the trajectory to begin at [s]"
    )
    parser.add_argument("--duration", type=number_argument(1e-3, 1e6), help="[s] (default: to the trajectory's end)")
    parser.add_argument(
        "--rate", type=number_argument(1.0, 240.0), default=30.0, help="frames, or poses, a second (default: 30)"
    )
    parser.add_argument(
        "--quality",
        type=int,
        choices=range(1, 101),
        default=85,
        metavar="1..100",
        help="of the JPEG frames (default: 85)",
    )
    parser.add_argument("--seed", type=whole_number, default=0, help="of dust and noise (default: 0)")
    parser.add_argument("--poses", action="store_true", help="write poses and seen threads instead of frames")
    parser.add_argument(
        "--noise",
        type=number_argument(0.0, 1e-2),
        default=0.0,
        metavar="METRES",
        help="of these, standard deviation; of the heading, this over the needle's length (default: 0)",
    )


def run(options: argparse.Namespace) -> int:
    """Write a bag of simulated camera frames, or poses."""
    if options.noise and not options.poses:
        raise ConfigurationError("--noise", options.noise, "none without --poses")

    from magnetosuture_thread.evaluation.reference import read_reference
    from magnetosuture_thread.jobs.render import render_bag
    from magnetosuture_thread.setups import read_setup

    console = make_console()
    setup = read_setup(options.setup)
    reference = read_reference(options.reference)
    with progress(console, "render") as advance:
        frames = render_bag(
            reference,
            setup,
            options.output,
            start=options.start,
            duration=options.duration,
            rate=options.rate,
            quality=options.quality,
            seed=options.seed,
            poses=options.poses,
            noise=options.noise,
            progress=advance,
        )
    make_log(console)(f"{frames} simulated {'poses' if options.poses else 'frames'} in {options.output}")
    return DONE
