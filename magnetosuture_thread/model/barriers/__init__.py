"""The built-in control barrier functions of the thread."""

from magnetosuture_thread.model.barriers.connectivity import Compression, Connectivity, EnhancedConnectivity
from magnetosuture_thread.model.barriers.obstacle import ObstacleAvoidance, SquaredObstacleAvoidance
from magnetosuture_thread.model.barriers.stiffness import Stiffness
from magnetosuture_thread.model.barriers.wall import WallAvoidance

__all__ = [
    "Compression",
    "Connectivity",
    "EnhancedConnectivity",
    "ObstacleAvoidance",
    "SquaredObstacleAvoidance",
    "Stiffness",
    "WallAvoidance",
]
