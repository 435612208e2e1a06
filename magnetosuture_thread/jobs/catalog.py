"""The job `magnetosuture catalog`: an index of all bags below a folder or URL, brought up to date."""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any

from magnetosuture_thread import MagnetosutureError, __version__
from magnetosuture_thread.bags.bag_folder import METADATA_FILE
from magnetosuture_thread.catalog.series import second_rows
from magnetosuture_thread.catalog.tables import Catalog
from magnetosuture_thread.evaluation.tables import failed_row, flat, row_of
from magnetosuture_thread.files import is_url, version_of
from magnetosuture_thread.interface import STORAGE_SUFFIXES
from magnetosuture_thread.jobs.evaluate import find_bags, name_of
from magnetosuture_thread.jobs.evaluate_bag import measure_bag
from magnetosuture_thread.jobs.replay_inputs import BagInput, Log, Progress, open_bag
from magnetosuture_thread.texts import one_line
from magnetosuture_thread.workers import WorkerDiedError, make_runner

DEPTH = 64  # folders below ROOT in which bags are looked for


@dataclass(frozen=True)
class CatalogUpdate:
    """What an update of a catalog did.

    Attributes:
        unchanged: bags that were in it already.
        added: bags that are new or have changed, or could not be read the last time.
        failed: of these, the bags that cannot be evaluated; their rows say why.
        gone: bags that were in it and are no longer there.
    """

    unchanged: int
    added: int
    failed: int
    gone: int


@dataclass(frozen=True)
class _Task:
    """A bag to add.

    Attributes:
        path: of the bag.
        version: of its files and of this package.
        size: of its files [bytes].
    """

    path: Path
    version: str
    size: int


def update_catalog(
    root: Path,
    output: Path,
    *,
    workers: int = 1,
    scheduler: str = "",
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
) -> CatalogUpdate:
    """Bring a catalog up to date: add bags that are new or have changed, drop those that are gone.

    A bag has changed where the name, size or time of change of one of its files has (of a URL the ETag); another
    version of this package evaluates all anew. A bag whose worker ended, or whose file system or network failed, is
    tried again by the next update. Whatever ends this process, what was done stays, and the next update goes on from
    there.

    Args:
        root: folder or URL with the bags, in itself or in folders below.
        output: the table of bags (.parquet); bags in it that are not below `root` stay.
        workers: processes.
        scheduler: address of a Dask scheduler, whose workers read the bags in place of those.
        log: called with a line for a person.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: there are no bags, or a file of the catalog cannot be read or written.
    """
    catalog = Catalog(output)
    place = root if is_url(root) else root.resolve()
    known = catalog.known()
    tasks, paths = [], set()
    for bag in find_bags([place], DEPTH):
        version, size = _version(bag)
        paths.add(str(bag))
        if known.get(str(bag)) != version:
            tasks.append(_Task(bag, version, size))
    gone = {path for path in known if path not in paths and _is_below(path, str(place))}
    log(f"{len(paths)} bags, {len(tasks)} of them new or changed; {len(gone)} gone")
    failed = 0
    with make_runner(_figures_of, workers, scheduler) as runner:
        for index, result in runner.run(tasks, log, progress):
            task = tasks[index]
            row, seconds = (_failed(task, str(result), ""), []) if isinstance(result, WorkerDiedError) else result
            if row["problem"]:
                failed += 1
                log(f"{task.path}: {row['problem']}")
            catalog.append(row, seconds)
    catalog.write(gone)
    return CatalogUpdate(len(paths) - len(tasks), len(tasks), failed, len(gone))


def _is_below(path: str, root: str) -> bool:
    return path == root or path.startswith(root.rstrip("/") + "/")


def _version(bag: Path) -> tuple[str, int]:
    """Return what changes with the files of a bag and with this package, and the files' size in bytes."""
    inside = [bag] if bag.is_file() else sorted(bag.iterdir(), key=lambda path: path.name)
    files = [path for path in inside if path.name.endswith((*STORAGE_SUFFIXES, METADATA_FILE))]
    found = [(path.name, *version_of(path)) for path in files]
    digest = blake2b(repr((__version__, found)).encode(), digest_size=12).hexdigest()
    return digest, sum(size for _, size, _ in found)


def _figures_of(task: _Task, log: Log, progress: Progress) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the row of a bag, and those of its seconds; with a problem in the row where there is one."""
    try:
        with open_bag(task.path, lambda text: None) as given:
            measured = measure_bag(given, name_of(task.path), "auto", "", progress)
            row = {**flat(row_of(measured.about, measured.figures)), **_facts(given), **_facts_of_files(task)}
            return row, second_rows(measured.metrics)
    except Exception as error:  # A mistake of ours, or of a package, is this bag's alone too.
        problem = str(error) if isinstance(error, MagnetosutureError) else f"{type(error).__name__}: {error}"
        return _failed(task, problem, "" if _may_pass(error, task.path) else task.version), []


def _may_pass(error: BaseException | None, bag: Path) -> bool:
    """Return whether a file system or a network failed, so that the same bag may be readable the next time."""
    while isinstance(error, MagnetosutureError):
        error = error.__cause__
    # The file system of a URL raises whatever its library does.
    return isinstance(error, OSError) or (error is not None and is_url(bag))


def _failed(task: _Task, problem: str, version: str) -> dict[str, Any]:
    """Return the row of a bag with a problem; with an empty version the next update tries it again."""
    row = flat(failed_row(name_of(task.path), str(task.path), one_line(" ".join(problem.split()))))
    return {**row, **_facts_of_files(task), "version": version}


def _facts_of_files(task: _Task) -> dict[str, Any]:
    return {"version": task.version, "bytes": task.size}


def _facts(given: BagInput) -> dict[str, Any]:
    model, scene = given.setup.model, given.setup.scene
    return {
        "path": str(given.recording.path),
        "material": model.material,
        "thread_length_m": model.thread_length,
        "segments": model.segments,
        "scene": ", ".join(shape.name for shape in scene.shapes),
        "dish_diameter_m": scene.dish.diameter,
        "recorded_at_ns": given.recording.start,
    }
