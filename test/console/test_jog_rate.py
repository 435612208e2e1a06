"""While a jog is held its velocity is repeated at one rate, until the dead man's switch ends it."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest

from magnetosuture_thread.console.jog_controller import JogController


def test_a_held_jog_is_repeated_at_the_rate_until_nobody_holds_it(monkeypatch: pytest.MonkeyPatch):
    """By a loop whose time goes on to what is scheduled next, one call at a time."""
    now, scheduled, sent = 0.0, list[Any](), list[tuple[float, Any]]()
    loop = SimpleNamespace(time=lambda: now, call_at=lambda *call: scheduled.append(call))
    monkeypatch.setattr(asyncio, "get_running_loop", lambda: loop)
    controller = JogController(lambda velocity: sent.append((now, velocity)), rate=10.0, timeout=0.35)
    assert controller.acquire_control(1) == ""
    sent.clear()
    assert controller.jog(1, (0.001, 0.0))
    while scheduled and len(sent) < 10:
        ((at, call, *given),) = scheduled
        scheduled.clear()
        now = max(now, at)
        call(*given)
    assert [at for at, _ in sent] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.35])
    assert [velocity for _, velocity in sent] == [(0.001, 0.0)] * 4 + [(0.0, 0.0)]
