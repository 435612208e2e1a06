"""Settings of the operator page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from magnetosuture_thread.console.access import is_loopback, is_origin
from magnetosuture_thread.settings import shared_parameters as shared
from magnetosuture_thread.settings.configuration import quantity
from magnetosuture_thread.settings.errors import ConfigurationError


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

        A public page without a token, a key without a certificate, an origin that is none, a speed above the maximum,
        and a short timeout.
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
