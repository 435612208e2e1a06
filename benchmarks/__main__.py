"""Run a benchmark: python -m benchmarks NAME [OPTIONS]."""

from __future__ import annotations

import argparse
import sys

from benchmarks import keep_out

BENCHMARKS = {"keep-out": keep_out}


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark that is named; 1 if it did not pass."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    names = parser.add_subparsers(dest="name", required=True)
    for name, module in BENCHMARKS.items():
        module.add_options(names.add_parser(name, help=(module.__doc__ or "").splitlines()[0]))
    options = parser.parse_args(arguments)
    return BENCHMARKS[options.name].run(options)


if __name__ == "__main__":
    sys.exit(main())
