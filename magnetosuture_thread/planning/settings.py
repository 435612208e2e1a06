"""Settings of the needle planner."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from magnetosuture_thread.configuration import Configuration, autostart_parameter, quantity
from magnetosuture_thread.geometry.needle_arc import check_needle
from magnetosuture_thread.planning.executor import MAX_WAIT
from magnetosuture_thread.planning.planner import NeedlePlanner
from magnetosuture_thread.safety.motion import NeedleKinematics
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.shared_parameters import shared_parameter


@dataclass(frozen=True)
class NeedlePlannerSettings(Configuration):
    """The needle, its clearance, and for how long what is known stays known."""

    GROUP: ClassVar[str] = "needle_planner"

    autostart: str = autostart_parameter()
    scene: str = shared_parameter("scene")
    needle_length: float = shared_parameter("needle_length")
    needle_curvature: float = shared_parameter("needle_curvature")
    thread_length: float = shared_parameter("thread_length")
    coil_angles: tuple[float, ...] = shared_parameter("coil_angles")
    friction_feedback: str = shared_parameter("friction_feedback")
    keep_out: float = shared_parameter("keep_out")
    pose_margin: float = shared_parameter("pose_margin")
    pose_timeout: float = quantity(
        0.5,
        "a procedure pauses after this long without a needle pose; one that is older on arrival does not count",
        unit="s",
        minimum=0.05,
        maximum=5.0,
    )
    thread_timeout: float = quantity(
        0.5,
        "a procedure pauses after this long without valid margins of the thread",
        unit="s",
        minimum=0.05,
        maximum=5.0,
    )
    unmeasured_timeout: float = quantity(
        1.0,
        "a procedure pauses after this long without a measurement of the thread",
        unit="s",
        minimum=0.1,
        maximum=60.0,
    )
    thread_wait: float = quantity(
        MAX_WAIT,
        "a procedure that is paused because the thread is not known is given up after this long",
        unit="s",
        minimum=1.0,
        maximum=3600.0,
    )
    settle: float = quantity(
        0.5,
        "for which all must be known again before a procedure goes on by itself",
        unit="s",
        minimum=0.0,
        maximum=60.0,
    )
    hold_timeout: float = quantity(
        0.3, "the needle rests this long after the last message on procedure/hold, where it has to be held",
        unit="s", minimum=0.05, maximum=2.0,
    )  # fmt: skip
    audience: int = quantity(
        1, "subscribers to its commands that it waits for: the bridge, and any recorder", minimum=1, maximum=100
    )

    def check(self) -> None:
        """Reject a coiled needle."""
        check_needle(self.GROUP, self.needle_length, self.needle_curvature)

    def planner(self, scene: Scene) -> NeedlePlanner:
        """Return a planner for a scene."""
        kinematics = NeedleKinematics(self.needle_length, self.needle_curvature)
        clearance = self.keep_out + self.pose_margin  # as the bridge's filter
        return NeedlePlanner(scene, kinematics, clearance, self.thread_length, self.coil_angles)
