"""The command `magnetosuture evaluate`: a page for each bag and a table over all, or scores of trajectories."""

from __future__ import annotations

import argparse
import math
import os
import platform
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magnetosuture_thread import ConfigurationError, MagnetosutureError
from magnetosuture_thread.bags.reader import RecordedMessage
from magnetosuture_thread.bags.reading import stamp_of
from magnetosuture_thread.bags.recording import CHANNELS, Recording
from magnetosuture_thread.bags.storage import METADATA_FILE, find_bag_files
from magnetosuture_thread.commands import command, recorded
from magnetosuture_thread.commands.output import whole_folder
from magnetosuture_thread.commands.replay import find_photos
from magnetosuture_thread.commands.track import numbered
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.estimator.thread_session import WAITING
from magnetosuture_thread.evaluation import reference, tables
from magnetosuture_thread.evaluation.figures import STAGES, BagDetails, Figures, LiveFigures
from magnetosuture_thread.evaluation.metrics import Percentiles, RunMetrics
from magnetosuture_thread.evaluation.page import write_page
from magnetosuture_thread.evaluation.plots import draw_case, draw_worst_frame
from magnetosuture_thread.evaluation.tables import Row
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.rig.mechanics.dynamics import NeedleJoint, RigDynamics, Surface, ThreadProperties
from magnetosuture_thread.rig.mechanics.needle import NeedleBody
from magnetosuture_thread.rig.setups import read_setup
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.configuration import Configuration, configuration_fields
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import is_url
from magnetosuture_thread.settings.interface import STORAGE_SUFFIXES
from magnetosuture_thread.settings.texts import one_line
from magnetosuture_thread.workers import Log, Progress, WorkerDiedError, make_runner

if TYPE_CHECKING:
    from typing_extensions import Unpack

BAG_OPTIONS = ("output", "setup", "against", "source", "remap", "frame", "start", "duration", "workers", "scheduler")
REFERENCE_OPTIONS = ("solver", "segments", "rig", "json", "pictures")


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    command.runs(parser, run_evaluate)
    parser.set_defaults(default_of=parser.get_default)
    option = parser.add_argument
    option("paths", type=command.bag_location, nargs="+", metavar="PATH", help="bags, or trajectories; see above")
    formulation = "how a step is written (default: a bag's setup's; rod)"
    option("--formulation", choices=("rod", "paper"), default="", help=formulation)
    bags = parser.add_argument_group("bags")
    bags.add_argument("--output", type=Path, metavar="DIR", help="folder to make; required")
    against = "measured thread (seen) or ground truth (default: both where present, the worst frames by ground truth)"
    bags.add_argument("--against", choices=("auto", "truth", "seen"), default="auto", help=against)
    command.add_source(bags, "each bag")
    command.add_span(bags, "each bag")
    command.add_workers(bags)
    option = parser.add_argument_group("reference trajectories").add_argument
    option("--solver", choices=("banded", "osqp"), help="what solves a step (default: banded)")
    count = command.count_argument("segments", 3, 2000)
    option("--segments", type=count, metavar="N", help="number of segments (default: the paper's, as each file says)")
    rig = "score the simulated rig's thread instead of the model (default: N = 100)"
    option("--rig", action="store_true", help=rig)
    option("--json", type=command.output_file, metavar="FILE", help="write the figures to a file")
    option("--pictures", type=Path, metavar="FOLDER", help="draw each case into a folder")


def run_evaluate(options: argparse.Namespace, terminal: command.Terminal) -> int:
    """Score the thread model on bags, or on reference trajectories.

    Bags: the thread of each is predicted and estimated without a graph, as fast as the machine can, and compared with
    the measured centreline and, where the bag holds it, ground truth. PATH is an mcap or db3 file, the folder of a
    bag, or a folder of bags, which may be up to two folders below; or the URL of one, such as s3://BUCKET/RUNS. DIR,
    which must not exist, gets
      NAME.html    a page for each bag, which needs no network: plots to zoom, the worst frames
      table.csv    a row for each bag, SI units and %
      table.json   the same, with mean and worst, and prediction and estimate side by side
      table.parquet  table.csv for DuckDB or pandas, where pyarrow is installed (extra `cluster`)
    A bag that cannot be evaluated has its row too, with the problem in it; the exit code is 1 then.

    Reference trajectories: files DIR/*.npz with the needle's poses and the thread that followed (arrays t, pose, X and
    meta, as for `render`). The model starts from the first thread, is driven by the poses and nothing else, with each
    file's own thread and parameters, and is compared at every sample. Bags and trajectories need a call each.

    Errors are mean distances of the nodes in % of the thread's length.
    """
    is_bags = kind_of(options.paths) == "bags"
    for name in REFERENCE_OPTIONS if is_bags else BAG_OPTIONS:
        given = getattr(options, name)
        if given != options.default_of(name):
            why = "for reference trajectories; PATH is none" if is_bags else "for bags; PATH is a reference trajectory"
            raise ConfigurationError(f"--{name}", str(given), f"nothing: it is only {why}")
    if not is_bags:
        with terminal.progress("evaluate") as advance:
            evaluation = _score_references(options, advance)
        terminal.print(tables.evaluation_table(evaluation))
        command.write_json(options.json, evaluation.to_mapping())
        return command.DONE
    if missing := [path for path in options.paths if not is_url(path) and not path.exists()]:
        raise BagError(missing[0], "does not exist; expected bags, folders of them, or reference trajectories")
    if options.output is None:
        raise ConfigurationError("--output", None, "a folder to make, as PATH is a bag")
    given = command.given(options, "paths", "output", "against", "formulation", "workers", "scheduler")
    with terminal.progress("evaluate") as advance:
        rows = evaluate_bags(**given, **command.bag_selection(options), log=terminal.log, progress=advance)
    terminal.print(tables.bags_table(rows))
    terminal.log(f"results: {options.output}")
    return command.FAILED if any(row["problem"] for row in rows) else command.DONE


def evaluate_bags(
    paths: Sequence[Path],
    output: Path,
    *,
    against: str = "auto",
    formulation: str = "",
    workers: int = 1,
    scheduler: str = "",
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
    **selection: Unpack[recorded.BagSelection],
) -> list[Row]:
    """Evaluate bags, each for itself.

    `output` is made at the end, whole or not at all: NAME.html of each bag, table.csv and table.json. A bag that
    cannot be evaluated has its row all the same, with the problem in it, and no page. What is written does not depend
    on the number of workers, but for the times that steps took.

    Args:
        paths: bags, or folders of bags.
        output: folder to make.
        against: `truth` or `seen` (measured); `auto`: both where present.
        formulation: of the model; the setup's if empty.
        workers: processes.
        scheduler: address of a Dask scheduler, whose workers evaluate the bags in place of those.
        log: called with a line for a person.
        progress: called with the share done, 0 to 1.
        selection: what of the bags is read.

    Returns:
        The rows of the table, in the order of the bags.

    Raises:
        BagError: there are no bags, or the output exists or cannot be written.
        ConfigurationError: the setup that was asked for cannot be used.
    """
    if setup_name := selection.get("setup_name"):
        read_setup(setup_name)  # refuses what is wrong for all before anything is done
    bags = find_bags(paths)
    names = numbered([name_of(bag) for bag in bags], "{}-{}")
    tasks = [EvaluationTask(bag, name, against, formulation, selection) for bag, name in zip(bags, names, strict=True)]
    rows: dict[int, Row] = {}
    with whole_folder(output) as folder, make_runner(evaluate_one, workers, scheduler) as runner:
        for index, result in runner.run(tasks, log, progress):
            task = tasks[index]
            row, page = (_failed(task, str(result)), "") if isinstance(result, WorkerDiedError) else result
            if row["problem"]:
                log(f"{task.name}: {row['problem']}")
            else:
                (folder / f"{task.name}.html").write_text(page, encoding="utf-8")
            rows[index] = row
        ordered = [rows[index] for index in range(len(tasks))]
        (folder / "table.csv").write_text(tables.table_csv(ordered), encoding="utf-8", newline="")
        (folder / "table.json").write_text(tables.table_json(ordered), encoding="utf-8")
        if problem := write_parquet(folder / "table.parquet", [tables.flat(row) for row in ordered]):
            log(f"no table.parquet: {problem}")
    return ordered


def evaluate_one(task: EvaluationTask, log: Log, progress: Progress) -> tuple[Row, str]:
    """Return the row of a bag and its page; with a problem in the row, there is no page: nothing stops the others."""
    try:
        return evaluate_bag(task, lambda text: log(f"{task.name}: {text}"), progress)
    except MagnetosutureError as error:
        return _failed(task, str(error)), ""
    except Exception as error:  # A mistake of ours, or of a package: this bag's alone.
        return _failed(task, f"{type(error).__name__}: {error}"), ""


def _failed(task: EvaluationTask, problem: str) -> Row:
    return tables.failed_row(task.name, one_line(str(task.path)), one_line(" ".join(problem.split())))


def write_parquet(path: Path, rows: Sequence[dict[str, Any]]) -> str:
    """Write rows as a Parquet table for DuckDB or pandas; return why none is written, if pyarrow is broken.

    Without pyarrow (extra `cluster`) none is written.

    Args:
        path: the file to make.
        rows: plain values by column, the same columns in each.
    """
    try:
        from pyarrow import Table, parquet
    except ModuleNotFoundError:
        return ""
    except ImportError as error:  # as with libraries of another NumPy
        return f"pyarrow cannot be used: {' '.join(str(error).split())}"
    parquet.write_table(Table.from_pylist(rows), path)
    return ""


def name_of(bag: Path) -> str:
    """Return the name of a bag's report: that of its folder or file."""
    path = bag if is_url(bag) else Path(os.path.abspath(bag))
    name = one_line(path.name if path.is_dir() else path.stem).lstrip(".") or "bag"
    return name.encode()[:200].decode("utf-8", "ignore")


def find_bags(paths: Sequence[Path], depth: int = 2) -> list[Path]:
    """Return the bags at paths, in their order, each once; within a folder by name.

    Args:
        paths: bags, or folders that hold some.
        depth: folders below a path in which bags are looked for.

    Raises:
        BagError: a path holds none.
    """
    found: dict[Path, Path] = {}
    for path in paths:
        bags = _bags(path, depth)
        for bag in bags:
            found.setdefault(bag.resolve(), bag)
        if not bags:
            endings = " or ".join(STORAGE_SUFFIXES)
            raise BagError(path, f"holds no bags ({endings}), nor do the folders in it")
    return list(found.values())


def _bags(path: Path, depth: int) -> list[Path]:
    try:
        if not path.exists():
            raise BagError(path, "does not exist; expected a bag, or a folder of bags")
        if path.is_file():
            return [path]
        inside = sorted(path.iterdir())
    except BagError:
        raise
    except Exception as error:  # The file system of a URL raises whatever its library does.
        raise BagError(path, f"cannot be read: {error}") from None
    if any(file.name == METADATA_FILE for file in inside):
        return [path]
    files = [file for file in inside if file.suffix in STORAGE_SUFFIXES and file.is_file()]
    folders = [folder for folder in inside if depth > 0 and folder.is_dir() and not folder.name.startswith(".")]
    below = [bag for folder in folders for bag in _bags(folder, depth - 1)]
    if files and not below:
        with suppress(BagError):  # raised where the files are several bags
            find_bag_files(path)
            return [path]
    return files + below


def kind_of(paths: Sequence[Path]) -> str:
    """Return `references` or `bags`.

    Raises:
        ConfigurationError: there are both.
    """
    references = [path for path in paths if _is_reference(path)]
    if 0 < len(references) < len(paths):
        expected = "bags alone, or reference trajectories alone, in one call"
        raise ConfigurationError("PATH", str(references[0]), expected)
    return "references" if references else "bags"


def _is_reference(path: Path) -> bool:
    """Return whether a path is a reference trajectory, or a folder of them, and no bag."""
    if is_url(path):
        return False
    try:
        return path.suffix == ".npz" if path.is_file() else any(path.glob("*.npz"))
    except OSError:
        return False


def _score_references(options: argparse.Namespace, progress: Progress) -> reference.Evaluation:
    paths = [path for folder in options.paths for path in reference.find_references(folder)]
    formulation, pictures = options.formulation or "rod", options.pictures
    if pictures:
        pictures.mkdir(parents=True, exist_ok=True)

    def keep(case: reference.CaseResult) -> None:
        if pictures:
            draw_case(pictures / f"{case.score.name}.png", case, "rig" if options.rig else formulation)

    given: dict[str, Any] = {"segments": options.segments, "progress": progress, "keep": keep}
    if options.rig:
        return score_rig(paths, **given)
    return reference.score(paths, formulation=formulation, solver=options.solver or "banded", **given)


def score_rig(
    paths: Sequence[Path],
    segments: int | None = None,
    progress: Progress = lambda share: None,
    keep: Callable[[reference.CaseResult], None] = lambda result: None,
) -> reference.Evaluation:
    """Move the rig's needle along reference trajectories and score its thread, nothing tuned for a case.

    Of the scores, `max_residual` is in units of the drag across the whole thread at the case's greatest speed, and
    `fallbacks` counts steps that had to be halved.

    Args:
        paths: the trajectories.
        segments: n, 100 unless given.
        progress: is told the share done.
        keep: is given each case's result.

    Raises:
        BagError: a file is no reference trajectory.
        SolverError: a step could not be solved.
    """
    count = segments or 100
    # Of a needle whose motion is given, the body does not matter.
    body = NeedleBody(length=7e-3, diameter=4e-4, curvature=0.0, magnetisation=0.0, viscosity=1.0)

    def score_case(trajectory: reference.ReferenceTrajectory, path: Path, share: Progress) -> reference.CaseResult:
        thread = _rig_thread(trajectory, path, count)
        first, length = trajectory.threads[0], thread.length
        if np.ptp(first, axis=0).max() == 0.0 or np.linalg.norm(first[0] - trajectory.tails[0]) > 0.1 * length / count:
            raise BagError(path, "has a first thread of one point, or one that does not begin at the needle's tail")
        if thread.diameter >= length:
            raise BagError(path, f"has a thread of {thread.diameter:g} m in diameter, expected less than its length")
        surface, heading = Surface(discs=trajectory.discs), float(trajectory.headings[0])
        rig = RigDynamics(body, thread, surface, None, trajectory.tails[0], heading, first)
        speed = np.linalg.norm(np.diff(trajectory.tails, axis=0), axis=1) / np.diff(trajectory.times)
        force = thread.drag_across * length * max(float(speed.max()), 1e-6)

        def step(index: int) -> RigDynamics:
            interval = trajectory.times[index] - trajectory.times[index - 1]
            rig.drive(trajectory.tails[index], float(trajectory.headings[index]), interval)
            return rig

        def figures(rig: RigDynamics) -> reference.StepFigures:
            strain = max(0.0, float(rig.tension.max()) / thread.stretching_stiffness)
            return reference.StepFigures(rig.thread, strain, rig.residual / force, rig.halvings)

        return reference.run_case(trajectory, rig.thread, length, thread.diameter, step, figures, share)

    return reference.Evaluation("rig", "newton", reference.score_each(paths, score_case, progress, keep))


def _rig_thread(trajectory: reference.ReferenceTrajectory, path: Path, segments: int) -> ThreadProperties:
    """Return the thread that a trajectory's metadata describes.

    Raises:
        BagError: the metadata lacks something, or holds what is none.
    """
    names = ("L_m", "EI_Nm2", "EA_N", "zeta_perp_Pa_s", "zeta_par_Pa_s", "diameter_m")
    try:
        given = trajectory.metadata["material"]
        length, bending, stretching, across, along, diameter = values = [float(given[name]) for name in names]
        attachment = {"pinned": NeedleJoint.PINNED, "clamped": NeedleJoint.CLAMPED}[trajectory.metadata["boundary"]]
    except reference.NOT_ONE as error:
        raise BagError(path, f"has no thread in its metadata: {type(error).__name__} {error}") from None
    if not all(math.isfinite(value) and value > 0.0 for value in values):
        raise BagError(path, f"has a thread with one of {', '.join(names)} not positive")
    return ThreadProperties(length, segments, bending, stretching, across, along, attachment, diameter=diameter)


LATENT = dict(zip((interface.NEEDLE_POSE, interface.PREDICTED_THREAD, interface.CURRENTS), STAGES, strict=True))


@dataclass(frozen=True)
class EvaluationTask:
    """A bag to evaluate.

    Attributes:
        path: of the bag.
        name: of its report.
        against: what predictions are compared with: `truth`, `seen` (measured), or `auto`: both where present.
        formulation: of the model; the setup's if empty.
        selection: what of the bag is read.
    """

    path: Path
    name: str
    against: str
    formulation: str
    selection: recorded.BagSelection


def evaluate_bag(task: EvaluationTask, log: Log, progress: Progress) -> tuple[Row, str]:
    """Evaluate a bag; return its row of the table, and its page.

    Of each frame some numbers are kept, and of a few frames the threads: memory grows by 210 bytes a frame.

    Args:
        task: which bag, and how.
        log: called with a line for a person.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: the bag cannot be used, what is compared with is not in it, or nothing in it was predicted.
        ConfigurationError: the setup cannot be used.
    """
    with recorded.open_bag(task.path, log, **task.selection) as given:
        recording, span = given.recording, (given.start, given.duration)
        model = replace(given.setup.model, formulation=task.formulation or given.setup.model.formulation)
        is_recorded = bool(recording.counts.get(interface.PREDICTED_THREAD.recorded))
        targets = _targets(given, task.against)
        metrics = RunMetrics(model.thread_length, recording.start, targets, recorded=is_recorded)
        seen = given.observations(lambda share: progress(0.95 * share))
        held, refused = RecordedPredictions(recording, *span), Counter[str]()
        for step in recorded.predictions(seen, model, given.setup.scene, metrics.observe):
            own = held.of(step.observation.stamp) if step.result.prediction is not None else None
            recorded.measure_step(step, metrics, refused, own)
        figures = Figures.of(metrics, live_figures(recording, *span), (given.start, given.start + given.duration))
        refused += (
            Counter({why: count for why, count in seen.refused.items() if why != recorded.NOT_FOUND})
            + recording.refused
        )
        if not figures.predicted:
            counts = Counter(metrics.reasons) + refused
            why = "; ".join(f"{count} times {reason}" for reason, count in counts.most_common(3)) or WAITING
            found = f"{figures.tracked} of {figures.frames} had a needle"
            raise BagError(recording.path, f"gave no prediction: {found}; {why}")
        about = _about(given, task.name, model, refused, seen.thread_problem())
        worst = metrics.worst_frames()
        photos = find_photos(given, {each.frame.stamp for each in worst})
        shown: dict[str, Any] = {"target": metrics.target, "length": model.thread_length}
        shown |= {"dish_diameter": about.dish_diameter, "simulated": bool(about.simulated)}
        pictures = [draw_worst_frame(each, photos.get(each.frame.stamp), **shown) for each in worst]
    page = write_page(about, metrics, figures, pictures)
    progress(1.0)
    return tables.row_of(about, figures), page


def _targets(given: recorded.BagInput, against: str) -> list[str]:
    """Return what the predictions are compared with.

    Raises:
        BagError: the bag does not hold it.
    """
    counts, targets = given.recording.counts, []
    for target, channel in (("truth", interface.GROUND_TRUTH_THREAD), ("seen", interface.MEASURED_THREAD)):
        if counts.get(channel.recorded) or (target == "seen" and given.source == "camera"):
            targets.append(target)
        elif against == target:
            raise BagError(given.recording.path, f"has no messages on {channel.recorded} ({channel.type_name})")
    return [target for target in targets if against in ("auto", target)]


def _about(
    given: recorded.BagInput, name: str, model: ThreadModelSettings, refused: Counter[str], problem: str
) -> BagDetails:
    recording, setup = given.recording, given.setup
    return BagDetails(
        name=name,
        path=one_line(str(recording.path)),
        setup=setup.name,
        simulated=recording.notes.get("simulated", ""),
        source=given.source,
        formulation=model.formulation,
        length=model.thread_length,
        segments=model.segments,
        dish_diameter=setup.scene.dish.diameter,
        start=recording.start,
        begin=given.start,
        duration=given.duration,
        damage=tuple(str(place) for place in recording.damage.regions) if recording.damage else (),
        unverified=recording.salvaged_without_checksum,
        refused=dict(refused.most_common()),
        topics={
            channel.recorded: (channel.type_name, recording.counts[channel.recorded])
            for channel in CHANNELS
            if recording.counts.get(channel.recorded)
        },
        settings=(*_settings(model), *_settings(setup.vision)),
        remarks=(problem,) if problem else (),
        software=_versions(),
    )


def _settings(settings: Configuration) -> Iterator[tuple[str, str, str]]:
    for field in configuration_fields(type(settings)):
        value = getattr(settings, field.name)
        shown = ", ".join(f"{entry}" for entry in value) if isinstance(value, tuple) else f"{value}"
        yield f"{field.group}.{field.name}", shown, field.quantity.unit


def _versions() -> tuple[tuple[str, str], ...]:
    found = []
    for name in ("magnetosuture_thread", "numpy", "numba", "opencv-python-headless"):
        with suppress(PackageNotFoundError):  # as where Ubuntu's python3-opencv is in its place
            found.append((name, version(name)))
    return *found, ("Python", platform.python_version())


def live_figures(recording: Recording, start: float, duration: float | None) -> LiveFigures:
    """Return the latencies of a recorded graph: from a stamp to when the first message about it was recorded.

    Args:
        recording: the bag.
        start: seconds into the bag to begin at.
        duration: [s]; to the bag's end if None.

    Raises:
        BagError: the bag has changed since it was opened.
    """
    there = [channel for channel in LATENT if recording.counts.get(channel.recorded)]
    if not there:
        return LiveFigures()
    if "replayed" in recording.notes:
        return LiveFigures(remark="not measured: the bag was replayed")
    latencies = {channel.recorded: array("d") for channel in there}
    latest: dict[str, int] = {}
    for record in recording.records(there, start=start, duration=duration):
        stamp = _stamp(record)
        if stamp > latest.get(record.topic, 0):  # the first about each
            latest[record.topic] = stamp
            latencies[record.topic].append((record.time - stamp) * 1e-9)
    percentiles = {LATENT[channel]: Percentiles.of(latencies[channel.recorded]) for channel in there}
    found = {stage: each for stage, each in percentiles.items() if each is not None}
    if any(not 0.0 <= each.median <= 10.0 for each in found.values()):
        return LiveFigures(remark="not measured: stamps and times of recording are of two clocks")
    if all(each.maximum == 0.0 for each in found.values()):
        return LiveFigures(remark="not measured: the bag was made offline")
    return LiveFigures(found)


def _stamp(record: RecordedMessage) -> int:
    """Return the stamp of what a message answers [ns]; 0 for currents that answer no command or are broken."""
    if record.topic != interface.CURRENTS.recorded:
        return stamp_of(record)
    try:
        message = record.decode()
    except BagError:
        return 0
    return 0 if message.stop else int(message.command.sec * 1_000_000_000 + message.command.nanosec)


class RecordedPredictions:
    """Gives the predictions that a bag holds, one by one, beside those made now; few are held at a time.

    Args:
        recording: the bag.
        start: seconds into the bag to begin at.
        duration: [s]; to the bag's end if None.
    """

    def __init__(self, recording: Recording, start: float, duration: float | None) -> None:
        there = recording.counts.get(interface.PREDICTED_THREAD.recorded)
        channels = [interface.PREDICTED_THREAD] if there else []
        self._records = recording.records(channels, start=start, duration=duration)
        self._held: dict[int, RecordedMessage] = {}
        self._latest = -1

    def of(self, stamp: int) -> Points | None:
        """Return the recorded prediction of a frame, shape (n + 1, 2) [m]; None if there is none.

        Args:
            stamp: of the frame [ns], not before those asked for until now.
        """
        while self._latest < stamp and len(self._held) < 600:
            record = next(self._records, None)
            if record is None:
                break
            self._latest = max(self._latest, at := stamp_of(record))
            if at >= stamp:  # those before were of frames that nobody asked for
                self._held[at] = record
        found = self._held.get(stamp)
        self._held = {at: record for at, record in self._held.items() if at > stamp}
        if found is None:
            return None
        try:
            vertices = np.array([[point.x, point.y] for point in found.decode().positions])
        except BagError:
            return None
        return vertices if vertices.shape[0] > 1 and np.isfinite(vertices).all() else None
