"""The page of one bag: HTML that needs nothing but itself."""

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

from magnetosuture_thread.study.replayed import Spread
from magnetosuture_thread.study.report import verdicts
from magnetosuture_thread.study.report.account import Account
from magnetosuture_thread.study.report.figures import STAGES, About, Figures
from magnetosuture_thread.study.report.pictures import Picture
from magnetosuture_thread.study.report.plots import page_data

SINCE_EPOCH = 1_000_000_000  # s; a bag's time before it is no date


def write_page(about: About, account: Account, figures: Figures, pictures: Sequence[Picture]) -> str:
    """Return the page.

    It loads nothing: style, script, plots' library, data and pictures are in it, and its own policy forbids the browser
    to load anything or to run a script that is not one of its two. Whatever is said in a bag is shown as text.

    Args:
        about: the bag.
        account: its columns.
        figures: of it.
        pictures: of the worst moments, the worst first.
    """
    packed, library = _library()
    script = _source("page.js")
    return _template().render(
        about=about,
        figures=figures,
        headlines=verdicts.headlines(about, figures),
        pictures=pictures,
        data={"simulated": bool(about.simulated), **page_data(account, [picture.moment for picture in pictures])},
        reasons=account.reasons.most_common(),
        against=verdicts.AGAINST,
        spreads=_spreads(figures),
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
        number=verdicts.number, milliseconds=verdicts.milliseconds, micrometres=verdicts.micrometres
    )
    environment.globals["margin_verdict"] = verdicts.margin_verdict
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


def _spreads(figures: Figures) -> list[tuple[str, Spread | None]]:
    return [("model step", figures.step_time), ("tracker, one frame", figures.processing)]


def _date(start: int) -> str:
    """Return when a bag was recorded; empty if its clock does not say."""
    if start < SINCE_EPOCH * 10**9:
        return ""
    return datetime.fromtimestamp(start // 10**9, timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC")
