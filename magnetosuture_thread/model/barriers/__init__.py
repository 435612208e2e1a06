"""Control barrier functions of the thread, a file for each kind."""

from magnetosuture_thread.model.barriers.connectivity import Compression, Connectivity, EnhancedConnectivity
from magnetosuture_thread.model.barriers.obstacle import ObstacleAvoidance, SquaredObstacleAvoidance
from magnetosuture_thread.model.barriers.rows import NO_OBSTACLE, Barrier, BarrierKind, BarrierRows
from magnetosuture_thread.model.barriers.stiffness import Stiffness
from magnetosuture_thread.model.barriers.wall import WallAvoidance

__all__ = [
    "NO_OBSTACLE",
    "Barrier",
    "BarrierKind",
    "BarrierRows",
    "Compression",
    "Connectivity",
    "EnhancedConnectivity",
    "ObstacleAvoidance",
    "SquaredObstacleAvoidance",
    "Stiffness",
    "WallAvoidance",
]
