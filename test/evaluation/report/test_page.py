"""The page of one bag: whole in itself, with the figures in it, and nothing of a bag's words run."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import math
import re
import shutil
import subprocess
import zlib
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from magnetosuture_thread.estimator import Disturbance
from magnetosuture_thread.evaluation.frames import EstimatedThread, FrameResult, Observation
from magnetosuture_thread.evaluation.metrics import MinimumMargin, RunMetrics
from magnetosuture_thread.evaluation.plots import Photo, draw_worst_frame
from magnetosuture_thread.evaluation.report.figures import BagDetails, Figures, LiveFigures, format_number, headlines
from magnetosuture_thread.evaluation.report.page import page_data, write_page
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.thread.forces import ThreadForces
from magnetosuture_thread.thread.margins import BarrierMargins, Margins

LENGTH = 0.019
NODES = np.column_stack([0.004 - LENGTH * np.arange(26) / 25, np.zeros(26)])
EVIL = '<script>alert("x")</script>\'"&'
ABOUT = BagDetails("loop", "/data/loop", "petri", length=LENGTH, segments=25, dish_diameter=0.035, duration=10.0)
VOID = {"meta", "img", "br", "link"}


def margins(clearance: float) -> Margins:
    """Return margins of one node at a post."""
    one = np.array([clearance])
    obstacle = BarrierMargins("obstacle", np.array([7], np.uint32), np.array([0], np.int32), one, one)
    return Margins((obstacle,), (7,) if clearance <= 0 else ())


def made_metrics(
    frames: int = 300, targets: tuple[str, ...] = ("truth", "seen"), *, estimated: bool = False
) -> RunMetrics:
    """Return the metrics of frames whose predictions are off by more and more, with a needle lost in between.

    Estimates are off by half as much, and the thread is disturbed from frame 200 on.
    """
    metrics = RunMetrics(LENGTH, 10**9, targets, recorded=True)
    for index in range(frames):
        stamp, off = 10**9 + index * 33_333_333, 1e-6 * index
        seen, truth = NODES + np.array([0.0, off]), NODES + np.array([0.0, 2.0 * off])
        sight = Observation(stamp, NODES[0], np.array([1.0, 0.0]), seen, truth, processing=3e-3)
        if 100 <= index < 120:
            metrics.observe(Observation(stamp, reason=f"hidden by {EVIL}"))
            continue
        metrics.observe(sight)
        forces = ThreadForces(
            np.array([1e-6 * index, 5e-6]), np.zeros((26, 2)), np.array([-3e-6, 4e-6]), 0.0, *np.zeros((2, 26))
        )
        prediction: Any = SimpleNamespace(positions=NODES, strain=np.array([0.0, -1e-5]), residual=1e-9, forces=forces)
        frame = FrameResult.of(sight, prediction, margins(1e-3 - 1e-5 * index), 1e-4, recorded=seen)
        if estimated:
            found = Disturbance(8e-3, 2e-3, NODES[10], np.array([0.0, 1.0]), 3e-6, 9.0, 1.0 + 200 / 30)
            squared = np.linspace(0.5, 1.5, 16)
            disturbances = (found,) if index >= 200 else ()
            frame.estimate = EstimatedThread(NODES + np.array([0.0, off]), index > 0, squared, disturbances)
        metrics.add(frame)
    return metrics


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


def test_every_tag_is_closed(page: str):
    reader = Reader(page)
    assert reader.open == []
    ids = [attributes["id"] for _, attributes in reader.tags if "id" in attributes]
    assert len(ids) == len(set(ids))


def test_nothing_is_loaded_from_anywhere(page: str):
    reader = Reader(page)
    for tag, attributes in reader.tags:
        assert tag not in {"link", "iframe", "object", "embed", "base"}
        for name in ("src", "href", "srcset", "data", "action", "poster"):
            assert (attributes.get(name) or "#").startswith(("#", "data:image/jpeg;base64,"))
    assert "http:" not in page
    assert "https:" not in page
    assert not re.search(r"@import|url\(", page)
    policy = next(a["content"] for t, a in reader.tags if t == "meta" and a.get("http-equiv"))
    assert policy is not None
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "showSendToCloud: false" in page


def test_the_policy_lets_the_page_s_own_scripts_run_and_no_other(page: str):
    reader = Reader(page)
    data, library, script = reader.scripts
    plotly = zlib.decompress(base64.b64decode(library)).decode()
    assert plotly.startswith("/**\n* plotly.js")
    for source in (script, plotly):
        assert f"'sha256-{base64.b64encode(hashlib.sha256(source.encode()).digest()).decode()}'" in page
    assert page.count("'sha256-") == 2
    assert json.loads(data)["plots"]


def test_the_data_is_that_of_the_figures(page: str):
    data = json.loads(Reader(page).scripts[0])
    figures = Figures.of(made_metrics())
    lines = {line["id"]: line for plot in data["plots"] for line in plot["series"]}
    for target in ("truth", "seen"):
        error = figures.error[target]
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
    page = made_page(estimated=True)
    reader = Reader(page)
    assert reader.open == []
    for text in (
        "estimate, error against the ground truth",
        "prediction, error against the ground truth",
        "estimate, against the measured centreline",
        "normalised innovation squared",
        "thread hidden",
        "6.67 to 9.97 s",
        "3.00 µN",
    ):
        assert text in " ".join(reader.text.split())
    data = json.loads(reader.scripts[0])
    lines = {line["id"]: line for plot in data["plots"] for line in plot["series"]}
    assert lines["estimate_error_truth"]["role"] == lines["estimate_error_seen"]["role"] == "estimated"
    assert lines["error_truth"]["role"] == lines["error_seen"]["role"] == "predicted"
    assert max(v or 0.0 for v in lines["estimate_error_truth"]["values"]) == pytest.approx(
        0.5 * max(v or 0.0 for v in lines["error_truth"]["values"]), rel=1e-4
    )
    low, high, mean = (lines[name]["values"] for name in ("low", "high", "mean"))
    assert all(a < m < b for a, m, b in zip(low, mean, high, strict=True))
    assert len(data["times"]["windows"]) == len(mean) == 2 * 2
    assert data["disturbances"] == [[pytest.approx(6.6667, abs=1e-3), pytest.approx(9.9667, abs=1e-3)]]
    greatest = [np.nanmax(np.array(data[name]["errors"], dtype=float)) for name in ("estimate_map", "map")]
    assert greatest[0] == pytest.approx(0.5 * greatest[1], rel=1e-2)
    for name in ("measured", "predicted", "estimated"):
        assert f"--{name}: #" in page


def test_words_of_a_bag_are_shown_and_never_run():
    about = replace(
        ABOUT,
        name=EVIL,
        path=EVIL,
        setup=EVIL,
        simulated=EVIL,
        damage=(EVIL,),
        refused={EVIL: 1},
        topics={EVIL: (EVIL, 1)},
        settings=((EVIL, EVIL, EVIL),),
        remarks=(EVIL,),
        software=((EVIL, EVIL),),
    )
    reader = Reader(made_page(about))
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


def drawn(browser: str, folder: Path, page: str) -> str:
    """Return a page as a browser has made it."""
    (folder / "a b.html").write_text(page)
    return subprocess.run(
        [
            *(browser, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}"),
            *("--virtual-time-budget=20000", "--dump-dom", (folder / "a b.html").as_uri()),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    ).stdout


BROWSERS = [
    pytest.param(path, marks=pytest.mark.slow) for name in ("chromium", "google-chrome") if (path := shutil.which(name))
]


@pytest.mark.parametrize("estimated", [False, True])
@pytest.mark.parametrize("browser", [None, *BROWSERS[:1]])
def test_a_browser_draws_all_plots_where_there_is_one(tmp_path: Path, page: str, browser: str | None, estimated: bool):
    """The page's script has a place for each plot; a real browser, where there is one, fills them."""
    page = made_page(estimated=True) if estimated else page
    plots = [plot["id"] for plot in json.loads(Reader(page).scripts[0])["plots"]]
    assert ({"consistency", "hidden"} <= set(plots)) == estimated
    plots += ["map", "estimate_map"] if estimated else ["map"]
    assert {f"plot-{name}" for name in plots} <= {a.get("id") for _, a in Reader(page).tags}
    if browser is None:
        return
    shown = drawn(browser, tmp_path, page)
    assert f'data-drawn="{len(plots)}"' in shown
    assert shown.count('class="main-svg"') >= len(plots)
    assert "The plots cannot be drawn" not in shown.split("<script")[0]


def test_the_head_shows_the_margin_that_is_broken():
    metrics = made_metrics(3)
    holds = MinimumMargin("obstacle", 1e-3, 1e-3, 7, 0, 0.1)
    broken = MinimumMargin("connectivity", -1e-4, -1e-7, 3, -1, 0.2)
    figures = replace(Figures.of(metrics), minimum={"connectivity": broken, "obstacle": holds})
    tile = next(tile for tile in headlines(ABOUT, figures) if "margin" in tile.name)
    assert (tile.name, tile.assessment) == ("minimum margin, connectivity", "broken: connectivity")
    figures = replace(figures, minimum={"connectivity": replace(broken, clearance=0.0), "obstacle": holds})
    tile = next(tile for tile in headlines(ABOUT, figures) if "margin" in tile.name)
    assert (tile.name, tile.assessment) == ("minimum margin, obstacle", "every barrier holds")


def test_the_forces_are_drawn_and_their_greatest_stated():
    metrics = made_metrics()
    figures = Figures.of(metrics)
    peak = 1e-6 * (len(metrics.observed) - 1)
    assert [figures.tension, figures.pull] == pytest.approx([peak, 5e-6])
    plot = next(plot for plot in page_data(metrics, [])["plots"] if plot["id"] == "tension")
    peaks, pulls = (max(value for value in line["values"] if value is not None) for line in plot["series"])
    assert [peaks, pulls] == pytest.approx([1e6 * peak, 5.0], rel=1e-3)  # in uN
    (headline,) = [each for each in headlines(ABOUT, figures) if each.name == "peak tension"]
    assert headline.value == f"{1e6 * peak:.0f} µN"
    sentence = f"The pull differs from the ground truth by {format_number(2.5)}"
    assert "Forces in the thread" in (page := made_page())
    assert sentence[:40] not in page
    assert sentence in write_page(ABOUT, metrics, replace(figures, pull_error=2.5), [])
    nothing = replace(figures, tension=math.nan, pull=math.nan)
    assert "none" in {each.value for each in headlines(ABOUT, nothing) if each.name == "peak tension"}


def test_the_figures_are_the_worst_and_the_counts_of_all_frames():
    metrics = RunMetrics(LENGTH, 0, ("truth",))
    for index, (clearance, residual) in enumerate([(1e-4, 1e-9), (-1e-5, 1e-7), (2e-4, 1e-8)]):
        sight = Observation(index * 10**8, NODES[0], np.array([1.0, 0.0]), NODES, NODES)
        metrics.observe(sight)
        prediction: Any = SimpleNamespace(positions=NODES, strain=np.zeros(25), residual=residual, forces=None)
        metrics.add(FrameResult.of(sight, prediction, margins(clearance), 1e-4))
    for index in range(3, 40):
        metrics.observe(Observation(index * 10**8, reason=f"{index % 20}"))
    figures = Figures.of(metrics)
    assert figures.minimum["obstacle"].clearance == -1e-5
    assert figures.minimum["obstacle"].time == pytest.approx(0.1)
    assert (figures.residual, figures.contact_frames) == (1e-7, 1)
    assert metrics.lost == [[pytest.approx(0.3), pytest.approx(3.9)]]
    assert len(metrics.reasons) <= 13
    assert metrics.reasons["others"] > 0
