"""Settings of the operator's page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from magnetosuture_thread.configuration import Configuration, quantity
from magnetosuture_thread.console.access import is_loopback
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.needle_arc import check_needle
from magnetosuture_thread.shared_parameters import shared_parameter

FEWEST = 2.0  # commands within a hold timeout
LEAST_TOKEN = 16  # characters of a token where others can reach the page


@dataclass(frozen=True)
class ConsoleSettings(Configuration):
    """Where the page is served, and how the needle is steered from it."""

    GROUP: ClassVar[str] = "console"

    address: str = quantity(
        "127.0.0.1", "network address that the page is served on; any but this machine's own asks for a token"
    )
    port: int = quantity(8090, "of that address; 0 takes a free one", minimum=0, maximum=65535)
    token: str = quantity("", "what lets somebody command; empty makes a random one at every start")
    image_transport: str = quantity(
        "compressed", "which of the camera's topics is shown", choices=("compressed", "raw")
    )
    scene: str = shared_parameter("scene")
    needle_length: float = shared_parameter("needle_length")
    needle_curvature: float = shared_parameter("needle_curvature")
    frame_rate: float = quantity(30.0, "of what the page is told", unit="Hz", minimum=1.0, maximum=120.0)
    speed: float = quantity(
        0.003, "of the needle's tip at first, until the operator sets another", unit="m/s", minimum=1e-5, maximum=0.5
    )
    max_speed: float = quantity(
        0.01, "greatest speed that the operator may ask for", unit="m/s", minimum=1e-5, maximum=0.5
    )
    rate: float = quantity(50.0, "of the commands while the operator steers", unit="Hz", minimum=10.0, maximum=200.0)
    hold_timeout: float = quantity(
        0.15,
        "nothing heard from the steering page for this long: the needle is told to rest",
        unit="s",
        minimum=0.06,
        maximum=1.0,
    )

    def check(self) -> None:
        """Refuse an open page, a speed beyond the greatest, a timeout between two commands, a coiled needle."""
        check_needle(self.GROUP, self.needle_length, self.needle_curvature)
        if not self.address:
            raise ConfigurationError(
                f"{self.GROUP}.address", self.address, "an address, 0.0.0.0 for all of this machine"
            )
        if not is_loopback(self.address) and not self.token:
            raise ConfigurationError(
                f"{self.GROUP}.token", self.token, f"a token, as {self.address} can be reached from other machines"
            )
        plain = self.token.isascii() and self.token.isprintable() and " " not in self.token
        if self.token and not (plain and len(self.token) >= LEAST_TOKEN):
            raise ConfigurationError(
                f"{self.GROUP}.token",
                "…",
                f"at least {LEAST_TOKEN} printable ASCII characters without a space, or none",
            )
        if self.speed > self.max_speed:
            raise ConfigurationError(f"{self.GROUP}.speed", self.speed, f"at most max_speed, {self.max_speed:g} m/s")
        if self.rate * self.hold_timeout < FEWEST:
            raise ConfigurationError(
                f"{self.GROUP}.rate",
                self.rate,
                f"at least {FEWEST / self.hold_timeout:g} Hz, {FEWEST:g} commands in a hold_timeout",
            )
