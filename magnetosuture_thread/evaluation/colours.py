"""The colours of threads in plots, pictures and reports, which red-green blind readers tell apart too.

They are those of the operator's page. Each thread also has a line of its own: the measured one is wide and light, the
ground truth dashed.
"""

from __future__ import annotations

from typing import NamedTuple


class Colour(NamedTuple):
    """A colour on light and on dark ground."""

    light: str
    dark: str


INK = Colour("#1d2833", "#e3e9ee")
MEASURED = Colour("#2f7bff", "#5b8cff")
GROUND_TRUTH = INK  # dashed
PREDICTED = Colour("#99107f", "#e83aae")
ESTIMATED = Colour("#00a3a8", "#35e6cb")

BY_NAME = {"measured": MEASURED, "ground-truth": GROUND_TRUTH, "predicted": PREDICTED, "estimated": ESTIMATED}


def style_variables() -> str:
    """Return the colours as variables of a style sheet: `--measured` and the others, also for dark ground."""
    light, dark = (
        " ".join(f"--{name}: {getattr(colour, ground)};" for name, colour in BY_NAME.items())
        for ground in ("light", "dark")
    )
    return f":root {{ {light} }}\n@media screen and (prefers-color-scheme: dark) {{ :root {{ {dark} }} }}\n"
