"""Guidance: velocity commands that move the needle along a path."""
