"""Guidance: which velocity takes the needle along a path."""
