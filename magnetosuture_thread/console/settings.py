"""Settings of the operator page, and access to it: addresses, tokens, and the Host and Origin of requests.

A page of another site in the operator's browser can open a WebSocket to this server (its Origin is then its own),
or have its own name resolve to this machine (its Host is then its own). Both are rejected.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from collections import Counter
from dataclasses import dataclass
from typing import ClassVar
from urllib.parse import quote, urlsplit

from magnetosuture_thread.settings import shared_parameters as shared
from magnetosuture_thread.settings.configuration import quantity
from magnetosuture_thread.settings.errors import ConfigurationError

DEFAULT_PORTS = {"http": 80, "https": 443}  # by scheme


@dataclass(frozen=True)
class ConsoleSettings(shared.SceneName, shared.NeedleArc):
    """Address, token and jog limits of the operator page."""

    GROUP: ClassVar[str] = "console"

    address: str = quantity("127.0.0.1", "network address of the server; any but loopback requires a token")
    port: int = quantity(8090, "of that address; 0 selects a free one", minimum=0, maximum=65535)
    token: str = quantity("", "permits commands; empty generates a random one at every start")
    certificate: str = quantity(
        "", "PEM file of the certificate chain by which the page is served over TLS; none if empty"
    )
    private_key: str = quantity("", "PEM file of the certificate's key; empty if the key is in the certificate's file")
    origin: str = quantity(
        "", "under which browsers reach the page besides its address: a name, or a TLS proxy, as https://rig.example"
    )
    image_transport: str = quantity("compressed", "camera topic to show", choices=("compressed", "raw"))
    frame_rate: float = quantity(30.0, "of the states sent to the page", unit="Hz", minimum=1.0, maximum=120.0)
    speed: float = quantity(0.003, "initial jog speed of the needle's tip", unit="m/s", minimum=1e-5, maximum=0.5)
    max_speed: float = quantity(0.01, "maximum jog speed", unit="m/s", minimum=1e-5, maximum=0.5)
    rate: float = quantity(50.0, "of the commands during a jog", unit="Hz", minimum=10.0, maximum=200.0)
    hold_timeout: float = quantity(
        0.15, "the needle stops after this long without a jog message", unit="s", minimum=0.06, maximum=1.0
    )

    def check(self) -> None:
        """Reject what does not fit.

        A public page without a token, a key without a certificate, an origin that is not valid, a speed above the
        maximum, and a short timeout.
        """
        is_token = len(self.token) >= 16 and self.token.isascii() and self.token.isprintable() and " " not in self.token
        exposed = f"a token, as {self.address} can be reached from other machines"
        origin = "scheme and name, and a port if it is another than the scheme's, as https://rig.example"
        least = 2.0 / self.hold_timeout
        for is_wrong, name, expectation in (
            (not self.address, "address", "an address, 0.0.0.0 for all of this machine"),
            (not is_loopback(self.address) and not self.token, "token", exposed),
            (self.token and not is_token, "token", "at least 16 printable ASCII characters without a space, or none"),
            (self.private_key and not self.certificate, "private_key", "none without a certificate"),
            (self.origin and not is_origin(self.origin), "origin", origin),
            (self.speed > self.max_speed, "speed", f"at most max_speed, {self.max_speed:g} m/s"),
            (self.rate < least, "rate", f"at least {least:g} Hz, 2 commands in a hold_timeout"),
        ):
            if is_wrong:
                value = "…" if name == "token" and self.token else getattr(self, name)  # no token is shown
                raise ConfigurationError(f"{self.GROUP}.{name}", value, expectation)

    @property
    def scheme(self) -> str:
        """Return the scheme of the server: https where it has a certificate."""
        return "https" if self.certificate else "http"

    def page_url(self, port: int) -> str:
        """Return the URL of the page on a port; the token is in the fragment, which browsers do not send."""
        numeric = _numeric(self.address)
        address = "127.0.0.1" if numeric is not None and numeric.is_unspecified else self.address
        host = f"[{address}]" if ":" in address else address
        return f"{self.origin or f'{self.scheme}://{host}:{port}'}/#token={quote(self.token, safe='')}"

    def is_own_host(self, host: str) -> bool:
        """Return whether a Host header is that of the origin under which the page is reached besides."""
        return bool(self.origin) and host.lower() == urlsplit(self.origin).netloc.lower()

    def host_refusal(self, host: str, port: int) -> str:
        """Return why a request for a host is rejected; empty if it is accepted.

        Names that others can point to this machine are rejected: a loopback server accepts only loopback names, others
        only the bound address, or any numeric address if all are bound; and each the host of the configured origin.

        Args:
            host: the request's Host header.
            port: that the server is bound to.
        """
        if self.is_own_host(host):
            return ""
        parts = _split(host, DEFAULT_PORTS[self.scheme])
        if parts is None:
            return f"Host: got {host[:80]!r}, expected a host and a port"
        name, request_port = parts
        if request_port != port:
            return f"Host: got port {request_port}, expected {port}"
        bound, numeric = _numeric(self.address), _numeric(name)
        is_local = is_loopback(name) and is_loopback(self.address)
        is_any = bound is not None and bound.is_unspecified and numeric is not None
        is_ours = name == self.address.lower() or is_local or is_any
        return "" if is_ours else f"Host: got {name[:80]!r}, expected {self.address}"

    def origin_refusal(self, origin: str, host: str) -> str:
        """Return why a WebSocket of an origin is rejected; empty if it is accepted.

        Args:
            origin: the request's Origin header; empty for programs other than browsers.
            host: the request's Host header, already accepted.
        """
        # By the other name's host a page comes from its origin alone: a plain one could be another's on the way.
        expected = [] if self.is_own_host(host) else [f"{self.scheme}://{host}"]
        expected += [self.origin] if self.origin else []
        if not origin or origin.lower() in map(str.lower, expected):
            return ""
        return f"Origin: got {origin[:80]!r}, expected {' or '.join(expected)}"


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


def _numeric(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """Return the address that a name stands for without a look-up; None if it is another name."""
    try:
        return ipaddress.ip_address("127.0.0.1" if name == "localhost" else name)
    except ValueError:
        return None


def new_token() -> str:
    """Return a random token that needs no escaping in a URL."""
    return secrets.token_urlsafe(18)


def same_token(candidate: object, token: str) -> bool:
    """Return whether a token is correct, by a comparison in constant time."""
    if not isinstance(candidate, str) or not token:
        return False
    return hmac.compare_digest(candidate.encode(errors="replace"), token.encode())


def is_origin(text: str) -> bool:
    """Return whether a text is the origin of a website: scheme, name, and a port if it is not the scheme's own."""
    parts = urlsplit(text)
    return parts.scheme in DEFAULT_PORTS and text == f"{parts.scheme}://{parts.netloc}" and bool(_split(parts.netloc))


def _split(host: str, default_port: int = 0) -> tuple[str, int] | None:
    try:
        parts = urlsplit(f"//{host}")
        name, port = parts.hostname, parts.port
    except ValueError:
        return None
    if not name or parts.path or parts.query or parts.fragment or parts.username is not None:
        return None
    return name, default_port if port is None else port
