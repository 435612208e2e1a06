"""The page of a catalog, served to a browser on this machine: it lists, filters and plots bags, and opens a report."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from magnetosuture_thread import MagnetosutureError
from magnetosuture_thread.catalog.query import query_catalog
from magnetosuture_thread.catalog.series import COLUMNS, COUNTS
from magnetosuture_thread.evaluation.report.template import page_style, read_source, read_template
from magnetosuture_thread.files import parse_location
from magnetosuture_thread.jobs.evaluate import name_of
from magnetosuture_thread.jobs.evaluate_bag import evaluate_bag
from magnetosuture_thread.texts import one_line

ADDRESS = "127.0.0.1"
PACKAGE = "magnetosuture_thread.catalog"
POLICY = "default-src 'none'; script-src 'self'; style-src 'unsafe-inline'; connect-src 'self'; base-uri 'none'"
BAGS = "SELECT * FROM bags ORDER BY path"
SECONDS = "SELECT * EXCLUDE (path) FROM seconds WHERE path = ? ORDER BY second"

Log = Callable[[str], None]


def make_page_server(file: Path, port: int, log: Log = lambda text: None) -> ThreadingHTTPServer:
    """Return a server of the page, on this machine only; `serve_forever` runs it.

    Args:
        file: of the catalog's table of bags, as it is now.
        port: to listen on; 0 for a free one.
        log: called with a line for a person.

    Raises:
        BagError: there is no catalog.
        OSError: the port is taken.
    """
    columns, rows = query_catalog(file, BAGS)
    page = read_template(PACKAGE, "page.html", {}).render(style=page_style(), file=str(file))
    texts = {
        "/": ("text/html", page),
        "/page.js": ("text/javascript", read_source(PACKAGE, "page.js")),
        "/bags.json": ("application/json", _table(columns, rows)),
        "/series.json": ("application/json", json.dumps([*COLUMNS, *COUNTS])),
    }
    paths = [str(row[columns.index("path")]) for row in rows]
    one_at_a_time = threading.Lock()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            """Answer a request."""
            hosts = {f"{name}:{server.server_port}" for name in (ADDRESS, "localhost")}
            if self.headers.get("Host") not in hosts:  # a page of another site, whose name leads to this machine
                self._answer(403, "text/plain", "for a browser on this machine only")
            elif self.path in texts:
                self._answer(200, *texts[self.path], policy=POLICY)
            elif (path := self._bag("/report/")) is not None:
                with one_at_a_time:
                    self._answer(*_report(path, log))
            elif (path := self._bag("/seconds/", ".json")) is not None:
                self._answer(200, "application/json", _table(*query_catalog(file, SECONDS, [path])))
            else:
                self._answer(404, "text/plain", "no such page")

        def _bag(self, before: str, after: str = "") -> str | None:
            """Return the path of the bag whose number is in the request's path, if one is."""
            number = self.path[len(before) : len(self.path) - len(after)]
            is_number = self.path == before + number + after and number.isascii() and number.isdigit()
            return paths[int(number)] if is_number and len(number) < 10 and int(number) < len(paths) else None

        def _answer(self, code: int, kind: str, text: str, policy: str = "") -> None:
            body = text.encode()
            self.send_response(code)
            self.send_header("Content-Type", f"{kind}; charset=utf-8")
            self.send_header("Content-Length", str(len(body)))
            self.send_header("X-Content-Type-Options", "nosniff")
            if policy:
                self.send_header("Content-Security-Policy", policy)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            """Log no requests."""

    server = ThreadingHTTPServer((ADDRESS, port), Handler)
    return server


def _table(columns: list[str], rows: list[tuple[Any, ...]]) -> str:
    return json.dumps({"columns": columns, "rows": rows}, allow_nan=False)


def _report(path: str, log: Log) -> tuple[int, str, str]:
    """Return code, type and text of the answer with the report of a bag, or with why there is none."""
    log(f"report of {path}")
    try:
        place = parse_location(path)
        return 200, "text/html", evaluate_bag(place, name_of(place), "auto", "", {}, log, lambda share: None)[1]
    except MagnetosutureError as error:
        return 500, "text/plain", one_line(str(error))
