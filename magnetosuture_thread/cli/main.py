"""Runs the command and turns errors into exit codes."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console

from magnetosuture_thread.cli.parser import make_parser
from magnetosuture_thread.errors import ConfigurationError, MagnetosutureError

FAILED, WRONG_USE = 1, 2
MOVED = {  # commands of before, and what is written instead
    "record": "`magnetosuture render`",
    "bench": "`python -m benchmarks solver|bridge|page`, in the source tree",
    "hernia": "`magnetosuture reproduce hernia`",
    "behaviour": "`magnetosuture reproduce thread-behavior`",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given and given[0] in MOVED:
        return _fail(f"the command {given[0]!r} is now {MOVED[given[0]]}", WRONG_USE)
    options = make_parser().parse_args(given)
    return exit_code(lambda: int(options.run(options)))


def exit_code(run: Callable[[], int]) -> int:
    """Return the exit code of what runs; an error ends it with one line on standard error."""
    try:
        with _interrupted_by(signal.SIGTERM, signal.SIGHUP):
            return run()
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
