"""Where a bridge keeps its emergency stop over a restart."""

from __future__ import annotations

import os
from pathlib import Path

from rclpy.node import Node

from magnetosuture_thread.coils.latch import StopRecord

PARAMETER = "stop_file"


def stop_record(node: Node) -> StopRecord:
    """Return the record of a bridge: by its parameter, or else by the names of node and graph, one for each robot."""
    given = str(node.get_parameter_or(PARAMETER).value or "")
    if given:
        return StopRecord(Path(os.path.expanduser(given)))
    home = os.environ.get("XDG_STATE_HOME", "")
    state = Path(home if os.path.isabs(home) else os.path.expanduser("~/.local/state"))
    name = node.get_fully_qualified_name().strip("/").replace("/", ".")
    return StopRecord(state / "magnetosuture" / f"{name}.domain_{node.context.get_domain_id()}.stop")
