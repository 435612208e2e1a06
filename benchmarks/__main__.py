"""Run a benchmark: python -m benchmarks NAME [OPTIONS]."""

from __future__ import annotations

import argparse
import inspect
import json
import sys
from collections.abc import Callable, Sequence
from typing import Any

from rich.console import Console

from benchmarks import attack, contact, forecast, frame, golden, keep_out, lies, page, solver
from benchmarks.bridge import command as bridge
from benchmarks.estimator import command as estimator
from benchmarks.network import command as network
from benchmarks.vision import command as vision
from magnetosuture_thread.cli import exit_code
from magnetosuture_thread.commands.command import (
    EXIT_CODES,
    STANDARD_OUTPUT,
    check_outputs,
    make_console,
    output_file,
    write_json,
)

# Each has `add_options(parser)` and `run(options, console)`, which returns the figures and whether they passed.
BENCHMARKS: dict[str, Any] = {
    **{"solver": solver, "bridge": bridge, "page": page, "keep-out": keep_out, "contact": contact, "lies": lies},
    **{"golden": golden, "frame": frame},
    **{"attack": attack, "vision": vision, "estimator": estimator, "forecast": forecast, "network": network},
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark that is named; 1 if it failed or did not pass, 2 for wrong use."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__, epilog=EXIT_CODES)
    names = parser.add_subparsers(title="benchmarks", metavar="NAME", required=True)
    for name, module in BENCHMARKS.items():
        description = inspect.getdoc(module) or ""
        own = names.add_parser(
            name,
            help=description.splitlines()[0],
            description=description,
            epilog=EXIT_CODES,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.add_options(own)
        own.add_argument(
            "--json", type=output_file, metavar="FILE", help="write the figures to a file (-: to standard output)"
        )
        own.set_defaults(run=module.run)
    options = parser.parse_args(arguments)
    return exit_code(lambda: _run(options.run, options))


def _run(run: Callable[[argparse.Namespace, Console], tuple[dict[str, Any], bool]], options: argparse.Namespace) -> int:
    """Run a benchmark and write its figures; tables go to standard error where the JSON goes to standard output."""
    check_outputs(options)
    to_standard_output = options.json == STANDARD_OUTPUT
    figures, passed = run(options, make_console(errors=to_standard_output))
    if to_standard_output:
        sys.stdout.write(json.dumps(figures, indent=2, allow_nan=False) + "\n")
    else:
        write_json(options.json, figures)
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
