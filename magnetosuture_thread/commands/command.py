"""What commands share: how one is described, argument types that refuse wrong values, options, and the terminal."""

from __future__ import annotations

import argparse
import inspect
import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeAlias

from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import Progress
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from magnetosuture_thread import ConfigurationError
from magnetosuture_thread.bags import parse_remap
from magnetosuture_thread.settings.errors import printable
from magnetosuture_thread.settings.files import input_problem, output_problem, parse_location, whole_file

DONE, FAILED, WRONG_USE = 0, 1, 2
STANDARD_OUTPUT = Path("-")  # as the file of --json, of benchmarks
EXIT_CODES = "exit codes: 0 done, 1 the job failed, 2 wrong use"

Run: TypeAlias = "Callable[[argparse.Namespace, Terminal], int | None]"  # returns the exit code; None is `DONE`


def describe(parser: argparse.ArgumentParser, text: str) -> None:
    """Set the text under --help."""
    parser.description, parser.epilog = text, EXIT_CODES
    parser.formatter_class = argparse.RawDescriptionHelpFormatter


def runs(parser: argparse.ArgumentParser, run: Run) -> None:
    """Make a parser that of a command, whose docstring is the text under --help."""
    describe(parser, inspect.getdoc(run) or "")
    parser.set_defaults(run=run)


def add_actions(
    parser: argparse.ArgumentParser, title: str, metavar: str, **actions: Run
) -> list[argparse.ArgumentParser]:
    """Add sub-commands to a command, and return their parsers.

    Args:
        parser: of the command.
        title: of the list of sub-commands.
        metavar: what stands for them.
        actions: what each does; an underscore in a name is a hyphen.
    """
    subparsers = parser.add_subparsers(title=title, metavar=metavar, required=True)
    parsers = []
    for name, run in actions.items():
        summary = (inspect.getdoc(run) or "").partition("\n")[0].rstrip(".")
        subparser = subparsers.add_parser(
            name.replace("_", "-"), help=summary[:1].lower() + summary[1:], allow_abbrev=False
        )
        runs(subparser, run)
        parsers.append(subparser)
    return parsers


def _bounded(kind: Callable[[str], Any], what: str, low: float, high: float) -> Callable[[str], Any]:
    def parse(text: str) -> Any:
        with suppress(ValueError):
            if low <= (value := kind(text)) <= high:
                return value
        raise argparse.ArgumentTypeError(f"{text!r} is no {what} from {low:g} to {high:g}")

    return parse


def number_argument(low: float, high: float) -> Callable[[str], float]:
    """Return an argument type: a number within bounds."""
    return _bounded(float, "number", low, high)


def count_argument(things: str, low: int, high: int) -> Callable[[str], int]:
    """Return an argument type: a number of things within bounds."""
    return _bounded(int, f"number of {things}", low, high)


whole_number = _bounded(int, "whole number", 0, 2**31 - 1)  # an argument type


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


def namespace_argument(text: str) -> str:
    """Return a ROS namespace, as `lab1` or `/lab1/left`, or none: an argument type."""
    if text and not re.fullmatch(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", text, re.ASCII):
        raise argparse.ArgumentTypeError(f"{text!r} is no ROS namespace, as lab1 or /lab1/left")
    return text


def _remap(text: str) -> tuple[str, str]:
    try:
        return parse_remap(text)
    except ConfigurationError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not {error.expectation}") from None


def add_remap(parser: argparse._ActionsContainer) -> None:
    """Add the option --remap, which may come again; its value is a list of pairs, old name and new."""
    text = "another name for a bag's topic; may come again"
    parser.add_argument("--remap", type=_remap, action="append", default=[], metavar="FROM:=TO", help=text)


def add_rig(parser: argparse._ActionsContainer) -> None:
    """Add the option --rig: the truth of the simulated rig, where it is not as the setup says."""
    text = "what is simulated: a file with a section for rig_simulator, or random:SEED (default: the setup's)"
    parser.add_argument("--rig", default="", metavar="TRUTH", help=text)


def add_workers(parser: argparse._ActionsContainer, default: int = 1, note: str = "") -> None:
    """Add the options --workers and --scheduler."""
    option = parser.add_argument
    text = f"processes (default: %(default)s){note}"
    option("--workers", type=count_argument("processes", 1, 256), default=default, metavar="N", help=text)
    text = "a Dask scheduler, whose workers do it instead, for example tcp://127.0.0.1:8786 (extra `cluster`)"
    option("--scheduler", default="", metavar="ADDRESS", help=text)


def add_frames(parser: argparse.ArgumentParser) -> None:
    """Add the argument FRAMES, --remap for those of a bag, --rate for those of a video, and the camera's lens."""
    parser.add_argument(
        "frames", type=Path, nargs="+", metavar="FRAMES", help="pictures, a folder of them, a video, or a bag"
    )
    add_remap(parser)
    rate = "frames a second of a video (default: its own) or of a folder (default: 30)"
    parser.add_argument("--rate", type=number_argument(0.01, 1e4), metavar="HZ", help=rate)
    lens = "the lens, as ROS's camera_calibration_parsers writes it (YAML; default: a bag's camera_info)"
    parser.add_argument("--camera-info", type=Path, metavar="FILE", help=lens)


def add_dish(parser: argparse.ArgumentParser) -> None:
    """Add --region and --rim: where a dish is looked for, and by which edge."""
    region = "part of the frame to look at [px] (default: a setup's, or all)"
    box = ("LEFT", "TOP", "RIGHT", "BOTTOM")
    parser.add_argument("--region", type=number_argument(0.0, 1e5), nargs=4, metavar=box, help=region)
    rim = "edge of the dish's wall that its diameter is of (default: a setup's, or the inner one, in doubt)"
    parser.add_argument("--rim", choices=("inner", "outer"), help=rim)


def add_source(parser: argparse._ActionsContainer, bag: str = "the bag") -> None:
    """Add --setup, --source, --remap and --frame: how a bag is read.

    Args:
        parser: that gets them.
        bag: which bag names the setup.
    """
    option = parser.add_argument
    option("--setup", default="", metavar="NAME", help=f"a setup's name or YAML file (default: the one {bag} names)")
    source = "the camera's frames, or the recorded poses (default: the camera where there are frames)"
    option("--source", choices=("auto", "camera", "poses"), default="auto", help=source)
    add_remap(parser)
    option("--frame", default="dish", metavar="NAME", help="a bag's name of the dish frame")


def add_span(parser: argparse._ActionsContainer, bag: str = "the bag") -> None:
    """Add --start and --duration: which part of a bag is read."""
    option = parser.add_argument
    option("--start", type=number_argument(0.0, 1e9), default=0.0, metavar="S", help=f"seconds into {bag} to begin at")
    option("--duration", type=number_argument(1e-3, 1e9), metavar="S", help="seconds (default: to the end)")


def given(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Return the values of some options by name, to pass them on."""
    return {name: getattr(options, name) for name in names}


def bag_selection(options: argparse.Namespace) -> dict[str, Any]:
    """Return how a bag is read: see `evaluation.recorded.BagSelection`."""
    chosen = given(options, *(name for name in ("source", "start", "duration", "frame") if hasattr(options, name)))
    return {"setup_name": options.setup, "remap": dict(options.remap), **chosen}


def check_outputs(options: argparse.Namespace) -> None:
    """Refuse outputs that are or damage an input, twice the same one, or something else than a new or regular file.

    Raises:
        ConfigurationError: with the option.
    """
    outputs = ("output", "json", "picture", "pictures", "overlay")  # options that name what is written
    inputs, taken = list[Path](), list[Path]()
    for name, value in vars(options).items():
        if name not in outputs:
            listed = value if isinstance(value, list) else [value]
            inputs += [Path(each) for each in listed if isinstance(each, Path | str) and each != ""]
    for name in outputs:
        path = getattr(options, name, None)
        if not isinstance(path, Path) or path == STANDARD_OUTPUT:
            continue
        problem = input_problem(path, inputs) or ("" if path.is_dir() else output_problem(path))
        if not problem and path.absolute() in taken:
            problem = "is named by another option too; expected a file of its own"
        if problem:
            what, _, expectation = problem.partition("; expected ")
            raise ConfigurationError(f"--{name}", str(path), f"{expectation}, as it {what}")
        taken.append(path.absolute())


class _PlainConsole(Console):
    """A console on which no name of a file, topic or frame moves the cursor, changes colours or turns text around."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """Render; control characters in texts become escape sequences, those of the console itself stay."""
        for segment in super().render(renderable, options):
            text, style, control = segment
            yield segment if control or text.isprintable() else Segment(printable(text), style)


class Terminal:
    """What a command shows while it runs and when it is done.

    Args:
        errors: whether it writes to standard error, in place of standard output.

    Attributes:
        print: called with a table.
    """

    def __init__(self, *, errors: bool = False) -> None:
        # Numbers and paths have no colours of their own.
        self._console = _PlainConsole(highlight=False, emoji=False, stderr=errors, soft_wrap=errors)
        self.print = self._console.print

    def log(self, text: str) -> None:
        """Print a line for a person as it is, however long."""
        self._console.print(text, soft_wrap=True, markup=False)

    @contextmanager
    def progress(self, name: str) -> Iterator[Callable[[float], None]]:
        """Show a progress bar; the block gets a function that sets its fraction, 0 to 1."""
        with Progress(console=self._console, transient=True) as bar:
            task = bar.add_task(name, total=1.0)
            yield lambda share: bar.update(task, completed=share)


def make_table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[str]], caption: str = "", *, left: int = 1
) -> Table:
    """Return a table to print.

    Args:
        title: above it.
        columns: their names.
        rows: the cells of each, shown as they are.
        caption: below it.
        left: how many columns hold words; the others hold numbers, to the right.
    """
    table = Table(title=title, caption=caption or None, box=SIMPLE_HEAD, padding=(0, 1, 0, 0), title_style="bold")
    for index, name in enumerate(columns):
        if index < left:
            table.add_column(Text(name), overflow="fold", min_width=min(12, 12 - 6 * index))
        else:
            table.add_column(Text(name.replace(" [", "\n[")), justify="right", no_wrap=True)  # the unit below
    for row in rows:
        table.add_row(*map(Text, row))
    return table


def write_json(path: Path | None, figures: Any) -> None:
    """Write figures to the file given by --json, if any."""
    if path:
        with whole_file(path) as partial:
            partial.write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n")
