"""Bags: the only subpackage that imports mcap and rosbags."""
