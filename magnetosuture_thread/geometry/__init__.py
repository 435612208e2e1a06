"""Geometry: polylines, obstacles, the camera's view. It builds on no other subpackage."""
