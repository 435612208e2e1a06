"""What a run of a campaign must keep to succeed, besides reaching its goals."""

from __future__ import annotations

from dataclasses import dataclass

from magnetosuture_thread.planning.procedure import Procedure

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
    """

    time_s: float
    ideal_time_s: float
    min_needle_clearance_m: float
    max_thread_penetration_m: float
    longest_rest_s: float
    wrap_degrees: float
    max_tension_n: float
    max_friction_nodes: int


@dataclass(frozen=True)
class RunLimits:
    """Limits of a run.

    Attributes:
        clearance: minimum of the needle's axis from wall and shapes [m].
        tension: of the thread [N].
        friction_nodes: at once.
    """

    clearance: float
    tension: float
    friction_nodes: int

    @classmethod
    def of(cls, procedure: Procedure, keep_out: float) -> RunLimits:
        """Return the limits of a procedure, with the bridge's `keep_out` [m]: the strictest of its goals'."""
        limits = procedure.limits
        return cls(
            keep_out - KEEP_OUT_TOLERANCE,
            min(each.tension for each in limits),
            min(each.friction_nodes for each in limits),
        )

    def broken(self, found: RunFigures) -> dict[str, str]:
        """Return the limits that a run did not keep: by the name of the figure, what was found and what is allowed.

        A run without a path has no ideal time, and has failed for that.
        """
        clearance, ratio = found.min_needle_clearance_m, MAX_TIME_RATIO * found.ideal_time_s
        checks = {
            "min_needle_clearance_m": (
                clearance < self.clearance,
                f"the needle's axis {1e3 * clearance:.3f} mm from wall or shape ({1e3 * self.clearance:.3f} allowed)",
            ),
            "max_thread_penetration_m": (
                found.max_thread_penetration_m > PENETRATION_TOLERANCE,
                f"a node of the thread {1e6 * found.max_thread_penetration_m:.1f} um in wall or shape",
            ),
            "longest_rest_s": (
                found.longest_rest_s > MAX_REST,
                f"a rest of {found.longest_rest_s:.1f} s ({MAX_REST:g} allowed)",
            ),
            "max_tension_n": (
                found.max_tension_n > self.tension,
                f"a tension of {1e3 * found.max_tension_n:.3g} mN ({1e3 * self.tension:.3g} allowed)",
            ),
            "max_friction_nodes": (
                found.max_friction_nodes > self.friction_nodes,
                f"{found.max_friction_nodes} nodes under friction ({self.friction_nodes} allowed)",
            ),
            "time_s": (found.time_s > ratio > 0.0, f"{found.time_s:.0f} s ({ratio:.0f} allowed)"),
        }
        return {name: words for name, (is_broken, words) in checks.items() if is_broken}
