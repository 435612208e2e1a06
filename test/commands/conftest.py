"""What several jobs are tested with."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from test.nodes.programs import Programs


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
