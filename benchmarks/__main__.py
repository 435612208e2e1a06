"""Run a benchmark: python -m benchmarks NAME [OPTIONS]."""

from __future__ import annotations

import argparse
import inspect
import json
import sys
from collections.abc import Sequence
from importlib import import_module

from magnetosuture_thread.cli import exit_code
from magnetosuture_thread.commands import command

# Each is a file with `add_options(parser)` and `run(options, terminal)`, which returns figures and whether they passed.
BENCHMARKS = (
    *("solver", "contact", "forecast", "estimator", "vision", "bridge", "keep-out", "lies", "network", "page"),
    *("attack", "frame", "golden"),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark that is named; 1 if it failed or did not pass, 2 for wrong use."""
    return exit_code(lambda: _run(_parse(arguments)))


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__, epilog=command.EXIT_CODES)
    names = parser.add_subparsers(title="benchmarks", metavar="NAME", required=True)
    for name in BENCHMARKS:
        module = import_module(f"benchmarks.{name.replace('-', '_')}")
        description = inspect.getdoc(module) or ""
        subparser = names.add_parser(name, help=description.splitlines()[0])
        command.describe(subparser, description)
        module.add_options(subparser)
        help_json = "write the figures to a file (-: to standard output)"
        subparser.add_argument("--json", type=command.output_file, metavar="FILE", help=help_json)
        subparser.set_defaults(run=module.run)
    return parser.parse_args(arguments)


def _run(options: argparse.Namespace) -> int:
    """Run a benchmark and write its figures; tables go to standard error where the JSON goes to standard output."""
    command.check_outputs(options)
    to_standard_output = options.json == command.STANDARD_OUTPUT
    figures, passed = options.run(options, command.Terminal(errors=to_standard_output))
    if to_standard_output:
        sys.stdout.write(json.dumps(figures, indent=2, allow_nan=False) + "\n")
    else:
        command.write_json(options.json, figures)
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
