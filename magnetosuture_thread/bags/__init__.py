"""Bags: the only room that knows mcap and rosbags."""
