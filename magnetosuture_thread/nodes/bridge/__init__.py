"""The node `coil_bridge` and its client."""
