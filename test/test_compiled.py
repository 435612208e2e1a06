"""The cache of compiled functions."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from magnetosuture_thread.geometry.compiled import compiled, delete_stale_cache


def test_a_compiled_function_is_the_same_function():
    @compiled
    def half(x: float) -> float:
        """Return half."""
        return x / 2.0

    assert half(3.0) == 1.5
    assert half.__doc__ == "Return half."


def test_kernels_are_deleted_when_a_file_that_they_depend_on_changes(tmp_path: Path):
    """Numba itself looks only at the file of the function that is called."""
    cache = tmp_path / "room" / "__pycache__"
    cache.mkdir(parents=True)
    (tmp_path / "room/caller.py").write_text(
        "from magnetosuture_thread.geometry.compiled import compiled\nfrom magnetosuture_thread.callee import f\n"
    )
    (tmp_path / "callee.py").write_text("from magnetosuture_thread.constants import X\n")
    (tmp_path / "constants.py").write_text("X = 1\n")
    (tmp_path / "other.py").write_text("from magnetosuture_thread.geometry.compiled import compiled\n")
    kernels = [cache / "caller.f-1.py311.nbi", cache / "caller.f-1.py311.1.nbc"]

    def is_kept(*, changed: str = "") -> bool:
        if changed:
            os.utime(tmp_path / changed, (1.0, 1.0))
        for kernel in kernels:
            kernel.write_text("code")
        delete_stale_cache(tmp_path)
        return all(kernel.exists() for kernel in kernels)

    assert not is_kept()  # of an unknown state
    assert is_kept()
    assert is_kept(changed="other.py")
    for name in ("callee.py", "constants.py", "room/caller.py"):
        assert not is_kept(changed=name), name
        assert is_kept()


def test_a_second_start_compiles_nothing():
    """A kernel that numba cannot find again would be compiled, and kept once more, at every start.

    Counted in the process itself: other tests write into the same cache meanwhile.
    """
    code = """
from numba.core import event
from magnetosuture_thread.estimator.settings import ThreadModelSettings

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
    (tmp_path / "kernel.py").write_text("from magnetosuture_thread.geometry.compiled import compiled\n")
    (tmp_path / "__pycache__").write_text("a file where a folder should be, as nothing can be written into it")
    assert delete_stale_cache(tmp_path)
