"""Commands and their arguments: how a command is added, types that refuse wrong values, options that commands share."""

from __future__ import annotations

import argparse
import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

from magnetosuture_thread import ConfigurationError
from magnetosuture_thread.bags import parse_remap
from magnetosuture_thread.files import parse_location
from magnetosuture_thread.outputs import input_problem, output_problem

Subparsers: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"

DONE, FAILED, WRONG_USE = 0, 1, 2
STANDARD_OUTPUT = Path("-")  # as the file of --json, of benchmarks
EXIT_CODES = "exit codes: 0 done, 1 the job failed, 2 wrong use"


def command(
    subparsers: Subparsers, name: str, run: Callable[[argparse.Namespace], int] | None = None, text: str = ""
) -> argparse.ArgumentParser:
    """Add a command and return its parser, which has no arguments yet.

    Args:
        subparsers: of `magnetosuture`.
        name: as it is written on the command line.
        run: the command, called with the options; returns the exit code. Its docstring is the text under --help, and
            the first line of it is the line in the list of commands.
        text: the same of a command that only has sub-commands.
    """
    description = text if run is None else inspect.getdoc(run) or ""
    summary = description.partition("\n")[0].rstrip(".")
    parser = subparsers.add_parser(
        name,
        help=summary[:1].lower() + summary[1:],
        description=description,
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


def number_argument(low: float, high: float) -> Callable[[str], float]:
    """Return an argument type: a number within bounds."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is no number from {low:g} to {high:g}")
        return value

    return parse


def count_argument(things: str, low: int, high: int) -> Callable[[str], int]:
    """Return an argument type: a number of things within bounds."""

    def parse(text: str) -> int:
        count = whole_number(text)
        if not low <= count <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is no number of {things} from {low} to {high}")
        return count

    return parse


def whole_number(text: str) -> int:
    """Return a whole number of at least 0: an argument type."""
    if not (text.isascii() and text.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number of at least 0")
    return int(text)


def namespace_argument(text: str) -> str:
    """Return a ROS namespace, as `lab1` or `/lab1/left`, or none: an argument type."""
    if text and not re.fullmatch(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", text, re.ASCII):
        raise argparse.ArgumentTypeError(f"{text!r} is no ROS namespace, as lab1 or /lab1/left")
    return text


def output_file(text: str) -> Path:
    """Return a file to write, in a folder that exists: an argument type."""
    path = Path(text)
    if not path.parent.is_dir() or path.is_dir():
        raise argparse.ArgumentTypeError(f"{text!r} is no file in a folder that exists")
    return path


def bag_location(text: str) -> Path:
    """Return the place of a bag, a path or a URL: an argument type."""
    try:
        return parse_location(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is no path and no URL of a known file system: {error}") from None


def add_scheduler(parser: argparse._ActionsContainer) -> None:
    """Add the option --scheduler."""
    text = "a Dask scheduler, whose workers do it instead, for example tcp://127.0.0.1:8786 (extra `cluster`)"
    parser.add_argument("--scheduler", default="", metavar="ADDRESS", help=text)


OUTPUTS = ("output", "json", "picture", "pictures", "overlay")  # options that name what is written


def check_outputs(options: argparse.Namespace) -> None:
    """Refuse outputs that are or damage an input, twice the same one, or something else than a new or regular file.

    Raises:
        ConfigurationError: with the option.
    """
    given = vars(options)
    inputs = []
    for name, value in given.items():
        if name not in OUTPUTS:
            listed = value if isinstance(value, list) else [value]
            inputs += [Path(each) for each in listed if isinstance(each, Path) or (isinstance(each, str) and each)]
    taken = list[Path]()
    for name in OUTPUTS:
        path = given.get(name)
        if not isinstance(path, Path) or path == STANDARD_OUTPUT:
            continue
        problem = input_problem(path, inputs)
        if not path.is_dir():
            problem = problem or output_problem(path)
        if not problem and path.absolute() in taken:
            problem = "is named by another option too; expected a file of its own"
        if problem:
            what, _, expectation = problem.partition("; expected ")
            raise ConfigurationError(f"--{name}", str(path), f"{expectation}, as it {what}")
        taken.append(path.absolute())


def remap(text: str) -> tuple[str, str]:
    """Return a topic's name and its new one: an argument type."""
    try:
        return parse_remap(text)
    except ConfigurationError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not {error.expectation}") from None


def add_remap(parser: argparse._ActionsContainer) -> None:
    """Add the option --remap, which may come again; its value is a list of pairs, old name and new."""
    text = "another name for a bag's topic; may come again"
    parser.add_argument("--remap", type=remap, action="append", default=[], metavar="FROM:=TO", help=text)


def add_frames(parser: argparse.ArgumentParser) -> None:
    """Add the argument FRAMES, and --remap for those of a bag."""
    parser.add_argument("frames", type=Path, nargs="+", metavar="FRAMES", help="pictures, a folder of them, or a bag")
    add_remap(parser)


def add_source(parser: argparse._ActionsContainer, bag: str = "the bag") -> None:
    """Add --setup, --source, --remap and --frame: how a bag is read.

    Args:
        parser: that gets them.
        bag: which bag names the setup.
    """
    option = parser.add_argument
    option("--setup", default="", metavar="NAME", help=f"a setup's name or YAML file (default: the one {bag} names)")
    option(
        "--source",
        choices=("auto", "camera", "poses"),
        default="auto",
        help="the camera's frames, or the recorded poses (default: the camera where there are frames)",
    )
    add_remap(parser)
    option("--frame", default="dish", metavar="NAME", help="a bag's name of the dish frame")


def bag_selection(options: argparse.Namespace) -> dict[str, Any]:
    """Return how a bag is read, as jobs take it: see `jobs.replay_inputs.BagSelection`."""
    names = (name for name in ("source", "start", "duration", "frame") if hasattr(options, name))
    chosen = {name: getattr(options, name) for name in names}
    return {"setup_name": options.setup, "remap": dict(options.remap), **chosen}
