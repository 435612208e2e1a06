"""Templates of reports: pages that load nothing, and show as text whatever is said from outside."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined, Template

from magnetosuture_thread.evaluation.colours import style_variables
from magnetosuture_thread.texts import printable


def read_template(package: str, name: str, functions: Mapping[str, Callable[..., Any]]) -> Template:
    """Return a template that ships with a subpackage, in which texts are escaped and nothing may be undefined.

    Args:
        package: name of the subpackage.
        name: of the file.
        functions: that the template uses as filters or calls, by name.
    """
    environment = Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined, finalize=_shown
    )
    environment.filters.update(functions)
    environment.globals.update(functions)
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    return environment.from_string(read_source(package, name))


def read_source(package: str, name: str) -> str:
    """Return a file that ships with a subpackage."""
    return files(package).joinpath(name).read_text(encoding="utf-8")


@cache
def page_style() -> str:
    """Return the style sheet of all reports."""
    return style_variables() + read_source(__package__, "page.css")


def _shown(value: Any) -> Any:
    """Return what the page gets for a value: of a text from outside, what can be shown."""
    return printable(value) if type(value) is str else value  # not Markup, which is ours
