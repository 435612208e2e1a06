"""The report of one bag as a page of HTML that loads nothing."""

from __future__ import annotations

import base64
import hashlib
import zlib
from collections.abc import Sequence
from datetime import datetime, timezone
from functools import cache
from importlib.resources import files

from jinja2 import Environment, StrictUndefined, Template
from plotly.offline import get_plotlyjs

from magnetosuture_thread.evaluation.metrics import RunMetrics
from magnetosuture_thread.evaluation.report import headlines
from magnetosuture_thread.evaluation.report.figures import STAGES, BagDetails, BagFigures
from magnetosuture_thread.evaluation.report.pictures import ReportPicture
from magnetosuture_thread.evaluation.report.plots import page_data

SINCE_EPOCH = 1_000_000_000  # s; a bag's time before it is no date


def write_page(about: BagDetails, metrics: RunMetrics, figures: BagFigures, pictures: Sequence[ReportPicture]) -> str:
    """Return the page.

    It loads nothing: style, script, plots' library, data and pictures are in it, and its own policy forbids the browser
    to load anything or to run a script that is not one of its two. Whatever is said in a bag is shown as text.

    Args:
        about: the bag.
        metrics: its columns.
        figures: of it.
        pictures: of the worst frames, the worst first.
    """
    packed, library = _library()
    script = _source("page.js")
    return _template().render(
        about=about,
        figures=figures,
        headlines=headlines.headlines(about, figures),
        pictures=pictures,
        data={"simulated": bool(about.simulated), **page_data(metrics, [picture.worst for picture in pictures])},
        reasons=metrics.reasons.most_common(),
        against=headlines.AGAINST,
        times=[("model step", figures.step_time), ("tracker, one frame", figures.processing)],
        stages=STAGES,
        recorded=_date(about.start),
        style=_source("page.css"),
        script=script,
        library=packed,
        hashes=" ".join(f"'{_hash(text)}'" for text in (script, library)),
    )


@cache
def _template() -> Template:
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    environment.filters.update(
        number=headlines.format_number, milliseconds=headlines.milliseconds, micrometres=headlines.micrometres
    )
    environment.globals["margin_verdict"] = headlines.margin_verdict
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    return environment.from_string(_source("page.html"))


def _source(name: str) -> str:
    """Return a file of this folder, which ships with the package."""
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


@cache
def _library() -> tuple[str, str]:
    """Return plotly.js, packed to two fifths of its size and in letters, and as it is."""
    library = get_plotlyjs()
    return base64.b64encode(zlib.compress(library.encode(), 9)).decode(), library


def _hash(script: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def _date(start: int) -> str:
    """Return when a bag was recorded; empty if its clock does not say."""
    if start < SINCE_EPOCH * 10**9:
        return ""
    return datetime.fromtimestamp(start // 10**9, timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC")
