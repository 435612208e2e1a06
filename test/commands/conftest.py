"""What several jobs are tested with."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest


class Interrupting:
    """A person who presses Ctrl-C as soon as a job tells how far it is.

    Attributes:
        went_on: what the job told each time that it went on after that.
    """

    def __init__(self) -> None:
        self.went_on: list[float] = []

    def __call__(self, share: float) -> None:
        """Press it."""
        signal.raise_signal(signal.SIGINT)
        self.went_on.append(share)


@pytest.fixture
def interrupting() -> Iterator[Interrupting]:
    """Have Ctrl-C heeded as in a terminal: in a shell's background it is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield Interrupting()
    signal.signal(signal.SIGINT, before)
