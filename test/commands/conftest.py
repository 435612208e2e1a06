"""What several jobs are tested with."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from functools import cache
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from test.nodes.programs import Programs


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


@pytest.fixture(scope="session", autouse=True)
def forked_nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Fork the nodes of graphs from one process that has imported all of them, which takes each node seconds."""
    from magnetosuture_thread.nodes.processes import NodeProcesses
    from test.nodes.programs import Programs, start_forked

    @cache
    def programs() -> Programs:
        return Programs(tmp_path_factory.mktemp("programs"))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(NodeProcesses, "start", start_forked(programs))
        yield
