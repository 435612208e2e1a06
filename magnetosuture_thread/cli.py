"""The command `magnetosuture`: its parser, and errors as exit codes; `python -m magnetosuture_thread.cli` too."""

from __future__ import annotations

import argparse
import inspect
import io
import os
import signal
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module

from magnetosuture_thread import ConfigurationError, MagnetosutureError, __version__
from magnetosuture_thread.commands.command import DONE, FAILED, WRONG_USE, Terminal, check_outputs, describe, runs
from magnetosuture_thread.settings.errors import missing_module

DESCRIPTION = """\
Predicts where a suture thread goes behind a magnetically steered needle.

Research software, no medical device. Lengths are in metres and times in seconds throughout.
"""
# Name and summary of each command. The file of `commands` is imported when the command is given, so that --help is
# quick. In it `add`, or `add_...` of what comes after a hyphen, adds the arguments, and `run_...` does the work; the
# docstring of the latter is the text under --help, and that of `add` where there are sub-commands.
COMMANDS = {
    "replay": "play a recorded bag through the live graph, or offline",
    "render": "write a bag of simulated camera frames, or poses",
    "simulate": "run the whole graph around a simulated rig",
    "console": "serve the operator's page",
    "coils": "arm, disarm, stop or reset the running coil bridge",
    "reproduce": "reproduce a result of the paper, simulated",
    "evaluate": "score the thread model on bags, or on reference trajectories",
    "track": "find needle and thread in camera frames, without a graph",
    "teach": "learn how the needle looks from one frame on which both of its ends are marked",
    "calibrate": "fit the thread's parameters to recorded bags",
    "calibrate-camera": "find where the dish is in the camera's image",
    "calibrate-coils": "find the coils' properties from probe measurements",
    "commission": "let a rig measure its coils, its needle and its delay",
    "commission-thread": "let a commissioned rig measure its thread",
    "campaign": "run an autonomous procedure in the simulated closed loop, once for each seed",
    "scene": "check a scene file, or draw it",
    "bag": "check a recorded bag, or repair it",
    "compile": "compile the functions that every node runs, so that nodes start at once",
}


def make_parser(names: Collection[str] = tuple(COMMANDS)) -> argparse.ArgumentParser:
    """Return the parser, in which each command sets `run` to what it does.

    Args:
        names: commands that get their arguments; the others have their name and summary only.

    Raises:
        ModuleNotFoundError: a package that one of them needs is not installed.
    """
    parser = argparse.ArgumentParser(prog="magnetosuture", allow_abbrev=False)
    describe(parser, DESCRIPTION)
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, summary in COMMANDS.items():
        subparser = subparsers.add_parser(name, help=summary, allow_abbrev=False)
        if name in names:
            verb, _, kind = name.partition("-")
            module = import_module(f"magnetosuture_thread.commands.{verb}")
            add = getattr(module, f"add_{kind}" if kind else "add")
            describe(subparser, inspect.getdoc(add) or "")
            if run := getattr(module, f"run_{name.replace('-', '_')}", None):
                runs(subparser, run)
            add(subparser)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)

    def run() -> int:
        options = make_parser(words[:1]).parse_args(words)
        check_outputs(options)
        return int(options.run(options, Terminal()) or DONE)

    return exit_code(run)


def exit_code(run: Callable[[], int]) -> int:
    """Return the exit code of what runs; an error ends it with one line on standard error."""
    # A command draws into files. What a notebook asks of its own kernel may not be importable here.
    os.environ["MPLBACKEND"] = "agg"
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # what an encoding lacks, as µ without a locale, ends nothing
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
    errors = Terminal(errors=True)
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


if __name__ == "__main__":
    sys.exit(main())
