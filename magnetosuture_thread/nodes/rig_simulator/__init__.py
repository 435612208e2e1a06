"""The node `rig_simulator`: the simulated rig in the place of camera, power stage and needle."""

from magnetosuture_thread.nodes.rig_simulator.node import main

__all__ = ["main"]
