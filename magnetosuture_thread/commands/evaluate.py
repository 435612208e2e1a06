"""The command `magnetosuture evaluate`: bags, or reference trajectories, as a table and a picture of each."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magnetosuture_thread import ConfigurationError, MagnetosutureError
from magnetosuture_thread.bags.storage import METADATA_FILE, find_bag_files
from magnetosuture_thread.commands import command
from magnetosuture_thread.commands.track import numbered
from magnetosuture_thread.evaluation import reference, tables
from magnetosuture_thread.evaluation.recorded import NOT_FOUND, BagInput, BagSelection, open_bag
from magnetosuture_thread.evaluation.replay import draw_run, measure_run, picture_or_log, recorded_latency
from magnetosuture_thread.evaluation.workers import Log, Progress, TaskRunner, WorkerDiedError
from magnetosuture_thread.rig.setups import read_setup
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import BagError, one_line
from magnetosuture_thread.settings.files import is_url, whole_file, whole_folder

if TYPE_CHECKING:
    from typing_extensions import Unpack


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.set_defaults(default_of=parser.get_default)
    option = parser.add_argument
    option("paths", type=command.bag_location, nargs="+", metavar="PATH", help="bags, or trajectories; see above")
    formulation = "how a step is written (default: a bag's setup's; rod)"
    option("--formulation", choices=("rod", "paper"), default="", help=formulation)
    option("--output", type=Path, metavar="DIR", help="folder to make: table.json, and a picture NAME.png of each PATH")
    table = "the table as a file: JSON, CSV or Parquet by the name's ending"
    option("--table", "--json", dest="json", type=command.output_file, metavar="FILE", help=table)
    bags = parser.add_argument_group("bags")
    against = "measured thread (seen) or ground truth (default: both where present, the picture by ground truth)"
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


def run_evaluate(options: argparse.Namespace, terminal: command.Terminal) -> int:
    """Score the thread model on bags, or on reference trajectories.

    Bags: the thread of each is predicted and estimated without a graph, as fast as the machine can, and compared with
    the measured centreline and, where the bag holds it, ground truth. PATH is an mcap or db3 file, the folder of a
    bag, or a folder of bags, which may be up to two folders below; or the URL of one, such as s3://BUCKET/RUNS. The
    table has a row for each bag, SI units and %. A bag that cannot be evaluated has its row too, with the problem in
    it; the exit code is 1 then. `replay --offline` writes poses, predictions and estimates as a bag.

    Reference trajectories: files DIR/*.npz with the needle's poses and the thread that followed (arrays t, pose, X and
    meta, as for `render`). The model starts from the first thread, is driven by the poses and nothing else, with each
    file's own thread and parameters, and is compared at every sample. Bags and trajectories need a call each.

    Errors are mean distances of the nodes in % of the thread's length.
    """
    is_bags = are_bags(options.paths)
    of_bags = ("setup", "against", "source", "remap", "frame", "start", "duration", "workers", "scheduler")
    for name in ("solver", "segments", "rig") if is_bags else of_bags:
        value = getattr(options, name)
        if value != options.default_of(name):
            why = "for reference trajectories; PATH is none" if is_bags else "for bags; PATH is a reference trajectory"
            raise ConfigurationError(f"--{name}", str(value), f"nothing: it is only {why}")
    if options.json is not None:
        tables.check_table(options.json)
    with terminal.progress("evaluate") as advance:
        if is_bags:
            names = ("paths", "output", "against", "formulation", "workers", "scheduler")
            selection = {**command.given(options, *names), **command.bag_selection(options)}
            rows = evaluate_bags(**selection, log=terminal.log, progress=advance)
            document, table = tables.bags_document(rows), bags_table(rows)
        else:
            evaluation = evaluate_references(options, terminal.log, advance)
            document, table = evaluation.to_mapping(), references_table(evaluation)
            rows = document["cases"]
    terminal.print(table)
    if options.json is not None:
        with whole_file(options.json) as file:
            tables.write_table(file, rows, document)
    for path in filter(None, (options.output, options.json)):
        terminal.log(f"results: {path}")
    return command.FAILED if any(row.get("problem") for row in rows) else command.DONE


def evaluate_bags(
    paths: Sequence[Path],
    output: Path | None = None,
    *,
    against: str = "auto",
    formulation: str = "",
    workers: int = 1,
    scheduler: str = "",
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
    **selection: Unpack[BagSelection],
) -> list[tables.Row]:
    """Evaluate bags, each for itself.

    A bag that cannot be evaluated has its row all the same, with the problem in it, and no picture. What is written
    does not depend on the number of workers, but for the times that steps took.

    Args:
        paths: bags, or folders of bags.
        output: folder to make, whole or not at all: NAME.png of each bag, and table.json; none if None.
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
    tasks = list(zip(bags, numbered([name_of(bag) for bag in bags], "{}-{}"), strict=True))
    work = partial(
        evaluate_one, against=against, formulation=formulation, selection=selection, is_drawn=output is not None
    )
    rows: list[tables.Row] = [{} for _ in tasks]
    with ExitStack() as stack:
        folder = stack.enter_context(whole_folder(output)) if output is not None else None
        runner = stack.enter_context(TaskRunner(work, workers, scheduler))
        for index, result in runner.run(tasks, log, progress):
            bag, name = tasks[index]
            row, picture = (_failed(bag, name, str(result)), b"") if isinstance(result, WorkerDiedError) else result
            if row["problem"]:
                log(f"{name}: {row['problem']}")
            if folder is not None and picture:
                (folder / f"{name}.png").write_bytes(picture)
            rows[index] = row
        if folder is not None:
            tables.write_table(folder / "table.json", rows, tables.bags_document(rows))
    return rows


def evaluate_one(
    task: tuple[Path, str],
    log: Log,
    progress: Progress,
    *,
    against: str,
    formulation: str,
    selection: BagSelection,
    is_drawn: bool,
) -> tuple[tables.Row, bytes]:
    """Return the row of a bag and its picture, empty if none is asked for; see `evaluate_bags`.

    With a problem in the row there is no picture: nothing stops the others.

    Args:
        task: path of the bag, and name of its row and picture.
        log: called with a line for a person.
        progress: called with the share done, 0 to 1.
        against: what predictions are compared with.
        formulation: of the model.
        selection: what of the bag is read.
        is_drawn: whether a picture is drawn.
    """
    path, name = task

    def log_named(text: str) -> None:
        log(f"{name}: {text}")

    try:
        with open_bag(path, log_named, **selection) as bag:
            recording, model = bag.recording, bag.setup.model
            model = replace(model, formulation=formulation or model.formulation)
            run = measure_run(bag, model, _targets(bag, against), progress)
            if run.remark:
                log_named(run.remark)
            row = tables.row_of(
                run.metrics,
                run.silence,
                recorded_latency(recording, bag.start, bag.duration),
                bag=name,
                path=one_line(str(recording.path)),
                setup=bag.setup.name,
                simulated=recording.notes.get("simulated", ""),
                source=bag.source,
                formulation=model.formulation,
                duration_s=bag.duration,
                damage="; ".join(map(str, recording.damage.regions)) if recording.damage else "",
                unverified=recording.salvaged_without_checksum,
                refused=sum(count for why, count in run.refused.items() if why != NOT_FOUND),
            )
            return row, draw_run(bag, run.metrics, log_named) if is_drawn else b""
    except MagnetosutureError as error:
        return _failed(path, name, str(error)), b""
    except Exception as error:  # A mistake of ours, or of a package: this bag's alone.
        return _failed(path, name, f"{type(error).__name__}: {error}"), b""


def _failed(path: Path, name: str, problem: str) -> tables.Row:
    return tables.failed_row(name, one_line(str(path)), one_line(" ".join(problem.split())))


def _targets(bag: BagInput, against: str) -> list[str]:
    """Return what the predictions are compared with.

    Raises:
        BagError: the bag does not hold it.
    """
    counts, targets = bag.recording.counts, []
    for target, channel in (("truth", interface.GROUND_TRUTH_THREAD), ("seen", interface.MEASURED_THREAD)):
        if counts.get(channel.recorded) or (target == "seen" and bag.source == "camera"):
            targets.append(target)
        elif against == target:
            raise BagError(bag.recording.path, f"has no messages on {channel.recorded} ({channel.type_name})")
    return [target for target in targets if against in ("auto", target)]


def name_of(bag: Path) -> str:
    """Return the name of a bag's row and picture: that of its folder or file."""
    path = bag if is_url(bag) else Path(os.path.abspath(bag))
    name = one_line(path.name if path.is_dir() else path.stem).lstrip(".") or "bag"
    return name.encode()[:200].decode("utf-8", "ignore")


def find_bags(paths: Iterable[Path]) -> list[Path]:
    """Return the bags at paths, in their order, each once; within a folder by name.

    Args:
        paths: bags, or folders that hold some, up to two folders below.

    Raises:
        BagError: a path holds none.
    """
    bags: dict[Path, Path] = {}
    for path in paths:
        inside = _bags(path, 2)
        if not inside:
            raise BagError(path, f"holds no bags ({' or '.join(interface.STORAGE_SUFFIXES)}), nor do the folders in it")
        for bag in inside:
            bags.setdefault(bag.resolve(), bag)
    return list(bags.values())


def _bags(path: Path, depth: int) -> list[Path]:
    try:
        inside = sorted(path.iterdir()) if path.is_dir() else []
        is_file = not inside and path.is_file()
        if not (inside or path.exists()):
            raise BagError(path, "does not exist; expected a bag, a folder of bags, or reference trajectories")
    except BagError:
        raise
    except Exception as error:  # The file system of a URL raises whatever its library does.
        raise BagError(path, f"cannot be read: {error}") from None
    if is_file or any(file.name == METADATA_FILE for file in inside):
        return [path]
    files = [file for file in inside if file.suffix in interface.STORAGE_SUFFIXES and file.is_file()]
    folders = [folder for folder in inside if depth > 0 and folder.is_dir() and not folder.name.startswith(".")]
    below = [bag for folder in folders for bag in _bags(folder, depth - 1)]
    if files and not below:
        with suppress(BagError):  # raised where the files are several bags
            find_bag_files(path)
            return [path]
    return files + below


def are_bags(paths: Sequence[Path]) -> bool:
    """Return whether paths are bags, and not reference trajectories.

    Raises:
        ConfigurationError: there are both.
    """
    references = [path for path in paths if _is_reference(path)]
    if 0 < len(references) < len(paths):
        expected = "bags alone, or reference trajectories alone, in one call"
        raise ConfigurationError("PATH", str(references[0]), expected)
    return not references


def _is_reference(path: Path) -> bool:
    """Return whether a path is a reference trajectory, or a folder of them, and no bag."""
    if is_url(path):
        return False
    try:
        return path.suffix == ".npz" if path.is_file() else any(path.glob("*.npz"))
    except OSError:
        return False


def evaluate_references(options: argparse.Namespace, log: Log, progress: Progress) -> reference.Evaluation:
    """Score reference trajectories as the options say; write table.json and a picture of each into --output, if any."""
    paths = [path for folder in options.paths for path in reference.find_references(folder)]
    settings: dict[str, Any] = {"segments": options.segments, "progress": progress}
    with ExitStack() as stack:
        folder = stack.enter_context(whole_folder(options.output)) if options.output is not None else None
        if options.rig:
            evaluation = reference.score_rig(paths, **settings)
        else:
            formulation, solver = options.formulation or "rod", options.solver or "banded"
            evaluation = reference.score(paths, formulation=formulation, solver=solver, **settings)
        if folder is not None:
            document = evaluation.to_mapping()
            tables.write_table(folder / "table.json", document["cases"], document)
            for case in evaluation.results:
                if picture := picture_or_log(partial(_draw_case, case, evaluation.formulation), log):
                    (folder / f"{one_line(case.score.name).replace('/', '_')}.png").write_bytes(picture)
    return evaluation


def _draw_case(case: reference.CaseResult, formulation: str) -> bytes:
    from magnetosuture_thread.evaluation.plots import draw_metrics  # late, as it imports matplotlib

    diameter = 2.1 * float(np.abs(case.reference.threads).max())
    return draw_metrics(case.metrics, f"{case.score.name}, formulation {formulation}", diameter)


def bags_table(rows: Sequence[Any]) -> Any:
    """Return the table of bags for a terminal: the figures that matter most, of estimate and prediction."""
    columns = ("bag", "frames", "truth", "max", "measured", "max", "margin", "step")
    # What is said of a bag, by the column that is not empty.
    marks = {"simulated": "* simulated", "unverified": "? unverified", "silences": "! frames are missing"}
    cells: list[Sequence[str]] = []
    for row in rows:
        name = " ".join([str(row["bag"]), *(mark[0] for column, mark in marks.items() if row[column])])
        if row["problem"]:
            cells.append((name, "failed"))
            continue
        frames = f"{row['predicted']}/{row['frames']}"
        margin, step = _number(row["least_obstacle_m"], 1e6, " µm"), _number(row["step_median_s"], 1e3, " ms")
        cells += [
            (name, frames, *_errors(row["estimate"]), margin, step),
            ("  predicted", "", *_errors(row["prediction"])),
        ]
    if len(rows) > 1:
        of_all = tables.compare_bags(rows)
        cells += [("all bags", "", *_errors(of_all["estimate"])), ("  predicted", "", *_errors(of_all["prediction"]))]
    caption = (
        "errors in % of the length, mean and maximum over time; margin: least clearance of an obstacle, chords too"
    )
    caption += "".join(f"; {mark}" for column, mark in marks.items() if any(row[column] for row in rows))
    silences = [(row["silent_s"], row["max_silence_s"]) for row in rows if row["silences"]]
    if silences:
        total, longest = sum(silent for silent, _ in silences), max(gap for _, gap in silences)
        caption += f" for {total:.1f} s, {longest:.1f} s at the longest"
    return command.make_table("1 bag" if len(rows) == 1 else f"{len(rows)} bags", columns, cells, caption)


def _errors(errors: Any) -> list[str]:
    names = (f"error_{of}_{which}_percent" for of in ("ground_truth", "measured") for which in ("mean", "max"))
    return [_number(errors[name]) for name in names]


def _number(value: Any, scale: float = 1.0, unit: str = "") -> str:
    return "" if value is None else f"{scale * value:.3g}{unit}"


def references_table(evaluation: reference.Evaluation) -> Any:
    """Return the scores of a set of trajectories as a table for a terminal."""
    columns = ("case", "error", "max", "stretch [%]", "depth [m]", "step [µs]", "p99")
    cells: list[Sequence[str]] = []
    for case in evaluation.cases:
        errors = (case.mean_error_percent, case.max_error_percent, 100.0 * case.max_stretch)
        depth = f"{case.max_penetration_m:.0e}" if case.max_penetration_m else "none"
        times = (f"{1e6 * time:.0f}" for time in (case.step_median_s, case.step_p99_s))
        cells.append((case.name, *(f"{value:.3f}" for value in errors), depth, *times))
    cells.append(("mean of the cases", f"{evaluation.mean_error_percent:.3f}"))
    cells.append(("worst case", f"{evaluation.worst_error_percent:.3f}"))
    residual = max(case.max_residual for case in evaluation.cases)
    marked = sum(case.fallbacks for case in evaluation.cases)
    caption = (
        "errors in % of the length, mean and maximum over time; depth of a node in an obstacle; "
        f"step: wall clock, median; largest residual {residual:.0e}, {marked} steps fell back or did not converge"
    )
    title = f"formulation {evaluation.formulation}, solver {evaluation.solver}"
    return command.make_table(title, columns, cells, caption)
