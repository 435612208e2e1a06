"""The command that keeps an index of many bags: catalog."""

from __future__ import annotations

import argparse
from contextlib import suppress
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from magnetosuture_thread.cli.arguments import (
    DONE,
    FAILED,
    Subparsers,
    add_scheduler,
    bag_location,
    command,
    count_argument,
    output_file,
)
from magnetosuture_thread.cli.terminal import make_console, make_log, progress


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = command(subparsers, "catalog", run_catalog)
    option = parser.add_argument
    option("root", type=bag_location, metavar="ROOT", help="folder with the bags, in itself or below, or its URL")
    file = "the table of bags (default: %(default)s)"
    option("--output", type=output_file, default=Path("catalog.parquet"), metavar="FILE", help=file)
    workers = count_argument("processes", 1, 256)
    option("--workers", type=workers, default=1, metavar="N", help="processes (default: 1)")
    add_scheduler(parser)
    instead = parser.add_mutually_exclusive_group().add_argument
    instead("--query", default="", metavar="SQL", help="ask the catalog as it is, in the SQL of DuckDB")
    port = count_argument("a port", 1, 65535)
    instead("--page", type=port, metavar="PORT", help="show the catalog as it is on http://127.0.0.1:PORT")


def run_catalog(options: argparse.Namespace) -> int:
    """Keep an index of all bags below a folder or URL.

    Every bag is evaluated as by `evaluate`, without a page, and its figures go into FILE: a Parquet file with a row
    for each bag, the table `bags`, and one named .seconds.parquet beside it with a row for each second, the table
    `seconds`. Called again it reads only bags that are new or have changed, and drops those that are gone. Ended at
    any moment, it goes on from there the next time. A bag that cannot be evaluated has its row too, with the problem
    in it; the exit code is 1 then.

      magnetosuture catalog ROOT --query "SELECT setup, avg(error_truth_mean_percent) FROM bags GROUP BY setup"

    With --page a page on this machine lists, filters and plots the bags, and makes and opens the report of each, until
    Ctrl-C.
    """
    console = make_console()
    log = make_log(console)
    if options.query:
        from magnetosuture_thread.catalog.query import query_catalog

        columns, rows = query_catalog(options.output, options.query)
        table = Table(*columns)
        for row in rows:
            table.add_row(*(Text(_shown(value)) for value in row))
        console.print(table)
        return DONE
    if options.page:
        from magnetosuture_thread.jobs.catalog_page import ADDRESS, make_page_server

        with make_page_server(options.output, options.page, log) as server, suppress(KeyboardInterrupt):
            log(f"the page: http://{ADDRESS}:{options.page}")
            server.serve_forever()
        return DONE
    from magnetosuture_thread.jobs.catalog import update_catalog

    with progress(console, "catalog") as advance:
        found = update_catalog(
            options.root,
            options.output,
            workers=options.workers,
            scheduler=options.scheduler,
            log=log,
            progress=advance,
        )
    log(f"{found.added} bags added, {found.unchanged} unchanged, {found.gone} gone: {options.output}")
    return FAILED if found.failed else DONE


def _shown(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
