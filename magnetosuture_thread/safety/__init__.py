"""Safety: the one filter that every velocity of the needle passes, last."""

from magnetosuture_thread.safety.filter import FilteredCommand, NeedleSafetyFilter
from magnetosuture_thread.safety.motion import NeedleKinematics

__all__ = ["FilteredCommand", "NeedleKinematics", "NeedleSafetyFilter"]
