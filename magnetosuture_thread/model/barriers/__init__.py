"""Control barrier functions of the thread, a file for each kind."""

from magnetosuture_thread.model.barriers.connectivity import Compression, Connectivity
from magnetosuture_thread.model.barriers.obstacle import ObstacleAvoidance
from magnetosuture_thread.model.barriers.rows import NO_OBSTACLE, Barrier, BarrierKind, BarrierRows

__all__ = [
    "NO_OBSTACLE",
    "Barrier",
    "BarrierKind",
    "BarrierRows",
    "Compression",
    "Connectivity",
    "ObstacleAvoidance",
]
