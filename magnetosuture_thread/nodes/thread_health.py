"""What the node `thread_model` says of itself on /diagnostics."""

from __future__ import annotations

import math

from magnetosuture_thread import InvalidInputError, Scene, ThreadEstimate
from magnetosuture_thread.model.prediction import STARTED
from magnetosuture_thread.model.program import SOLVED
from magnetosuture_thread.model.session import WAITING, PredictionResult
from magnetosuture_thread.model.settings import ThreadModelSettings
from magnetosuture_thread.nodes.diagnostics import Health

UNMEASURED_TOO_LONG = 1.0  # s; an estimate that is only a prediction for longer is a warning


class ThreadHealth:
    """Puts prediction and estimate into words: what is wrong, and what the model does not know of.

    Args:
        health: of the node.
    """

    def __init__(self, health: Health) -> None:
        self._health = health
        self._waiting = True  # for a thread from which the prediction can start
        self._disturbance: tuple[float, str] | None = None  # when it was put into words [s], and these
        self._refused_pieces = 0

    def show(self, result: PredictionResult, step_time: float) -> None:
        """Report what came of a pose or an observation, and how long the prediction took [s]."""
        if isinstance(result.estimate_problem, InvalidInputError):
            self._health.refuse(result.estimate_problem)
            return
        prediction, estimate = result.prediction, result.estimate
        self._waiting = self._waiting if result.late else result.waiting
        figures: dict[str, object] = {}
        if prediction is not None:
            figures = {"residual": f"{prediction.residual:.1e}", "step_time": f"{step_time * 1e6:.0f} us"}
        if estimate is not None:
            figures |= self._estimate_figures(estimate)
        if result.problem is not None:
            self._health.error(str(result.problem), **figures)
        elif self._waiting:
            self._health.warn(WAITING if estimate is None else f"estimating; the prediction is {WAITING}", **figures)
        elif trouble := self._troubles(result):
            self._health.warn(f"predicting, but {'; '.join(trouble)}", **figures)
        else:
            self._health.ok("predicting", **figures)

    def _troubles(self, result: PredictionResult) -> list[str]:
        """Return what is wrong with prediction and estimate; figures in it change once a second at the most."""
        found, prediction, estimate = [], result.prediction, result.estimate
        if prediction is not None and prediction.status not in (SOLVED, STARTED):
            found.append(prediction.status)
        if result.estimate_problem is not None:
            found.append(f"not estimating: {result.estimate_problem}")
        if estimate is None:
            return found
        if not estimate.converged:
            found.append(result.reason)
        if estimate.disturbances:
            if not self._disturbance or abs(estimate.stamp - self._disturbance[0]) >= 1.0:
                self._disturbance = (estimate.stamp, "; ".join(map(str, estimate.disturbances)))
            found.append(self._disturbance[1])
        else:
            self._disturbance = None
        if estimate.unmeasured_for >= UNMEASURED_TOO_LONG:
            why = f" ({estimate.problems[0]})" if estimate.problems else ""
            found.append(f"the estimate is only a prediction since {math.floor(estimate.unmeasured_for)} s{why}")
        return found

    def _estimate_figures(self, estimate: ThreadEstimate) -> dict[str, object]:
        self._refused_pieces += len(estimate.problems)
        deviation = 1e3 * float(estimate.deviation.max())
        figures: dict[str, object] = {
            "measured": f"{100.0 * (1.0 - estimate.hidden):.0f} %",
            "deviation": f"{deviation:.3f} mm",
            "refused_pieces": self._refused_pieces,
        }
        if estimate.problems:
            figures["last_refused_piece"] = estimate.problems[0]
        return figures | {f"learned {each.name}": each for each in estimate.slow_parameters}


def model_text(settings: ThreadModelSettings, scene: Scene | None) -> str:
    """Return in words which thread is modelled, where and how."""
    where = f"{len(scene.shapes)} shapes in a dish" if scene is not None else "no scene yet"
    thread = f"{settings.segments} segments of {settings.material}"
    return f"{thread}, {where}, {settings.formulation} by {settings.solver}"
