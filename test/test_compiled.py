"""The cache of compiled functions."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from magnetosuture_thread.geometry.compiled import compiled_inline, source_digest
from test.shared import run_python


def test_the_digest_of_kernels_is_of_every_file_that_they_depend_on(tmp_path: Path):
    """Numba itself looks only at the file of the function that is called."""
    texts = {
        "room/caller.py": """
from magnetosuture_thread.callee import f
from magnetosuture_thread.room import (
    inner,
)
""",
        "room/inner.py": "",
        "callee.py": "from magnetosuture_thread.constants import X\n",
        "constants.py": "X = 1\n",
        "other.py": "",
    }
    for number, changed in enumerate(["", *texts]):
        package = tmp_path / str(number)
        for name, text in texts.items():
            (package / name).parent.mkdir(exist_ok=True, parents=True)
            (package / name).write_text(text + "# changed\n" * (name == changed))
    digests = [source_digest(tmp_path / str(n) / "room/caller.py", tmp_path / str(n)) for n in range(len(texts) + 1)]
    assert [digest != digests[0] for digest in digests[1:]] == [True, True, True, True, False]


KERNEL = """
from magnetosuture_thread.geometry.compiled import compilations, compiled

@compiled
def double(x: float) -> float:
    return {factor} * x

print(double(21.0), compilations() > 0)
"""


@pytest.mark.slow
def test_code_of_before_is_not_run_and_nothing_has_to_be_writable(tmp_path: Path):
    """In the user's cache, as beside the file; and with no place for a cache at all."""
    script, cache = tmp_path / "kernel.py", tmp_path / "cache"

    def run(factor: str, **places: str) -> str:
        script.write_text(KERNEL.format(factor=factor))
        return run_python(script, environment={"PYTHONDONTWRITEBYTECODE": "1", **places}).strip()

    places = {"NUMBA_CACHE_DIR": str(cache)}
    results = [run("2.0", **places), run("2.0", **places), run("4.0", **places)]
    assert results == ["42.0 True", "42.0 False", "84.0 True"]
    for kept in ("nbi", "nbc"):  # emptied, as by a power cut
        for file in cache.rglob(f"*.{kept}"):
            file.write_bytes(b"")
        assert [run("4.0", **places) for _ in range(2)] == ["84.0 True", "84.0 False"]
    (tmp_path / "__pycache__").write_text("a file where a folder should be")
    nowhere = dict.fromkeys(("HOME", "XDG_CACHE_HOME"), "/dev/null")
    nowhere["NUMBA_CACHE_DIR"] = "/dev/null/cache"
    assert run("2.0", **nowhere) == "42.0 True"
    full = f"ulimit -f 1; exec {sys.executable} {script}"  # no file can have more than some hundred bytes
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "full")}
    done = subprocess.run(["sh", "-c", full], env=environment, check=True, timeout=600, stdout=subprocess.PIPE)
    assert done.stdout == b"42.0 True\n"


INNER = """
from magnetosuture_thread.geometry.compiled import compiled_inner, compiled_uncounted

@compiled_inner
def double(x: float) -> float:
    return 2.0 * x

@compiled_uncounted
def outer(x: float) -> float:
    return double(x) + 1.0

print(outer(21.0), double(21.0), outer(21.0), double(21.0))
"""


def test_a_kernel_without_a_wrapper_can_be_called_from_python(tmp_path: Path):
    """By numba itself that is a crash of the process."""
    (tmp_path / "inner.py").write_text(INNER)
    assert run_python(tmp_path / "inner.py") == "43.0 42.0 43.0 42.0\n"


def test_without_jit_the_same_is_predicted(tmp_path: Path):
    """As NUMBA_DISABLE_JIT asks for, to step through it in a debugger."""
    code = """
import pickle
from magnetosuture_thread import NeedlePose, ThreadPredictor

predictor = ThreadPredictor.create("polyamide_7_0", length=0.019, segments=10)
predictor.start(NeedlePose(0.0, (0.0, 0.0), (1.0, 0.0)))
prediction = pickle.loads(pickle.dumps(predictor)).step(NeedlePose(0.02, (0.0, 1e-4), (0.6, 0.8)))
print(prediction.converged, prediction.positions.round(12).tolist(), prediction.tension.round(12).tolist())
"""
    shown = [run_python("-c", code, environment={"NUMBA_DISABLE_JIT": switch}) for switch in ("0", "1")]
    assert shown[0] == shown[1]
    assert shown[0].startswith("True ")


def test_a_second_start_compiles_nothing():
    """A kernel that numba cannot find again would be compiled, and kept once more, at every start.

    Counted in the process itself: other tests write into the same cache meanwhile.
    """
    code = """
import numba
from numba.core import event
from magnetosuture_thread.estimator.settings import ThreadModelSettings

with event.install_recorder("numba:compile") as compilations:
    ThreadModelSettings().predictor(None)
    count = len(compilations.buffer)
    numba.njit(lambda x: x)(1.0)
print(count, len(compilations.buffer) > count)
"""
    shown = [run_python("-c", code) for _ in range(2)]
    assert shown[1] == "0 True\n"


def test_a_number_that_is_written_out_compiles_nothing_again():
    """For numba it has a type of its own."""

    @compiled_inline
    def added(x: float, count: int, first: bool) -> float:
        return x + count if first else x - count

    @compiled_inline
    def caller(x: float, count: int, first: bool) -> float:
        return added(added(x, 3, True), count, first)

    called: Any = added
    assert caller(0.5, 1, False) == 2.5
    assert len(called.signatures) == 1
