"""The page of a catalog: what it serves, to whom, and what a browser makes of it."""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path

import pytest
from playwright.sync_api import expect, sync_playwright

from magnetosuture_thread.errors import BagError
from magnetosuture_thread.jobs.catalog import update_catalog
from magnetosuture_thread.jobs.catalog_page import make_page_server


@pytest.fixture
def port(tmp_path: Path, short_bag: Path) -> Iterator[int]:
    """Return the port of the page of two bags, one of which is gone, and one that cannot be evaluated."""
    root = tmp_path / "runs"
    for name in ("a_pull", "b_gone"):
        shutil.copytree(short_bag, root / name)
    (root / "c").mkdir()
    (root / "c" / "<img src=x>.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    update_catalog(root, tmp_path / "catalog.parquet")
    shutil.rmtree(root / "b_gone")
    with make_page_server(tmp_path / "catalog.parquet", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server.server_port
        server.shutdown()
        thread.join()


def fetch(port: int, path: str, host: str = "") -> tuple[int, str]:
    """Return code and text of an answer."""
    connection = HTTPConnection("127.0.0.1", port, timeout=60)
    connection.request("GET", path, headers={"Host": host} if host else {})
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, text


def test_it_serves_bags_and_reports_to_a_browser_of_this_machine_alone(port: int):
    code, text = fetch(port, "/bags.json")
    table = json.loads(text)
    names = [row[table["columns"].index("bag")] for row in table["rows"]]
    assert (code, names) == (200, ["a_pull", "b_gone", "c"])
    assert fetch(port, "/", f"localhost:{port}")[0] == 200
    code, report = fetch(port, "/report/0")
    assert code == 200
    assert "28 of 30" in report
    assert [fetch(port, f"/report/{number}")[0] for number in (1, 2)] == [500, 500]
    assert "does not exist" in fetch(port, "/report/1")[1]
    code, text = fetch(port, "/seconds/0.json")
    table = json.loads(text)
    assert (code, [row[table["columns"].index("second")] for row in table["rows"]]) == (200, [0])
    assert set(json.loads(fetch(port, "/series.json")[1])) | {"second"} == set(table["columns"])
    assert json.loads(fetch(port, "/seconds/2.json")[1])["rows"] == []
    for path in (
        "/seconds/3.json",
        "/seconds/0",
        "/seconds/.json",
        "/report/3",
        "/report/-1",
        "/report/x",
        "/report/",
        "/../catalog.parquet",
        "/catalog.parquet",
    ):
        assert fetch(port, path)[0] == 404
    for path in ("/", "/bags.json", "/report/0"):
        assert fetch(port, path, f"elsewhere.example:{port}") == (403, "for a browser on this machine only")


def test_a_browser_lists_and_plots_the_bags_and_their_seconds(port: int):
    path = shutil.which("chromium")
    if path is None:
        pytest.skip("no chromium is installed; CI installs one")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{port}/")
        expect(page.locator("#count")).to_have_text("3 of 3 bags")
        expect(page.locator("#plot circle")).to_have_count(2)
        expect(page.locator('a[href^="/report/"]')).to_have_count(3)
        expect(page.locator("#rows")).to_contain_text("nothing intact")
        expect(page.locator("#rows img")).to_have_count(0)
        for bag in ("a_pull", "b_gone"):
            page.get_by_label(f"plot {bag}").check()
        expect(page.locator("#lines polyline")).to_have_count(2)
        expect(page.locator("#legend span")).to_have_text(["a_pull", "b_gone"])
        page.fill("#filter", "gone")  # what is ticked stays, also while it is not listed
        page.get_by_label("plot b_gone").uncheck()
        expect(page.locator("#lines polyline")).to_have_count(1)
        browser.close()


def test_there_is_no_page_without_a_catalog(tmp_path: Path):
    with pytest.raises(BagError, match="does not exist"):
        make_page_server(tmp_path / "catalog.parquet", 0)
