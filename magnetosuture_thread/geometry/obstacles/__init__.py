"""Obstacles: shapes, their signed distance, and contacts of points with them."""

from __future__ import annotations

from magnetosuture_thread.geometry.obstacles.contacts import (
    FRICTION,
    WALL,
    WorkspaceData,
    find_contacts,
    wall_contact,
)
from magnetosuture_thread.geometry.obstacles.half_segments import half_segment_distances
from magnetosuture_thread.geometry.obstacles.shapes import Disc, Obstacle, Polygon, Triangulation, triangulate
from magnetosuture_thread.geometry.obstacles.workspace import MAX_FRICTION, Contacts, Workspace

__all__ = [
    "FRICTION",
    "MAX_FRICTION",
    "WALL",
    "Contacts",
    "Disc",
    "Obstacle",
    "Polygon",
    "Triangulation",
    "Workspace",
    "WorkspaceData",
    "find_contacts",
    "half_segment_distances",
    "triangulate",
    "wall_contact",
]
