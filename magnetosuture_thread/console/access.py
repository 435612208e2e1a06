"""Access control of the page: addresses, tokens, and the Host and Origin of requests.

A page of another site in the operator's browser can open a WebSocket to this server (its Origin is then its own),
or have its own name resolve to this machine (its Host is then its own). Both are rejected.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from collections import Counter
from urllib.parse import quote, urlsplit

DEFAULT_PORTS = {"http": 80, "https": 443}  # by scheme


class RateCounter:
    """Counts what comes from each address within a second."""

    def __init__(self) -> None:
        self._second, self._counts = 0, Counter[str]()

    def count(self, address: str, now: float) -> int:
        """Count one at a time of the loop [s]; return how many have come in the same second."""
        if int(now) != self._second:
            self._second, self._counts = int(now), Counter()
        self._counts[address] += 1
        return self._counts[address]


def is_loopback(address: str) -> bool:
    """Return whether only this machine can reach an address."""
    numeric = _numeric(address)
    return numeric is not None and numeric.is_loopback


def is_any(address: str) -> bool:
    """Return whether an address stands for all of this machine."""
    numeric = _numeric(address)
    return numeric is not None and numeric.is_unspecified


def _numeric(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """Return the address that a name stands for without a look-up; None if it is another name."""
    try:
        return ipaddress.ip_address("127.0.0.1" if name == "localhost" else name)
    except ValueError:
        return None


def new_token() -> str:
    """Return a random token that needs no escaping in a URL."""
    return secrets.token_urlsafe(18)


def same_token(given: object, token: str) -> bool:
    """Return whether a token is correct, by a comparison in constant time."""
    return (
        isinstance(given, str) and bool(token) and hmac.compare_digest(given.encode(errors="replace"), token.encode())
    )


def server_origin(address: str, port: int, scheme: str = "http") -> str:
    """Return the origin of a server's pages, as `http://127.0.0.1:8090`."""
    host = f"[{address}]" if ":" in address else address
    return f"{scheme}://{host}:{port}"


def page_url(origin: str, token: str) -> str:
    """Return the URL of the page; the token is in the fragment, which browsers do not send."""
    return f"{origin}/#token={quote(token, safe='')}"


def is_origin(text: str) -> bool:
    """Return whether a text is the origin of a website: scheme, name, and a port if it is not the scheme's own."""
    parts = urlsplit(text)
    return parts.scheme in DEFAULT_PORTS and text == f"{parts.scheme}://{parts.netloc}" and bool(_split(parts.netloc))


def host_refusal(host: str, address: str, port: int, *, scheme: str = "http", origin: str = "") -> str:
    """Return why a request for this host is rejected; empty if it is accepted.

    Names that others can point to this machine are rejected: a loopback server accepts only loopback names, others
    only the bound address, or any numeric address if all are bound; and each the host of the configured origin.

    Args:
        host: the request's Host header.
        address: that the server is bound to.
        port: that the server is bound to.
        scheme: of the server.
        origin: under which the page is reached besides; empty if there is no other.
    """
    if origin and host.lower() == urlsplit(origin).netloc.lower():
        return ""
    parts = _split(host, DEFAULT_PORTS[scheme])
    if parts is None:
        return f"Host: got {host[:80]!r}, expected a host and a port"
    name, given = parts
    if given != port:
        return f"Host: got port {given}, expected {port}"
    local, numeric = is_loopback(name) and is_loopback(address), is_any(address) and _numeric(name) is not None
    return "" if name == address.lower() or local or numeric else f"Host: got {name[:80]!r}, expected {address}"


def origin_refusal(origin: str, host: str, *, scheme: str = "http", allowed: str = "") -> str:
    """Return why a WebSocket of this origin is rejected; empty if it is accepted.

    Args:
        origin: the request's Origin header; empty for programs other than browsers.
        host: the request's Host header, already accepted.
        scheme: of the server.
        allowed: origin under which the page is reached besides; empty if there is no other.
    """
    by_address = f"{scheme}://{host}"
    # By the other name's host a page comes from its origin alone: a plain one could be another's on the way.
    by_name = bool(allowed) and host.lower() == urlsplit(allowed).netloc.lower()
    expected = [allowed] if by_name else [by_address, *([allowed] if allowed else [])]
    if not origin or origin.lower() in (each.lower() for each in expected):
        return ""
    return f"Origin: got {origin[:80]!r}, expected {' or '.join(expected)}"


def _split(host: str, default_port: int = 0) -> tuple[str, int] | None:
    try:
        parts = urlsplit(f"//{host}")
        name, port = parts.hostname, parts.port
    except ValueError:
        return None
    if not name or parts.path or parts.query or parts.fragment or parts.username is not None:
        return None
    return name, default_port if port is None else port
