"""The command `magnetosuture`: its parser, and errors as exit codes."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from magnetosuture_thread import ConfigurationError, MagnetosutureError, __version__
from magnetosuture_thread.cli.arguments import EXIT_CODES, FAILED, WRONG_USE, check_outputs
from magnetosuture_thread.cli.commands import bag, calibrate, campaign, compile_kernels, evaluate, run_graph, scene
from magnetosuture_thread.cli.terminal import make_console
from magnetosuture_thread.errors import missing_module

MOVED = {  # commands of before, and what is written instead
    "record": "`magnetosuture render`",
    "bench": "`python -m benchmarks solver|bridge|page`, in the source tree",
    "hernia": "`magnetosuture reproduce hernia`",
    "behaviour": "`magnetosuture reproduce thread-behavior`",
}
COMMANDS = (run_graph, evaluate, calibrate, campaign, scene, bag, compile_kernels)  # in the order of --help

DESCRIPTION = """\
Predicts where a suture thread goes behind a magnetically steered needle.

Research software, no medical device. Lengths are in metres and times in seconds throughout.
"""


def make_parser() -> argparse.ArgumentParser:
    """Return the parser; each command sets `run` to what it does."""
    parser = argparse.ArgumentParser(
        prog="magnetosuture",
        description=DESCRIPTION,
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for module in COMMANDS:
        module.add(subparsers)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given and given[0] in MOVED:
        return _fail(f"the command {given[0]!r} is now {MOVED[given[0]]}", WRONG_USE)
    options = make_parser().parse_args(given)

    def run() -> int:
        check_outputs(options)
        return int(options.run(options))

    return exit_code(run)


def exit_code(run: Callable[[], int]) -> int:
    """Return the exit code of what runs; an error ends it with one line on standard error."""
    try:
        with _interrupted_by(signal.SIGTERM, signal.SIGHUP):
            return run()
    except ConfigurationError as error:
        return _fail(str(error), WRONG_USE)
    except ModuleNotFoundError as error:
        return _fail(missing_module(error), FAILED)
    except (MagnetosutureError, OSError) as error:
        return _fail(str(error), FAILED)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return FAILED


def _fail(problem: str, code: int) -> int:
    errors = make_console(errors=True)
    errors.print("error:", style="bold red", end=" ")
    errors.print(" ".join(problem.split()), markup=False)
    return code


@contextmanager
def _interrupted_by(*signals: signal.Signals) -> Iterator[None]:
    """Treat these signals as Ctrl-C, so that whatever ends this process, the nodes end too and nothing partial stays.

    One that is ignored, as under nohup, stays ignored.
    """

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    handled = [which for which in signals if signal.getsignal(which) is not signal.SIG_IGN]
    before = [(which, signal.signal(which, interrupt)) for which in handled]
    try:
        yield
    finally:
        for which, handler in before:
            signal.signal(which, handler)
