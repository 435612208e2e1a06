"""Runs the command and turns errors into exit codes."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console

from magnetosuture_thread.cli.parser import make_parser
from magnetosuture_thread.errors import ConfigurationError, MagnetosutureError

FAILED, WRONG_USE = 1, 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    options = make_parser().parse_args(arguments)
    run: Callable[[argparse.Namespace], int] = options.run
    try:
        with _interrupted_by(signal.SIGTERM, signal.SIGHUP):
            return run(options)
    except ConfigurationError as error:
        return _fail(str(error), WRONG_USE)
    except MagnetosutureError as error:
        return _fail(str(error), FAILED)
    except ModuleNotFoundError as error:
        return _fail(f"{error}; the live graph needs ROS 2 Jazzy: see the README, or pip install '.[ros]'", FAILED)
    except OSError as error:
        return _fail(str(error), FAILED)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return FAILED


def _fail(problem: str, code: int) -> int:
    errors = Console(stderr=True, soft_wrap=True, highlight=False)
    errors.print("error:", style="bold red", end=" ")
    errors.print(" ".join(problem.split()), markup=False)
    return code


@contextmanager
def _interrupted_by(*signals: signal.Signals) -> Iterator[None]:
    """Treat these signals as Ctrl-C, so that whatever ends us, the nodes end too and nothing half-made stays.

    One that is ignored, as under nohup, stays ignored.
    """

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    heeded = [which for which in signals if signal.getsignal(which) is not signal.SIG_IGN]
    before = [(which, signal.signal(which, interrupt)) for which in heeded]
    try:
        yield
    finally:
        for which, handler in before:
            signal.signal(which, handler)
