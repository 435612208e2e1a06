"""The tables of a catalog: what a process that is ended loses, and what a query gets."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from magnetosuture_thread.catalog.query import query_catalog
from magnetosuture_thread.catalog.tables import Catalog
from magnetosuture_thread.errors import BagError, ConfigurationError


def bag(name: str, version: str = "1", **figures: object) -> dict[str, object]:
    """Return the row of a bag."""
    return {"bag": name, "path": f"/runs/{name}", "version": version, "problem": "", **figures}


def seconds(count: int) -> list[dict[str, object]]:
    """Return rows of seconds."""
    return [{"second": second, "frames": 30, "predicted": 29, "error_truth_percent": 0.1} for second in range(count)]


@pytest.fixture
def catalog(tmp_path: Path) -> Catalog:
    """Return an empty catalog, in a folder with a name that SQL must quote."""
    folder = tmp_path / "it's"
    folder.mkdir()
    return Catalog(folder / "catalog.parquet")


def paths(catalog: Catalog) -> list[str]:
    """Return the paths of the bags in the tables, and check that seconds have no others."""
    _, rows = query_catalog(catalog.file, "SELECT path FROM bags ORDER BY path")
    _, others = query_catalog(
        catalog.file, "SELECT DISTINCT path FROM seconds WHERE path NOT IN (SELECT path FROM bags)"
    )
    assert not others
    return [path for (path,) in rows]


def test_bags_are_added_replaced_and_dropped(catalog: Catalog):
    catalog.append(bag("one", error_truth_mean_percent=0.5), seconds(3))
    catalog.append(bag("two"), seconds(2))
    catalog.append(bag("three"), [])
    assert catalog.known() == {"/runs/one": "1", "/runs/two": "1", "/runs/three": "1"}
    catalog.write([])
    assert not catalog.journal.exists()
    catalog.append(bag("one", "2"), seconds(1))
    catalog.append(bag("one", "3", error_truth_mean_percent=0.25), seconds(1))
    assert catalog.known()["/runs/one"] == "3"
    catalog.write(["/runs/two"])
    assert paths(catalog) == ["/runs/one", "/runs/three"]
    columns, rows = query_catalog(
        catalog.file,
        "SELECT path, version, error_truth_mean_percent, count(second) AS n FROM bags LEFT JOIN seconds USING (path)"
        " GROUP BY ALL ORDER BY path",
    )
    assert columns == ["path", "version", "error_truth_mean_percent", "n"]
    assert rows == [("/runs/one", "3", 0.25, 1), ("/runs/three", "1", None, 0)]
    assert sorted(path.name for path in catalog.file.parent.iterdir()) == ["catalog.parquet", "catalog.seconds.parquet"]


@pytest.mark.parametrize("cut", [1, 100, 700])
def test_half_a_line_at_the_end_of_the_journal_is_lost_and_no_other(catalog: Catalog, cut: int):
    catalog.append(bag("one"), seconds(3))
    whole = catalog.journal.stat().st_size
    catalog.append(bag("two"), seconds(3))
    data = catalog.journal.read_bytes()
    assert len(data) - cut > whole
    catalog.journal.write_bytes(data[:-cut])
    assert catalog.known() == {"/runs/one": "1"}
    catalog.append(bag("two", "2"), seconds(3))
    assert [json.loads(line)["bag"]["version"] for line in catalog.journal.read_text().splitlines()] == ["1", "2"]
    catalog.write([])
    assert paths(catalog) == ["/runs/one", "/runs/two"]


def test_ended_between_the_two_tables_or_before_the_journal_is_deleted_it_is_done_again(
    catalog: Catalog, monkeypatch: pytest.MonkeyPatch
):
    catalog.append(bag("one"), seconds(2))
    catalog.write([])
    catalog.append(bag("one", "2"), seconds(3))
    catalog.append(bag("two"), seconds(1))
    kept = catalog.journal.read_bytes()

    def end(path: Path, missing_ok: bool = False) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", end)
        with pytest.raises(KeyboardInterrupt):
            catalog.write([])
    assert catalog.journal.read_bytes() == kept
    assert catalog.known() == {"/runs/one": "2", "/runs/two": "1"}
    catalog.write([])
    assert paths(catalog) == ["/runs/one", "/runs/two"]
    assert query_catalog(catalog.file, "SELECT count(*) FROM seconds")[1] == [(4,)]


def test_an_hour_of_one_bag_is_a_line_that_is_read(catalog: Catalog):
    catalog.append(bag("long"), seconds(10 * 3600))
    catalog.write([])
    assert query_catalog(catalog.file, "SELECT count(*) FROM seconds")[1] == [(36000,)]


def test_what_is_wrong_is_one_line(catalog: Catalog):
    with pytest.raises(BagError, match=r"does not exist; `magnetosuture catalog"):
        query_catalog(catalog.file, "SELECT 1")
    catalog.append(bag("one"), [])
    catalog.write([])
    with pytest.raises(ConfigurationError, match="SQL of DuckDB"):
        query_catalog(catalog.file, "SELECT nothing FROM bags")
    with pytest.raises(ConfigurationError, match=r"ends with \.parquet"):
        Catalog(catalog.file.with_suffix(".csv"))
    catalog.file.write_text("no table")
    with pytest.raises(BagError, match="no catalog that can be used"):
        catalog.known()
