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

TOKEN_BYTES = 18


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
    return secrets.token_urlsafe(TOKEN_BYTES)


def same_token(given: object, token: str) -> bool:
    """Return whether a token is correct, by a comparison in constant time."""
    return (
        isinstance(given, str) and bool(token) and hmac.compare_digest(given.encode(errors="replace"), token.encode())
    )


def page_url(address: str, port: int, token: str) -> str:
    """Return the URL of the page; the token is in the fragment, which browsers do not send."""
    host = f"[{address}]" if ":" in address else address
    return f"http://{host}:{port}/#token={quote(token, safe='')}"


def host_refusal(host: str, address: str, port: int) -> str:
    """Return why a request for this host is rejected; empty if it is accepted.

    Names that others can point to this machine are rejected: a loopback server accepts only loopback names, others
    only the bound address, or any numeric address if all are bound.

    Args:
        host: the request's Host header.
        address: that the server is bound to.
        port: that the server is bound to.
    """
    parts = _host_and_port(host)
    if parts is None:
        return f"Host: got {host[:80]!r}, expected a host and a port"
    name, given = parts
    if given != port:
        return f"Host: got port {given}, expected {port}"
    local, numeric = is_loopback(name) and is_loopback(address), is_any(address) and _numeric(name) is not None
    return "" if name == address.lower() or local or numeric else f"Host: got {name[:80]!r}, expected {address}"


def origin_refusal(origin: str, host: str) -> str:
    """Return why a WebSocket of this origin is rejected; empty if it is accepted.

    Args:
        origin: the request's Origin header; empty for programs other than browsers.
        host: the request's Host header, already accepted.
    """
    if not origin or origin.lower() == f"http://{host.lower()}":
        return ""
    return f"Origin: got {origin[:80]!r}, expected http://{host}"


def _host_and_port(host: str) -> tuple[str, int] | None:
    try:
        parts = urlsplit(f"//{host}")
        name, port = parts.hostname, parts.port
    except ValueError:
        return None
    if not name or parts.path or parts.query or parts.fragment or parts.username is not None:
        return None
    return name, 80 if port is None else port
