"""Geometry: polylines, obstacles, the camera's view. No other room is needed here."""
