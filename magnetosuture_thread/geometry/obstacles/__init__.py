"""Obstacles: shapes, their signed distance, and contacts of points with them."""

from __future__ import annotations

from magnetosuture_thread.geometry.obstacles.contacts import (
    MAX_FRICTION,
    WALL,
    Workspace,
    find_contacts,
    half_segment_distances,
    wall_contact,
)
from magnetosuture_thread.geometry.obstacles.distances import Contacts, WorkspaceData
from magnetosuture_thread.geometry.obstacles.shapes import Disc, Obstacle, Polygon, triangulate

__all__ = [
    "MAX_FRICTION",
    "WALL",
    "Contacts",
    "Disc",
    "Obstacle",
    "Polygon",
    "Workspace",
    "WorkspaceData",
    "find_contacts",
    "half_segment_distances",
    "triangulate",
    "wall_contact",
]
