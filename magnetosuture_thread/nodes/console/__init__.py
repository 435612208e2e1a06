"""The node `console`: serves the operator page for a running graph."""

from magnetosuture_thread.nodes.console.node import main

__all__ = ["main"]
