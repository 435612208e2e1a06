"""What a run of a campaign must keep to succeed, besides reaching its goals."""

from __future__ import annotations

from dataclasses import dataclass

KEEP_OUT_TOLERANCE = 5e-6  # m
PENETRATION_TOLERANCE = 1e-6  # m
MAX_REST = 3.0  # s
MAX_TIME_RATIO = 1.5


@dataclass(frozen=True)
class RunFigures:
    """What is measured of a run, all of it in the ground truth of the simulation but for the friction.

    Attributes:
        time_s: from the start of the procedure to its end.
        ideal_time_s: of the path planned at the start, at the allowed speed, slowed by friction as it was in the run.
        min_needle_clearance_m: of the needle's axis from wall and shapes.
        max_thread_penetration_m: of a node of the thread into wall or shapes.
        longest_rest_s: for which the needle did not move, while the procedure ran.
        wrap_degrees: that the thread swept at the most about the shape of the first wrap; 0 without one.
        max_tension_n: peak of the thread.
        max_friction_nodes: under friction at once, by the model.
        max_tension_excess_n: of the tension above the limit of the goal that was pursued; negative if it stayed below.
        max_friction_excess: of the nodes under friction above that goal's limit.
    """

    time_s: float
    ideal_time_s: float
    min_needle_clearance_m: float
    max_thread_penetration_m: float
    longest_rest_s: float
    wrap_degrees: float
    max_tension_n: float
    max_friction_nodes: int
    max_tension_excess_n: float
    max_friction_excess: int

    def beyond_limits(self, keep_out: float) -> dict[str, str]:
        """Return what a run did not keep: by the name of the figure, what was found and what is allowed.

        A run without a path has no ideal time, and has failed for that.

        Args:
            keep_out: of the bridge [m].
        """
        clearance, allowed = self.min_needle_clearance_m, keep_out - KEEP_OUT_TOLERANCE
        ratio = MAX_TIME_RATIO * self.ideal_time_s
        tension, friction = self.max_tension_excess_n, self.max_friction_excess
        checks = {
            "min_needle_clearance_m": (
                clearance < allowed,
                f"the needle's axis {1e3 * clearance:.3f} mm from wall or shape ({1e3 * allowed:.3f} allowed)",
            ),
            "max_thread_penetration_m": (
                self.max_thread_penetration_m > PENETRATION_TOLERANCE,
                f"a node of the thread {1e6 * self.max_thread_penetration_m:.1f} um in wall or shape",
            ),
            "longest_rest_s": (
                self.longest_rest_s > MAX_REST,
                f"a rest of {self.longest_rest_s:.1f} s ({MAX_REST:g} allowed)",
            ),
            "max_tension_n": (tension > 0.0, f"a tension {1e3 * tension:.3g} mN above the limit of its goal"),
            "max_friction_nodes": (friction > 0, f"{friction} more nodes under friction than its goal allows"),
            "time_s": (self.time_s > ratio > 0.0, f"{self.time_s:.0f} s ({ratio:.0f} allowed)"),
        }
        return {name: words for name, (is_broken, words) in checks.items() if is_broken}
