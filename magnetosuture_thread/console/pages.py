"""Static files of the page, and their security headers."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files

CONTENT_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}

HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


@dataclass(frozen=True)
class PageFile:
    """A static file.

    Attributes:
        content_type: MIME type.
        body: content.
    """

    content_type: str
    body: bytes


def page_files() -> dict[str, PageFile]:
    """Return the files of the page by the path of their URL; `/` is the page itself."""
    result = {}
    for entry in files("magnetosuture_thread.console").joinpath("page").iterdir():
        kind = CONTENT_TYPES.get(entry.name[entry.name.rfind(".") :])
        if kind is not None:
            result[f"/{entry.name}"] = PageFile(kind, entry.read_bytes())
    result["/"] = result.pop("/index.html")
    return result
