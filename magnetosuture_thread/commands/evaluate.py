"""The command `magnetosuture evaluate`: a page for each bag and a table over all, or scores of trajectories."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from magnetosuture_thread import ConfigurationError, MagnetosutureError
from magnetosuture_thread.bags.storage import METADATA_FILE, find_bag_files
from magnetosuture_thread.commands.command import (
    DONE,
    FAILED,
    Terminal,
    add_source,
    add_span,
    add_workers,
    bag_location,
    bag_selection,
    count_argument,
    output_file,
    runs,
    write_json,
)
from magnetosuture_thread.commands.evaluate_bag import EvaluationTask, evaluate_bag
from magnetosuture_thread.commands.output import whole_folder
from magnetosuture_thread.commands.recorded import BagSelection
from magnetosuture_thread.commands.track import numbered
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.evaluation.plots import draw_case
from magnetosuture_thread.evaluation.reference import (
    NOT_ONE,
    CaseResult,
    Evaluation,
    ReferenceTrajectory,
    StepFigures,
    find_references,
    run_case,
    score,
    score_each,
)
from magnetosuture_thread.evaluation.tables import (
    Row,
    bags_table,
    evaluation_table,
    failed_row,
    flat,
    table_csv,
    table_json,
)
from magnetosuture_thread.files import is_url
from magnetosuture_thread.interface import STORAGE_SUFFIXES
from magnetosuture_thread.rig.mechanics.dynamics import NeedleJoint, RigDynamics, Surface, ThreadProperties
from magnetosuture_thread.rig.mechanics.needle import NeedleBody
from magnetosuture_thread.setups import read_setup
from magnetosuture_thread.texts import one_line
from magnetosuture_thread.workers import Log, Progress, WorkerDiedError, make_runner

if TYPE_CHECKING:
    from typing_extensions import Unpack

DEPTH = 2  # folders below the one that is given
MAX_NAME_BYTES = 200
BAG_OPTIONS = ("output", "setup", "against", "source", "remap", "frame", "start", "duration", "workers", "scheduler")
REFERENCE_OPTIONS = ("solver", "segments", "rig", "json", "pictures")
NEEDLE_BODY = NeedleBody(length=7e-3, diameter=4e-4, curvature=0.0, magnetisation=0.0, viscosity=1.0)
"""Of a needle whose motion is given, the body does not matter."""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    runs(parser, run_evaluate)
    parser.set_defaults(default_of=parser.get_default)
    parser.add_argument("paths", type=bag_location, nargs="+", metavar="PATH", help="bags, or trajectories; see above")
    formulation = "how a step is written (default: a bag's setup's; rod)"
    parser.add_argument("--formulation", choices=("rod", "paper"), help=formulation)
    bags = parser.add_argument_group("bags")
    option = bags.add_argument
    option("--output", type=Path, metavar="DIR", help="folder to make; required")
    against = "measured thread (seen) or ground truth (default: both where present, the worst frames by ground truth)"
    option("--against", choices=("auto", "truth", "seen"), default="auto", help=against)
    add_source(bags, "each bag")
    add_span(bags, "each bag")
    add_workers(bags)
    option = parser.add_argument_group("reference trajectories").add_argument
    option("--solver", choices=("banded", "osqp"), help="what solves a step (default: banded)")
    segments = "number of segments (default: the paper's, as each file says)"
    option("--segments", type=count_argument("segments", 3, 2000), metavar="N", help=segments)
    rig = "score the simulated rig's thread instead of the model (default: N = 100)"
    option("--rig", action="store_true", help=rig)
    option("--json", type=output_file, metavar="FILE", help="write the figures to a file")
    option("--pictures", type=Path, metavar="FOLDER", help="draw each case into a folder")


def run_evaluate(options: argparse.Namespace, terminal: Terminal) -> int:
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
    if is_bags and options.output is None:
        raise ConfigurationError("--output", None, "a folder to make, as PATH is a bag")
    with terminal.progress("evaluate") as advance:
        if not is_bags:
            evaluation = _score_references(options, advance)
        else:
            rows = evaluate_bags(
                options.paths,
                options.output,
                against=options.against,
                formulation=options.formulation or "",
                workers=options.workers,
                scheduler=options.scheduler,
                log=terminal.log,
                progress=advance,
                **bag_selection(options),
            )
    if not is_bags:
        terminal.print(evaluation_table(evaluation))
        write_json(options.json, evaluation.to_mapping())
        return DONE
    terminal.print(bags_table(rows))
    terminal.log(f"results: {options.output}")
    return FAILED if any(row["problem"] for row in rows) else DONE


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
    **selection: Unpack[BagSelection],
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
        (folder / "table.csv").write_text(table_csv(ordered), encoding="utf-8", newline="")
        (folder / "table.json").write_text(table_json(ordered), encoding="utf-8")
        if problem := write_parquet(folder / "table.parquet", [flat(row) for row in ordered]):
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
    return failed_row(task.name, one_line(str(task.path)), one_line(" ".join(problem.split())))


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
    return name.encode()[:MAX_NAME_BYTES].decode("utf-8", "ignore")


def find_bags(paths: Sequence[Path], depth: int = DEPTH) -> list[Path]:
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
        if not bags:
            endings = " or ".join(STORAGE_SUFFIXES)
            folder = f"holds no bags ({endings}), nor do the folders in it"
            raise BagError(path, folder if path.is_dir() else "is no bag")
        for bag in bags:
            found.setdefault(bag.resolve(), bag)
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
    files = [file for file in inside if file.suffix in STORAGE_SUFFIXES and file.is_file()]
    if any(file.name == METADATA_FILE for file in inside):
        return [path]
    folders = [folder for folder in inside if depth > 0 and folder.is_dir() and not folder.name.startswith(".")]
    below = [bag for folder in folders for bag in _bags(folder, depth - 1)]
    if not below and (len(files) == 1 or (files and _is_one(path))):
        return [path]
    return files + below


def _is_one(path: Path) -> bool:
    """Return whether the files in a folder are parts of one bag."""
    try:
        find_bag_files(path)
    except BagError:
        return False
    return True


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


def _score_references(options: argparse.Namespace, progress: Progress) -> Evaluation:
    paths = [path for folder in options.paths for path in find_references(folder)]
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
    formulation = options.formulation or "rod"

    def keep(case: CaseResult) -> None:
        if options.pictures:
            name = "rig" if options.rig else formulation
            draw_case(options.pictures / f"{case.score.name}.png", case, name)

    given: dict[str, Any] = {"segments": options.segments, "progress": progress, "keep": keep}
    if options.rig:
        return score_rig(paths, **given)
    return score(paths, formulation=formulation, solver=options.solver or "banded", **given)


def score_rig(
    paths: Sequence[Path],
    segments: int | None = None,
    progress: Progress = lambda share: None,
    keep: Callable[[CaseResult], None] = lambda result: None,
) -> Evaluation:
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

    def score_case(reference: ReferenceTrajectory, path: Path, share: Progress) -> CaseResult:
        thread = _rig_thread(reference, path, count)
        first, length = reference.threads[0], thread.length
        if np.ptp(first, axis=0).max() == 0.0 or np.linalg.norm(first[0] - reference.tails[0]) > 0.1 * length / count:
            raise BagError(path, "has a first thread of one point, or one that does not begin at the needle's tail")
        if thread.diameter >= length:
            raise BagError(path, f"has a thread of {thread.diameter:g} m in diameter, expected less than its length")
        surface, heading = Surface(discs=reference.discs), float(reference.headings[0])
        rig = RigDynamics(NEEDLE_BODY, thread, surface, None, reference.tails[0], heading, first)
        speed = np.linalg.norm(np.diff(reference.tails, axis=0), axis=1) / np.diff(reference.times)
        force = thread.drag_across * length * max(float(speed.max()), 1e-6)

        def step(index: int) -> RigDynamics:
            interval = reference.times[index] - reference.times[index - 1]
            rig.drive(reference.tails[index], float(reference.headings[index]), interval)
            return rig

        def figures(rig: RigDynamics) -> StepFigures:
            strain = max(0.0, float(rig.tension.max()) / thread.stretching_stiffness)
            return StepFigures(rig.thread, strain, rig.residual / force, rig.halvings)

        return run_case(reference, rig.thread, length, thread.diameter, step, figures, share)

    return Evaluation("rig", "newton", score_each(paths, score_case, progress, keep))


def _rig_thread(reference: ReferenceTrajectory, path: Path, segments: int) -> ThreadProperties:
    """Return the thread that a trajectory's metadata describes.

    Raises:
        BagError: the metadata lacks something, or holds what is none.
    """
    names = ("L_m", "EI_Nm2", "EA_N", "zeta_perp_Pa_s", "zeta_par_Pa_s", "diameter_m")
    try:
        given = reference.metadata["material"]
        length, bending, stretching, across, along, diameter = values = [float(given[name]) for name in names]
        attachment = {"pinned": NeedleJoint.PINNED, "clamped": NeedleJoint.CLAMPED}[reference.metadata["boundary"]]
    except NOT_ONE as error:
        raise BagError(path, f"has no thread in its metadata: {type(error).__name__} {error}") from None
    if not all(math.isfinite(value) and value > 0.0 for value in values):
        raise BagError(path, f"has a thread with one of {', '.join(names)} not positive")
    return ThreadProperties(length, segments, bending, stretching, across, along, attachment, diameter=diameter)
