"""What all commands have in common: how one is added, and how it ends."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TypeAlias

Subparsers: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"

DONE = 0

EXIT_CODES = "exit codes: 0 done, 1 the job failed, 2 wrong use"


def command(
    subparsers: Subparsers,
    name: str,
    summary: str,
    description: str,
    run: Callable[[argparse.Namespace], int],
) -> argparse.ArgumentParser:
    """Add a command and return its parser, which has no arguments yet.

    Args:
        subparsers: of `magnetosuture`.
        name: as it is written on the command line.
        summary: its line in the list of commands.
        description: its text under --help.
        run: does what the options say, and returns the exit code.
    """
    parser = subparsers.add_parser(
        name,
        help=summary,
        description=description,
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser
