"""The thread of a commissioned rig: its model fitted, its drag measured, and a verdict by a run that was not fitted."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import numpy as np

from magnetosuture_thread.calibration import commission_files as files
from magnetosuture_thread.calibration.bags import calibrate_bags
from magnetosuture_thread.calibration.commission import SQUARE_ERROR
from magnetosuture_thread.calibration.commission_files import ASSUMED, MEASURED, Value
from magnetosuture_thread.calibration.result import IDENTIFIED, CalibrationResult
from magnetosuture_thread.calibration.square import Square, TipPath, pulls
from magnetosuture_thread.calibration.thread_drag import Pulls, ThreadDrag, measure_drag, read_pulls
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.evaluation.metrics import RunMetrics
from magnetosuture_thread.evaluation.recorded import Event, Step, open_bag
from magnetosuture_thread.evaluation.replay import measure_run
from magnetosuture_thread.evaluation.workers import Log
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.rig.setups import Setup, read_setup
from magnetosuture_thread.settings.configuration import read_yaml
from magnetosuture_thread.settings.errors import ConfigurationError, MagnetosutureError
from magnetosuture_thread.settings.files import whole_file
from magnetosuture_thread.settings.shared_parameters import EVERY_NODE, PARAMETERS

THREAD_FILE, RUNS = "thread.yaml", "thread"
BARE_DRAG = "needle_drag without thread"  # in the summary of a commissioning
PULLS, OTHER_PULLS = 5, 3  # of the run that is fitted, and of the one that is predicted
# Of the prediction, mean and maximum over time [% of length]; the mean is less than keep_out, too.
MEAN_ERROR, WORST_ERROR = 2.0, 5.0
NOISE = 0.1  # % of length, as in the fit; by more a prediction may not be worse than with what was assumed before
DRAG_INTERVAL = 0.25  # of thread_drag, as of all that commission calls measured
OWN_DRAG_ERROR = 0.2  # of the needle's own drag against that of the bare needle
INSTANTS = 6  # that are drawn


class ThreadBench(Protocol):
    """What steers a needle with a thread, and records it."""

    def follow(self, path: TipPath, setup: Setup, bag: Path) -> tuple[float, str]:
        """Steer the needle's tip along a path with a setup, into a bag.

        Returns:
            The largest distance of the tip from the path [m], and why its end was not reached, empty if it was.
        """


@dataclass(frozen=True)
class Prediction:
    """How the thread of a run was predicted by poses alone.

    Attributes:
        before: errors by the setup before, see `RunMetrics.errors`, of the measured thread, and the truth if known.
        after: errors as calibrated.
        metrics: as calibrated.
        instants: predicted and measured threads at some frames, each of shape (m, 2) [m].
    """

    before: Mapping[str, Any]
    after: Mapping[str, Any]
    metrics: RunMetrics
    instants: tuple[tuple[Points, Points], ...]


@dataclass(frozen=True)
class ThreadResult:
    """What came of a thread.

    Attributes:
        values: that were found.
        failures: why nothing is written; empty if the verification passed.
        fit: of the thread's parameters; None where there was no run.
        pulls: what the drag is measured by.
        drag: of the thread.
        prediction: of the run that was not fitted.
        square: largest distance of the needle from a square; nan if it was not tried [m].
        bags: of the runs, by what they are for.
    """

    values: tuple[Value, ...] = ()
    failures: tuple[str, ...] = ()
    fit: CalibrationResult | None = None
    pulls: Pulls | None = None
    drag: ThreadDrag | None = None
    prediction: Prediction | None = None
    square: float = math.nan
    bags: Mapping[str, str] = field(default_factory=dict)


class ThreadCommissioning:
    """Measures the thread of a rig that `commission` has measured without it.

    Args:
        folder: of the commissioning, in which a folder of bags grows.
        bench: with the thread at the needle, in an empty dish.
        log: called with a line for a person at each step.

    Raises:
        ConfigurationError: the folder holds no commissioning that passed.
    """

    def __init__(self, folder: Path, bench: ThreadBench, log: Log) -> None:
        self._folder, self._bench, self._log = folder, bench, log
        self._bags: dict[str, str] = {}
        self._result = ThreadResult()
        self.setup, self._own = read_commissioned(folder)

    def run(self) -> ThreadResult:
        """Record, fit, and verify; see the module. A run that cannot be used is a failure."""
        with TemporaryDirectory() as spare:
            try:
                failures = self._measure(Path(spare)) or self._verify(Path(spare))
            except MagnetosutureError as error:
                failures = [str(error)]
        return replace(self._result, failures=tuple(failures), bags=self._bags)

    def _measure(self, spare: Path) -> list[str]:
        """Record pulls, fit the thread's parameters to them, and measure its drag; return why there is none."""
        radius, length = self.setup.scene.dish.radius, self.setup.coils.needle_length
        if problem := self._follow("fitted", TipPath(length, *pulls(radius, PULLS)), self.setup)[1]:
            return [f"fitted: {problem}"]
        path, name = self._folder / self._bags["fitted"], str(self.setup.path)
        fit = calibrate_bags([path], spare / THREAD_FILE, log=self._log, source="poses", setup_name=name)
        if not fit.finished:  # `calibrate` keeps what it has when it is interrupted
            raise KeyboardInterrupt
        self._result = ThreadResult(fit=fit)
        measured = read_pulls(path, self.setup)
        drag = measure_drag(measured, self._own)
        values = values_of(fit, drag, self.setup.coils)
        self._result = ThreadResult(values=values, fit=fit, pulls=measured, drag=drag)
        return drag_failures(drag, self._own[0])

    def _verify(self, spare: Path) -> list[str]:
        """Predict other pulls and follow a square with what was found, and write it; return why it is not written."""
        after, radius = self._changed(spare), self.setup.scene.dish.radius
        other = TipPath(after.coils.needle_length, *pulls(radius, OTHER_PULLS, left=False))
        if problem := self._follow("predicted", other, after)[1]:
            return [f"predicted: {problem}"]
        prediction = self._predict(after)
        apart, problem = self._follow("square", Square(after.coils, radius, any_corner=True), after)
        self._result = replace(self._result, prediction=prediction, square=apart)
        if not problem and apart > SQUARE_ERROR:
            problem = f"the needle is {1e3 * apart:.2f} mm off ({1e3 * SQUARE_ERROR:g} mm allowed)"
        failures = prediction_failures(prediction, after) + ([f"square: {problem}"] if problem else [])
        if not failures:
            text, run = (spare / THREAD_FILE).read_text(encoding="utf-8"), self._bags["fitted"]
            with whole_file(self._folder / THREAD_FILE) as partial:
                partial.write_text(text.replace(str(self._folder / run), run), encoding="utf-8")
            with whole_file(self._folder / files.SETUP_FILE) as partial:
                partial.write_bytes(after.path.read_bytes())
        return failures

    def _follow(self, name: str, path: TipPath, setup: Setup) -> tuple[float, str]:
        """Follow a path into the next bag of the folder; bags of before stay."""
        runs = self._folder / RUNS
        runs.mkdir(exist_ok=True)
        last = max((int(run.name) for run in runs.iterdir() if run.name.isdigit()), default=-1)
        self._bags[name] = f"{RUNS}/{last + 1:03d}"
        apart, problem = self._bench.follow(path, setup, self._folder / self._bags[name])
        self._log(f"{name}: {problem or f'within {1e3 * apart:.2f} mm of the path'}; {self._bags[name]}")
        return apart, problem

    def _changed(self, spare: Path) -> Setup:
        """Write the setup with what was found, and return it."""
        section = read_yaml(spare / THREAD_FILE, "thread")[f"{EVERY_NODE}/{ThreadModelSettings.GROUP}"][PARAMETERS]
        sections = files.changed_sections(self.setup.path, {})
        section = {name: value for name, value in section.items() if name not in sections[EVERY_NODE]}
        numbers = {value.name: value.value for value in self._result.values}
        coils = {name: numbers[name] for name in ("thread_drag", "needle_drag", "max_pull")}
        keys = ThreadModelSettings.GROUP, CoilBridgeSettings.GROUP
        changes = {f"{EVERY_NODE}/{key}": values for key, values in zip(keys, (section, coils), strict=True)}
        sections = files.changed_sections(self.setup.path, changes)
        first = self.setup.path.read_text(encoding="utf-8").partition("\n")[0]
        path = spare / files.SETUP_FILE
        path.write_text(f"{first}\n{files.setup_text(sections)}", encoding="utf-8")
        return read_setup(str(path), self.setup.scene)

    def _predict(self, after: Setup) -> Prediction:
        """Predict the thread of the run that was not fitted by both setups."""
        instants: list[tuple[Points, Points]] = []

        def keep(event: Event) -> None:
            if isinstance(event, Step) and event.result.prediction is not None and len(event.observation.measured):
                instants.append((event.result.prediction.positions.copy(), event.observation.measured))

        def measure(setup: Setup, write: Callable[[Event], None]) -> RunMetrics:
            path = self._folder / self._bags["predicted"]
            with open_bag(path, lambda line: None, setup_name=str(setup.path), source="poses") as bag:
                return measure_run(bag, setup.model, write=write).metrics

        before, metrics = measure(self.setup, lambda event: None), measure(after, keep)
        at = np.linspace(0, len(instants) - 1, INSTANTS + 1).round().astype(int)[1:]
        return Prediction(before.errors(), metrics.errors(), metrics, tuple(instants[k] for k in at))


def read_commissioned(folder: Path) -> tuple[Setup, tuple[float, float]]:
    """Return the setup of a commissioning, in an empty dish, and the drag of its bare needle with the interval [N s/m].

    Raises:
        ConfigurationError: there is none that passed.
    """
    path = folder / files.SUMMARY_FILE
    summary = read_yaml(path, "summary of a commissioning")
    if summary.get("verdict") != "pass":
        raise ConfigurationError("verdict", summary.get("verdict"), "pass: commission the bare needle first", str(path))
    own = next(value for value in summary["values"] if value["name"] == BARE_DRAG)
    setup, coils = read_setup(str(folder / files.SETUP_FILE)), str((folder / files.COILS_FILE).resolve())
    if setup.coils.calibration not in ("", coils):
        name = f"{CoilBridgeSettings.GROUP}.calibration"
        raise ConfigurationError(name, setup.coils.calibration, f"{coils}, of the same folder", str(setup.path))
    return setup.with_scene(Scene(setup.scene.dish)), (own["value"], own["interval"])


def values_of(fit: CalibrationResult, drag: ThreadDrag, believed: CoilBridgeSettings) -> tuple[Value, ...]:
    """Return the values that were found, in the order of a report."""
    values = []
    for each in fit.estimates:
        half = max(each.high - each.value, each.value - each.low)
        kind = MEASURED if each.status == IDENTIFIED else ASSUMED
        values.append(Value(each.name, each.unit, each.value, half, kind, each.start or math.nan))
    pull = believed.max_pull * drag.along[0] / believed.thread_drag if believed.thread_drag else believed.max_pull
    unit, nothing = "N s/m", math.nan
    return (
        *values,
        Value("thread_drag", unit, *drag.along, MEASURED, believed.thread_drag),
        Value("thread_drag across", unit, *drag.across, MEASURED, nothing),
        Value("needle_drag", unit, *drag.total, MEASURED, believed.needle_drag),
        Value("max_pull", "N", pull, nothing, ASSUMED, believed.max_pull),
    )


def drag_failures(drag: ThreadDrag, bare: float) -> list[str]:
    """Return why a drag is no measurement, beside that of the bare needle [N s/m]."""
    (along, interval), own = drag.along, drag.needle
    words = f"the needle's own drag is {own:.3g} N s/m, {bare:.3g} without thread: another needle, or liquid"
    wide = f"thread_drag is {along:.3g} ± {interval:.2g} N s/m (±{DRAG_INTERVAL:.0%} allowed)"
    checks = (not 0.0 <= interval <= DRAG_INTERVAL * along, wide), (abs(own / bare - 1.0) > OWN_DRAG_ERROR, words)
    return [words for failed, words in checks if failed]


def prediction_failures(prediction: Prediction, setup: Setup) -> list[str]:
    """Return why a prediction is none that a needle may be planned by with a setup."""
    errors = prediction.after["seen"]
    room = 100.0 * setup.coils.keep_out / setup.model.thread_length
    figures = (("mean", errors["mean"], min(MEAN_ERROR, room)), ("maximum", errors["maximum"], WORST_ERROR))
    before = prediction.before["seen"]["mean"]
    worse = f"predicted: the mean error is {errors['mean']:.2f} %, and {before:.2f} % as assumed before"
    return ([worse] if errors["mean"] > before + NOISE else []) + [
        f"predicted: the {name} error is {error:.2f} % of the thread's length ({limit:g} % allowed)"
        for name, error, limit in figures
        if error > limit
    ]
