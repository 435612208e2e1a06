"""Ctrl-C that waits for a good moment."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from typing import Any

import pytest

from magnetosuture_thread.nodes.processes import Interruption


@pytest.fixture
def heeded() -> Iterator[dict[signal.Signals, Any]]:
    """Signals as a command in a terminal has them: SIGINT and SIGTERM interrupt, SIGHUP is ignored."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    given: dict[signal.Signals, Any] = {
        signal.SIGINT: interrupt,
        signal.SIGTERM: interrupt,
        signal.SIGHUP: signal.SIG_IGN,
    }
    before = {which: signal.signal(which, handler) for which, handler in given.items()}
    yield given
    for which, handler in before.items():
        signal.signal(which, handler)


def kept(which: signal.Signals, done: list[str], *, asks: bool = False, error: Exception | None = None) -> None:
    """Get a signal, and go on."""
    with Interruption() as interruption:
        interruption.check()
        os.kill(os.getpid(), which)
        done.append("went on")
        if error is not None:
            raise error
        if asks:
            interruption.check()
            done.append("went on again")


@pytest.mark.parametrize("which", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_kept_until_it_is_asked_for_or_the_end(heeded, which: signal.Signals):
    for asks in (True, False):
        done: list[str] = []
        with pytest.raises(KeyboardInterrupt):
            kept(which, done, asks=asks)
        assert done == ["went on"]
    with pytest.raises(ValueError, match="mine"):  # what is raised already stays
        kept(which, [], error=ValueError("mine"))
    assert {number: signal.getsignal(number) for number in heeded} == heeded
