"""Every example that the documentation shows runs, from its own folder, and says what it should."""

from __future__ import annotations

import re

import pytest

from test.examples import FOLDER
from test.shared import run_python

pytestmark = pytest.mark.slow

LINES = 40  # of an example at most
SAYS = {
    "another_solver": "osqp and banded differ by 0.00 nm",
    # The bag's thread has 1.306e-09.
    "calibration": "stiffness over drag: 1.3e-09 .*\n95 % interval: 1.28e-09 to 1.31e-09",
    "free_thread": "nearest node to the wall: 4.97 mm",
    "ball_in_space": "nodes lie on the ball",
    "needle_filter": "in the end: stopped by post, upper_half",
    "offline_replay": "needle found in 119 of 121 frames",
    "own_barrier": "moving_disc: at least",
    "wrap_around_post": "nodes touch post",
}


@pytest.mark.parametrize("name", SAYS)
def test_an_example_runs(name: str):
    path = FOLDER / f"{name}.py"
    assert len(path.read_text().splitlines()) <= LINES
    assert re.search(SAYS[name], run_python(path.name, cwd=FOLDER))


@pytest.mark.parametrize("name", sorted(path.stem for path in FOLDER.glob("*.py") if path.stem not in SAYS))
def test_a_script_that_makes_what_is_shipped_can_be_run(name: str):
    run_python("-c", f"import runpy; runpy.run_path({str(FOLDER / name)!r} + '.py')", cwd=FOLDER.parent)
