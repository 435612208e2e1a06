"""The page of one bag: whole in itself, with the figures in it, and nothing of a bag's words run."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import re
import shutil
import subprocess
import zlib
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from magnetosuture_thread.evaluation.figures import BagDetails, Figures, LiveFigures, headlines, margin_state
from magnetosuture_thread.evaluation.frames import FrameResult
from magnetosuture_thread.evaluation.metrics import RunMetrics
from magnetosuture_thread.evaluation.page import page_data, write_page
from magnetosuture_thread.evaluation.plots import Photo, draw_worst_frame
from magnetosuture_thread.geometry.obstacles import Disc
from test.evaluation.runs import EVIL, LENGTH, NODES, both, made_metrics, margins

ABOUT = BagDetails("loop", "/data/loop", "petri", length=LENGTH, segments=25, dish_diameter=0.035, duration=10.0)
VOID = {"meta", "img", "br", "link"}


def made_page(about: BagDetails = ABOUT, *, live: LiveFigures | None = None, estimated: bool = False) -> str:
    """Return a page."""
    metrics = made_metrics(estimated=estimated)
    figures = Figures.of(metrics, live)
    pictures = [
        draw_worst_frame(worst, None, target=metrics.target, length=LENGTH, dish_diameter=0.035)
        for worst in metrics.worst_frames()
    ]
    return write_page(about, metrics, figures, pictures)


@pytest.fixture(scope="module")
def page() -> str:
    """A page."""
    return made_page()


class Reader(HTMLParser):
    """Reads a page: its tags, closed in order; its text; its scripts."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.scripts: list[str] = []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag == "script":
            self.scripts.append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            self.scripts[-1] += data
        elif not self.open or self.open[-1] != "style":
            self.text += data


def test_the_page_is_whole_loads_nothing_and_runs_its_own_scripts_only(page: str):
    reader = Reader(page)
    assert reader.open == []
    ids = [attributes["id"] for _, attributes in reader.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    for tag, attributes in reader.tags:
        assert tag not in {"link", "iframe", "object", "embed", "base"}
        for name in ("src", "href", "srcset", "data", "action", "poster"):
            assert (attributes.get(name) or "#").startswith(("#", "data:image/jpeg;base64,"))
    assert not re.search(r"https?:|@import|url\(", page)
    policy = next(a["content"] for t, a in reader.tags if t == "meta" and a.get("http-equiv"))
    assert policy is not None
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "showSendToCloud: false" in page
    _, library, script = reader.scripts
    plotly = zlib.decompress(base64.b64decode(library)).decode()
    assert plotly.startswith("/**\n* plotly.js")
    for source in (script, plotly):
        assert f"'sha256-{base64.b64encode(hashlib.sha256(source.encode()).digest()).decode()}'" in page
    assert page.count("'sha256-") == 2


def test_the_data_is_that_of_the_figures(page: str):
    data = json.loads(Reader(page).scripts[0])
    errors = made_metrics().errors()
    lines = {line["id"]: line for plot in data["plots"] for line in plot["series"]}
    for target in ("truth", "seen"):
        error = errors[target]
        assert error is not None
        values = [value for value in lines[f"error_{target}"]["values"] if value is not None]
        assert len(values) == error["count"] == 280
        assert max(values) == pytest.approx(error["maximum"], rel=1e-4)
        assert np.mean(values) == pytest.approx(error["mean"], rel=1e-4)
    assert max(value or 0.0 for value in lines["recorded_error_seen"]["values"]) == 0.0
    assert min(v for v in lines["margin_obstacle"]["values"] if v is not None) == pytest.approx(1e3 * (1e-3 - 2.99e-3))
    assert data["lost"] == [[pytest.approx(100 / 30, abs=1e-3), pytest.approx(119 / 30, abs=1e-3)]]
    assert len(data["map"]["errors"]) == 25
    assert data["moments"][0]["error"] == pytest.approx(lines["error_truth"]["values"][-1])
    assert len(data["times"]["predicted"]) == len(lines["strain"]["values"])


def test_estimate_and_prediction_stand_side_by_side():
    reader = Reader(made_page(estimated=True))
    assert reader.open == []
    for text in (
        "estimate, error against the ground truth",
        "prediction, error against the ground truth",
        "estimate, against the measured centreline",
        "normalised innovation squared",
        "6.67 to 9.97 s",
        "3.00 µN",
    ):
        assert text in " ".join(reader.text.split())
    data = json.loads(reader.scripts[0])
    lines = {line["id"]: line for plot in data["plots"] for line in plot["series"]}
    for target in ("truth", "seen"):
        estimated, predicted = lines[f"estimate_error_{target}"], lines[f"error_{target}"]
        assert (estimated["role"], predicted["role"]) == ("estimated", "predicted")
    greatest = [max(v or 0.0 for v in lines[f"{kind}error_truth"]["values"]) for kind in ("estimate_", "")]
    assert greatest[0] == pytest.approx(0.5 * greatest[1], rel=1e-4)
    low, high, mean = (lines[name]["values"] for name in ("low", "high", "mean"))
    assert all(a < m < b for a, m, b in zip(low, mean, high, strict=True))
    assert len(data["times"]["windows"]) == len(mean) == 2 * 2
    assert data["disturbances"] == [[pytest.approx(6.6667, abs=1e-3), pytest.approx(9.9667, abs=1e-3)]]


def test_words_of_a_bag_are_shown_and_never_run():
    words: dict[str, Any] = dict.fromkeys(("name", "path", "setup", "simulated"), EVIL)
    words |= {"damage": (EVIL,), "refused": {EVIL: 1}, "topics": {EVIL: (EVIL, 1)}, "remarks": (EVIL,)}
    words |= {"settings": ((EVIL, EVIL, EVIL),), "software": ((EVIL, EVIL),)}
    reader = Reader(made_page(replace(ABOUT, **words)))
    assert reader.open == []
    assert len(reader.scripts) == 3
    assert reader.text.count(EVIL) >= 13
    assert not any(name.startswith("on") for _, attributes in reader.tags for name in attributes)


@pytest.mark.parametrize("with_frame", [True, False])
def test_a_picture_shows_frame_or_plan_and_says_what(view, with_frame: bool):
    metrics = made_metrics()
    photo = Photo(np.full((480, 640, 3), 90, np.uint8), view) if with_frame else None
    worst = metrics.worst_frames()[0]
    worst.frame.obstacles = (Disc((0.0, 0.009), 0.002),)
    picture = draw_worst_frame(worst, photo, target="truth", length=LENGTH, dish_diameter=0.035)
    kind, _, data = picture.source.partition(",")
    assert kind == "data:image/jpeg;base64"
    image = imread(io.BytesIO(base64.b64decode(data)), format="jpeg")
    assert image.shape == (595, 1200, 3)
    assert np.median(image) == pytest.approx(90 if with_frame else 244, abs=3)
    assert picture.is_plan != with_frame
    assert picture.alt_text.startswith("Camera frame at 9.97 s" if with_frame else "Plan of the dish at 9.97 s")
    assert len(data) < 300_000


BROWSERS = [
    pytest.param(path, marks=pytest.mark.slow) for name in ("chromium", "google-chrome") if (path := shutil.which(name))
]


@pytest.mark.parametrize("browser", [None, *BROWSERS[:1]])
def test_a_browser_draws_all_plots_where_there_is_one(tmp_path: Path, browser: str | None):
    """The page's script has a place for each plot; a real browser, where there is one, fills them."""
    page = made_page(estimated=True)
    plots = [plot["id"] for plot in json.loads(Reader(page).scripts[0])["plots"]] + ["map", "estimate_map"]
    assert {f"plot-{name}" for name in plots} <= {a.get("id") for _, a in Reader(page).tags}
    if browser is None:
        return
    (tmp_path / "a b.html").write_text(page)
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    options += ["--virtual-time-budget=20000", "--dump-dom", (tmp_path / "a b.html").as_uri()]
    shown = subprocess.run([browser, *options], capture_output=True, text=True, timeout=120, check=True).stdout
    assert f'data-drawn="{len(plots)}"' in shown
    assert shown.count('class="main-svg"') >= len(plots)
    assert "The plots cannot be drawn" not in shown.split("<script")[0]


@pytest.mark.parametrize(
    ("clearance", "value", "expected"),
    [
        (-1e-4, -1e-7, ("minimum margin, connectivity", "broken: connectivity")),
        (0.0, None, ("minimum margin, obstacle", "every barrier holds")),
    ],
)
def test_the_head_shows_the_margin_that_is_broken(clearance: float, value: float | None, expected: tuple[str, str]):
    metrics = RunMetrics(LENGTH)
    given = both(margins(clearance, "connectivity", value), margins(1e-3))
    metrics.add(FrameResult(0, vertices=NODES, margins=given))
    tile = next(tile for tile in headlines(ABOUT, Figures.of(metrics)) if "margin" in tile.name)
    assert (tile.name, tile.assessment) == expected


def test_what_a_barrier_keeps_is_shown_apart_from_a_chord_that_cuts_a_round_shape():
    metrics = RunMetrics(LENGTH)
    metrics.add(FrameResult(0, vertices=NODES, margins=margins(-16e-6, "obstacle", 0.0)))
    figures = Figures.of(metrics)
    tile = next(tile for tile in headlines(ABOUT, figures) if "margin" in tile.name)
    assert (tile.value, tile.assessment) == ("0 µm", "every barrier holds")
    assert tile.detail.startswith("of nodes; a chord between two, -16.0 µm, at ")
    least = metrics.minimum_margins["obstacle"]
    assert (least.promised, least.chord, margin_state(ABOUT, least)) == (0.0, -16e-6, "holds")
    assert "<td>0 µm</td><td>-16.0 µm</td>" in write_page(ABOUT, metrics, figures, [])


def test_the_forces_are_drawn_and_their_greatest_stated():
    metrics = made_metrics()
    plot = next(plot for plot in page_data(metrics, [])["plots"] if plot["id"] == "tension")
    peaks, pulls = (max(value for value in line["values"] if value is not None) for line in plot["series"])
    assert [peaks, pulls] == pytest.approx([299.0, 5.0], rel=1e-3)  # in uN
    assert "At most 299 µN in a segment, and 5.00 µN upon the needle." in made_page()
    sentence = "The pull differs from the ground truth by"
    assert "Forces in the thread" in (page := made_page())
    assert sentence not in page
    metrics.add(
        FrameResult(
            2 * 10**10, vertices=NODES, tension=1e-6, pull=np.array([0.0, 1e-6]), true_pull=np.array([0.0, 4e-6])
        )
    )
    assert f"{sentence} 75.0 %" in write_page(ABOUT, metrics, Figures.of(metrics), [])
    nothing = RunMetrics(LENGTH)
    nothing.add(FrameResult(0, vertices=NODES))
    assert "Forces in the thread" not in write_page(ABOUT, nothing, Figures.of(nothing), [])
