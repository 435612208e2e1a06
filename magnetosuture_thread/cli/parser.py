"""What can be written on the command line."""

from __future__ import annotations

import argparse

from magnetosuture_thread.cli.command import EXIT_CODES
from magnetosuture_thread.cli.commands import (
    bag,
    calibrate,
    calibrate_camera,
    calibrate_coils,
    coils,
    console,
    evaluate,
    render,
    replay,
    reproduce,
    scene,
    simulate,
    track,
)

DESCRIPTION = """\
Predicts where a suture thread goes behind a magnetically steered needle.

Research software, no medical device. Lengths are in metres and times in seconds throughout.
"""

# In the order of --help.
COMMANDS = (
    replay.add,
    render.add,
    simulate.add,
    console.add,
    reproduce.add,
    evaluate.add,
    track.add,
    calibrate.add,
    calibrate_camera.add,
    calibrate_coils.add,
    coils.add,
    scene.add,
    bag.add,
)


def make_parser() -> argparse.ArgumentParser:
    """Return the parser; each command sets `run` to what it does."""
    parser = argparse.ArgumentParser(
        prog="magnetosuture",
        description=DESCRIPTION,
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for add in COMMANDS:
        add(subparsers)
    return parser
