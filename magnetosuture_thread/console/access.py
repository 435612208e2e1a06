"""Who may watch and who may command: addresses, tokens, and where a request comes from.

A page of another site that runs in the operator's browser can open a WebSocket to this server (it then names
its own origin), or have its own name resolve to this machine (it then names itself as the host). Both are refused.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from urllib.parse import quote, urlsplit

TOKEN_BYTES = 18


def is_loopback(address: str) -> bool:
    """Return whether only this machine can reach an address."""
    if address == "localhost":
        return True
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return False


def new_token() -> str:
    """Return a random token that needs no escaping in a URL."""
    return secrets.token_urlsafe(TOKEN_BYTES)


def same_token(given: object, token: str) -> bool:
    """Return whether a token was given, in a time that does not tell how much of it is right."""
    return (
        isinstance(given, str) and bool(token) and hmac.compare_digest(given.encode(errors="replace"), token.encode())
    )


def page_url(address: str, port: int, token: str) -> str:
    """Return what a person opens; the token stands in the fragment, which a browser sends to nobody."""
    return f"http://{_bracketed(address)}:{port}/#token={quote(token, safe='')}"


def _bracketed(address: str) -> str:
    return f"[{address}]" if ":" in address else address


def host_refusal(host: str, address: str, port: int) -> str:
    """Say why a request for this host is refused; empty if it is not.

    A name that anybody can let point here is refused: on this machine alone only its own names are good, and
    elsewhere only the address that is bound, or any address in figures where all are.

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
    good = (
        name == address.lower()
        or (is_loopback(name) and is_loopback(address))
        or (is_any(address) and _in_figures(name))
    )
    return "" if good else f"Host: got {name[:80]!r}, expected {address}"


def origin_refusal(origin: str, host: str) -> str:
    """Say why a WebSocket that a page asks for is refused; empty if it is not.

    Args:
        origin: the request's Origin header; empty where there is none, as from a program that is no browser.
        host: the request's Host header, which has been found good.
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


def is_any(address: str) -> bool:
    """Return whether an address stands for all of this machine."""
    return address != "localhost" and _in_figures(address) and ipaddress.ip_address(address).is_unspecified


def _in_figures(name: str) -> bool:
    if name == "localhost":
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
