"""Plays a recorded bag into the running graph."""
