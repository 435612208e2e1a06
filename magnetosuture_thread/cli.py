"""The command `magnetosuture`."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from magnetosuture_thread.errors import ConfigurationError, MagnetosutureError

DONE, FAILED, WRONG_USE = 0, 1, 2

DESCRIPTION = """\
Predicts where a suture thread goes behind a magnetically steered needle.

Research software, no medical device. Lengths are in metres and times in seconds throughout.
"""

RECORD = """\
Render a reference trajectory as the overhead camera would see it, and write a bag: JPEG frames,
camera_info, the needle velocity commands that the trajectory amounts to, and the truth. Everything in
the bag is simulated; its notes say so, and `replay` repeats it.
"""

REPLAY = """\
Play an mcap bag through the live graph: vision_tracker, thread_model and coil_bridge run as processes
of their own, on a ROS domain that nobody else uses, with simulated time on /clock and no hardware.

DIR, which must not exist, gets
  bag/           all outputs of the graph, an mcap bag
  summary.json   the figures of the table
  summary.png    a frame with the predicted thread over the seen one; error and margins over time
  logs/          what each node printed
"""

EXIT_CODES = "exit codes: 0 done, 1 the job failed, 2 wrong use"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    options = _parser().parse_args(arguments)
    run: Callable[[argparse.Namespace], int] = options.run
    try:
        with _interrupted_by(signal.SIGTERM, signal.SIGHUP):
            return run(options)
    except ConfigurationError as error:
        return _fail(str(error), WRONG_USE)
    except MagnetosutureError as error:
        return _fail(str(error), FAILED)
    except ModuleNotFoundError as error:
        return _fail(f"{error}; the live graph needs ROS 2 Jazzy: see README, or pip install '.[ros]'", FAILED)
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


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="magnetosuture",
        description=DESCRIPTION,
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    replay = _command(commands, "replay", "play a recorded bag through the live graph", REPLAY, _replay)
    replay.add_argument("bag", type=Path, metavar="BAG", help="an mcap file, or the folder of a bag")
    replay.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder to make")
    replay.add_argument(
        "--setup", default="", metavar="NAME", help="a set-up's name or YAML file (default: the one the bag names)"
    )
    replay.add_argument(
        "--rate", type=_number(0.05, 20.0), default=1.0, help="how much faster than recorded (default: 1)"
    )
    record = _command(commands, "record", "write a bag of simulated camera frames", RECORD, _record)
    record.add_argument("reference", type=Path, metavar="REFERENCE", help="a reference trajectory (.npz)")
    record.add_argument("--output", type=Path, required=True, metavar="BAG", help="folder of the bag to make")
    record.add_argument("--setup", required=True, metavar="NAME", help="a set-up's name or YAML file")
    record.add_argument("--start", type=_number(0.0, 1e6), default=0.0, help="time in the trajectory to begin at [s]")
    record.add_argument("--duration", type=_number(1e-3, 1e6), help="[s] (default: to the trajectory's end)")
    record.add_argument("--rate", type=_number(1.0, 240.0), default=30.0, help="frames a second (default: 30)")
    record.add_argument(
        "--quality",
        type=int,
        choices=range(1, 101),
        default=85,
        metavar="1..100",
        help="of the JPEG frames (default: 85)",
    )
    record.add_argument("--seed", type=_whole_number, default=0, help="of dust and sensor noise (default: 0)")
    return parser


def _command(
    commands: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    summary: str,
    description: str,
    run: Callable[[argparse.Namespace], int],
) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        name,
        help=summary,
        description=description,
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


def _number(low: float, high: float) -> Callable[[str], float]:
    """Return an argument type: a number within bounds."""

    def number(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is no number from {low:g} to {high:g}")
        return value

    return number


def _whole_number(text: str) -> int:
    """Return a whole number of at least 0: an argument type."""
    if not (text.isascii() and text.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number of at least 0")
    return int(text)


def _replay(options: argparse.Namespace) -> int:
    from magnetosuture_thread.jobs.replay import replay
    from magnetosuture_thread.study.table import summary_table

    console = Console(highlight=False)
    with _progress(console) as progress:
        task = progress.add_task("replay", total=1.0)
        summary = replay(
            options.bag,
            options.output,
            setup_name=options.setup,
            rate=options.rate,
            say=lambda text: console.print(text, soft_wrap=True, markup=False),
            progress=lambda share: progress.update(task, completed=share),
        )
    console.print(summary_table(summary))
    console.print(f"results: {options.output}", soft_wrap=True, markup=False)
    return DONE


def _record(options: argparse.Namespace) -> int:
    from magnetosuture_thread.jobs.record import record
    from magnetosuture_thread.setups import read_setup
    from magnetosuture_thread.study.reference import read_reference

    console = Console(highlight=False)
    setup = read_setup(options.setup)
    reference = read_reference(options.reference)
    with _progress(console) as progress:
        task = progress.add_task("record", total=1.0)
        frames = record(
            reference,
            setup,
            options.output,
            start=options.start,
            duration=options.duration,
            rate=options.rate,
            quality=options.quality,
            seed=options.seed,
            progress=lambda share: progress.update(task, completed=share),
        )
    console.print(f"{frames} simulated frames in {options.output}", soft_wrap=True, markup=False)
    return DONE


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
    )


if __name__ == "__main__":
    sys.exit(main())
