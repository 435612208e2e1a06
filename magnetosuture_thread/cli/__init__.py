"""The command `magnetosuture`."""

from magnetosuture_thread.cli.main import main

__all__ = ["main"]
