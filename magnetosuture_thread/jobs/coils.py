"""The job `magnetosuture coils`: press a switch of the running coil bridge, or ask for its state."""

from __future__ import annotations

from typing import Any

ACTIONS = ("state", "arm", "disarm", "stop", "reset", "configure", "activate", "deactivate", "cleanup")


def coils(action: str) -> dict[str, Any]:
    """Do something and return the state afterwards, for a person.

    Args:
        action: one of `ACTIONS`.

    Raises:
        GraphError: no bridge is there, or it refuses.
    """
    # Only here, where it is needed: without ROS the other commands still work.
    from magnetosuture_thread.nodes.coil_client import CoilClient

    with CoilClient() as client:
        if action != "state":
            client.execute(action)
        return client.state()
