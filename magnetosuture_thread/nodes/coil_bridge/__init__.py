"""The node `coil_bridge`: filters needle velocity commands and drives the coils."""

from magnetosuture_thread.nodes.coil_bridge.node import main

__all__ = ["main"]
