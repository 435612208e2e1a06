"""The cache of compiled functions."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from magnetosuture_thread.compiled import compiled, delete_stale_cache


def test_a_compiled_function_is_the_same_function():
    @compiled
    def half(x: float) -> float:
        """Return half."""
        return x / 2.0

    assert half(3.0) == 1.5
    assert half.__doc__ == "Return half."


def test_kernels_are_forgotten_when_any_file_with_compiled_functions_changes(tmp_path: Path):
    """Numba itself looks only at the file of the function that is called."""
    kernels = tmp_path / "room" / "__pycache__"
    kernels.mkdir(parents=True)
    callee, other = tmp_path / "callee.py", tmp_path / "other.py"
    callee.write_text("from magnetosuture_thread.compiled import compiled\n")
    other.write_text("x = 1\n")

    def cached() -> bool:
        return (kernels / "caller.nbi").exists() and (kernels / "caller.1.nbc").exists()

    def cache() -> None:
        (kernels / "caller.nbi").write_text("index")
        (kernels / "caller.1.nbc").write_text("code")

    cache()
    assert delete_stale_cache(tmp_path)
    assert not cached()
    cache()
    assert not delete_stale_cache(tmp_path)
    assert cached()
    other.write_text("x = 2\n")  # holds no compiled function
    assert not delete_stale_cache(tmp_path)
    os.utime(callee, (1.0, 1.0))
    assert delete_stale_cache(tmp_path)
    assert not cached()


def test_a_second_start_compiles_nothing():
    """A kernel that numba cannot find again would be compiled, and kept once more, at every start.

    Counted in the process itself: other tests write into the same cache meanwhile.
    """
    code = """
from numba.core import event
from magnetosuture_thread.model.settings import ThreadModelSettings

with event.install_recorder("numba:compile") as compilations:
    {start}
print(len(compilations.buffer))
"""

    def compilations(start: str) -> int:
        done = subprocess.run(
            [sys.executable, "-c", code.format(start=start)], check=True, timeout=300, stdout=subprocess.PIPE, text=True
        )
        return int(done.stdout)

    new_kernel = "import numba; numba.njit(lambda x: x)(1.0)"
    assert compilations(new_kernel) > 0
    compilations("ThreadModelSettings().predictor(None)")
    assert compilations("ThreadModelSettings().predictor(None)") == 0


def test_a_package_that_cannot_be_written_is_left_alone(tmp_path: Path):
    (tmp_path / "kernel.py").write_text("from magnetosuture_thread.compiled import compiled\n")
    (tmp_path / "__pycache__").write_text("a file where a folder should be, as nothing can be written into it")
    assert delete_stale_cache(tmp_path)
