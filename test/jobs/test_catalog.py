"""The job and the command `catalog`: an index of bags, brought up to date."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import fsspec
import pytest

from magnetosuture_thread import cli
from magnetosuture_thread.catalog.query import query_catalog
from magnetosuture_thread.evaluation.tables import TIMES
from magnetosuture_thread.files import parse_location
from magnetosuture_thread.jobs import catalog as job
from magnetosuture_thread.jobs.catalog import CatalogUpdate, update_catalog
from magnetosuture_thread.jobs.evaluate import evaluate_bags
from magnetosuture_thread.workers import WorkerDiedError


@pytest.fixture
def root(tmp_path: Path, short_bag: Path) -> Path:
    """Return a folder with two bags, at different depths, and one that cannot be read."""
    root = tmp_path / "runs"
    shutil.copytree(short_bag, root / "pull")
    shutil.copytree(short_bag, root / "a" / "b" / "c" / "again")
    (root / "broken.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    return root


def rows(file: Path, sql: str) -> list[tuple[Any, ...]]:
    """Return the rows that a query gives."""
    return query_catalog(file, sql)[1]


def test_a_catalog_has_the_figures_of_evaluate_and_is_brought_up_to_date(root: Path, tmp_path: Path):
    file = tmp_path / "catalog.parquet"
    assert update_catalog(root, file, workers=2) == CatalogUpdate(unchanged=0, added=3, failed=1, gone=0)
    columns, found = query_catalog(file, "SELECT * FROM bags WHERE problem = '' AND bag = 'pull'")
    row = dict(zip(columns, found[0], strict=True))
    (evaluated,) = evaluate_bags([root / "pull"], tmp_path / "out")
    other = (*TIMES, "path")
    plain = {name: value for name, value in evaluated.items() if name not in other and not isinstance(value, dict)}
    assert {name: row[name] for name in plain} == plain
    assert (row["material"], row["scene"], row["thread_length_m"]) == ("polyamide_7_0", "", 0.019)
    assert row["path"] == str(root / "pull")
    assert row["bytes"] == sum(path.stat().st_size for path in (root / "pull").iterdir())
    ((problem,),) = rows(file, "SELECT problem FROM bags WHERE bag = 'broken'")
    assert "nothing intact" in problem
    assert rows(file, "SELECT sum(frames), sum(predicted), min(second), max(second) FROM seconds") == [(60, 56, 0, 0)]

    before = file.read_bytes()
    assert update_catalog(root, file) == CatalogUpdate(unchanged=3, added=0, failed=0, gone=0)
    assert file.read_bytes() == before
    os.utime(next((root / "pull").glob("*.mcap")))
    shutil.rmtree(root / "a")
    assert update_catalog(root, file) == CatalogUpdate(unchanged=1, added=1, failed=0, gone=1)
    assert rows(file, "SELECT bag FROM bags ORDER BY bag") == [("broken",), ("pull",)]
    assert rows(file, "SELECT DISTINCT path FROM seconds") == [(str(root / "pull"),)]


def test_what_was_done_before_an_end_is_not_done_again(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    file = tmp_path / "catalog.parquet"
    done: list[str] = []
    figures_of = job._figures_of

    def ended_after_one(task: Any, *others: Any) -> Any:
        if done:
            raise KeyboardInterrupt
        done.append(str(task.path))
        return figures_of(task, *others)

    with monkeypatch.context() as patch:
        patch.setattr(job, "_figures_of", ended_after_one)
        with pytest.raises(KeyboardInterrupt):
            update_catalog(root, file)
    assert not file.exists()
    assert done == [str(root / "broken.mcap")]
    assert update_catalog(root, file) == CatalogUpdate(unchanged=1, added=2, failed=0, gone=0)
    assert rows(file, "SELECT count(*), count(DISTINCT path) FROM bags") == [(3, 3)]


def test_a_bag_that_ends_its_worker_is_tried_again(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    file = tmp_path / "catalog.parquet"
    with monkeypatch.context() as patch:
        patch.setattr(job, "_figures_of", lambda *given: WorkerDiedError("its process ended with -9"))
        assert update_catalog(root, file).failed == 3
    assert rows(file, "SELECT DISTINCT problem FROM bags") == [("its process ended with -9",)]
    assert update_catalog(root, file) == CatalogUpdate(unchanged=0, added=3, failed=1, gone=0)


class UnreachableError(Exception):
    """What a library of a file system raises, for example botocore's, which is no `OSError`."""


@pytest.mark.parametrize("error", [OSError(5, "Input/output error"), UnreachableError("could not connect")])
def test_a_bag_that_could_not_be_read_is_tried_again(
    error: Exception, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    file = tmp_path / "catalog.parquet"
    fsspec.filesystem("memory").put(str(root), f"/{tmp_path.name}", recursive=True)
    place = parse_location(f"memory://{tmp_path.name}")

    def fail(path: Path) -> Any:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr("magnetosuture_thread.bags.mcap.file.open_ranges", fail)
        assert update_catalog(place, file) == CatalogUpdate(unchanged=0, added=3, failed=3, gone=0)
    assert rows(file, f"SELECT count(*) FROM bags WHERE problem LIKE '%{error.args[-1]}%'") == [(3,)]
    assert update_catalog(place, file) == CatalogUpdate(unchanged=0, added=3, failed=1, gone=0)
    assert update_catalog(place, file) == CatalogUpdate(unchanged=3, added=0, failed=0, gone=0)


def test_another_version_of_the_package_evaluates_all_bags_again(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    file = tmp_path / "catalog.parquet"
    update_catalog(root, file)
    monkeypatch.setattr(job, "__version__", "0.0.1")
    assert update_catalog(root, file) == CatalogUpdate(unchanged=0, added=3, failed=1, gone=0)
    assert update_catalog(root, file) == CatalogUpdate(unchanged=3, added=0, failed=0, gone=0)


def test_bags_by_url_are_catalogued_with_those_of_this_machine(root: Path, tmp_path: Path):
    file = tmp_path / "catalog.parquet"
    fsspec.filesystem("memory").put(str(root), "/fleet", recursive=True)
    update_catalog(root, file)
    assert update_catalog(parse_location("memory://fleet"), file) == CatalogUpdate(0, 3, 1, 0)
    assert update_catalog(parse_location("memory://fleet"), file) == CatalogUpdate(3, 0, 0, 0)
    here, there = (
        rows(
            file,
            f"SELECT bag, setup, frames, error_truth_mean_percent FROM bags WHERE path LIKE '{place}%' ORDER BY bag",
        )
        for place in ("memory://", str(root))
    )
    assert here == there
    assert len(here) == 3


def test_the_command_updates_asks_and_refuses(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = str(tmp_path / "catalog.parquet")
    assert cli.main(["catalog", str(root), "--output", file]) == 1
    assert "3 bags added" in capsys.readouterr().out
    query = ["--query", "SELECT bag, frames FROM bags WHERE problem = '' ORDER BY bag"]
    assert cli.main(["catalog", str(root), "--output", file, *query]) == 0
    shown = capsys.readouterr().out
    assert shown.index("again") < shown.index("pull")
    assert cli.main(["catalog", str(root), "--output", file, "--query", "SELECT x FROM bags"]) == 2
    assert "SQL of DuckDB" in capsys.readouterr().err
    assert cli.main(["catalog", str(tmp_path / "none"), "--output", file]) == 1
    assert "does not exist" in capsys.readouterr().err
