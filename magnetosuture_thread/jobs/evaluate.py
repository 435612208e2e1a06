"""The job `magnetosuture evaluate` on bags: a page for each, and a table over all."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from magnetosuture_thread import ConfigurationError, MagnetosutureError
from magnetosuture_thread.bags.storage import METADATA_FILE, find_bag_files
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.evaluation.tables import Row, failed_row, flat, table_csv, table_json
from magnetosuture_thread.files import is_url
from magnetosuture_thread.interface import STORAGE_SUFFIXES
from magnetosuture_thread.jobs.evaluate_bag import evaluate_bag
from magnetosuture_thread.jobs.output import whole_folder, write_parquet
from magnetosuture_thread.jobs.replay_inputs import BagSelection, Log, Progress
from magnetosuture_thread.jobs.track import numbered
from magnetosuture_thread.setups import read_setup
from magnetosuture_thread.texts import one_line
from magnetosuture_thread.workers import WorkerDiedError, make_runner

if TYPE_CHECKING:
    from typing_extensions import Unpack

DEPTH = 2  # folders below the one that is given
MAX_NAME_BYTES = 200  # bytes


@dataclass(frozen=True)
class Task:
    """A bag to evaluate.

    Attributes:
        path: of the bag.
        name: of its report.
        against: what predictions are compared with.
        formulation: of the model.
        selection: what of the bag is read.
    """

    path: Path
    name: str
    against: str
    formulation: str
    selection: BagSelection


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
    rows: dict[int, Row] = {}
    with whole_folder(output) as folder:
        tasks = [Task(bag, name, against, formulation, selection) for bag, name in zip(bags, names, strict=True)]
        with make_runner(evaluate_one, workers, scheduler) as runner:
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
        write_parquet(folder / "table.parquet", [flat(row) for row in ordered])
    return ordered


def evaluate_one(task: Task, log: Log, progress: Progress) -> tuple[Row, str]:
    """Return the row of a bag and its page; with a problem in the row, there is no page: nothing stops the others."""
    try:
        return evaluate_bag(**vars(task), log=lambda text: log(f"{task.name}: {text}"), progress=progress)
    except MagnetosutureError as error:
        return _failed(task, str(error)), ""
    except Exception as error:  # A mistake of ours, or of a package: this bag's alone.
        return _failed(task, f"{type(error).__name__}: {error}"), ""


def _failed(task: Task, problem: str) -> Row:
    return failed_row(task.name, one_line(str(task.path)), one_line(" ".join(problem.split())))


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
            raise BagError(
                path, f"holds no bags ({endings}), nor do the folders in it" if path.is_dir() else "is no bag"
            )
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
