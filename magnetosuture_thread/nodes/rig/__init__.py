"""The node `rig_simulator`."""
