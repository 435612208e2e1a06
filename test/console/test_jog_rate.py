"""While a jog is held its velocity is repeated at one rate, until the dead man's switch ends it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from magnetosuture_thread.console.jog_controller import JogController


class ManualLoop:
    """A loop whose time goes on to what is scheduled next, one call at a time."""

    def __init__(self) -> None:
        self.now = 0.0
        self.scheduled: list[tuple[float, Callable[..., None], tuple[Any, ...]]] = []

    def time(self) -> float:
        """Return the time [s]."""
        return self.now

    def call_at(self, at: float, call: Callable[..., None], *given: Any) -> None:
        """Schedule a call."""
        self.scheduled.append((at, call, given))

    def run_next(self) -> None:
        """Make the call that is scheduled."""
        ((at, call, given),) = self.scheduled
        self.scheduled.clear()
        self.now = max(self.now, at)
        call(*given)


def test_a_held_jog_is_repeated_at_the_rate_until_nobody_holds_it(monkeypatch: pytest.MonkeyPatch):
    loop = ManualLoop()
    monkeypatch.setattr(asyncio, "get_running_loop", lambda: loop)
    sent: list[tuple[float, Any]] = []
    controller = JogController(lambda velocity: sent.append((loop.now, velocity)), rate=10.0, timeout=0.35)
    assert controller.acquire_control(1) == ""
    sent.clear()
    assert controller.jog(1, (0.001, 0.0))
    while loop.scheduled and len(sent) < 10:
        loop.run_next()
    assert [at for at, _ in sent] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.35])
    assert [velocity for _, velocity in sent] == [(0.001, 0.0)] * 4 + [(0.0, 0.0)]
