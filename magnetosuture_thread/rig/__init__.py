"""Rig: the simulated camera."""
