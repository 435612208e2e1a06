"""Obstacles: shapes, their signed distance, and contacts of points with them."""

from __future__ import annotations

from magnetosuture_thread.geometry.obstacles.closest import closest_on_triangles
from magnetosuture_thread.geometry.obstacles.contacts import WALL, WorkspaceData, find_contacts, wall_contact
from magnetosuture_thread.geometry.obstacles.disc import Disc
from magnetosuture_thread.geometry.obstacles.mesh import Mesh
from magnetosuture_thread.geometry.obstacles.packing import Obstacle
from magnetosuture_thread.geometry.obstacles.polygon import Polygon
from magnetosuture_thread.geometry.obstacles.triangulation import Triangulation, triangulate
from magnetosuture_thread.geometry.obstacles.workspace import Contacts, Workspace

__all__ = [
    "WALL",
    "Contacts",
    "Disc",
    "Mesh",
    "Obstacle",
    "Polygon",
    "Triangulation",
    "Workspace",
    "WorkspaceData",
    "closest_on_triangles",
    "find_contacts",
    "triangulate",
    "wall_contact",
]
