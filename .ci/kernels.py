"""Compiles the kernels that each process of the tests would compile by itself, or hands compiled ones on.

With a folder, that of the package as it is installed elsewhere, the kernels of this tree are copied there: they are
those of files of the same content. Else they are compiled.
"""

from __future__ import annotations

import filecmp
import shutil
import subprocess
import sys
from pathlib import Path

from magnetosuture_thread.commands.compile import kernel_steps
from magnetosuture_thread.geometry.compiled import PACKAGE

ROOT = Path(__file__).resolve().parent.parent
# Tests with kernels that no setup has: in space, which share hardly any with the setups, ...
IN_SPACE = ("test/test_examples.py::test_an_example_runs[ball_in_space]",)
# ... and of the other formulations, and of forecasts in batches, which share most.
BESIDES = (
    "test/calibration/test_search.py::test_the_paper_s_numbers_are_fitted_too",
    "test/thread/test_self_contact.py::test_the_rows_are_the_distances_of_nodes_from_segments",
    "test/test_documentation.py::test_python_examples_run",
)


def compile_kernels() -> None:
    """Compile what rig, thread model, estimator, tracker and forecast run, and what else tests do."""
    pytest = [sys.executable, "-m", "pytest", "-q"]
    with subprocess.Popen([*pytest, *IN_SPACE], cwd=ROOT) as in_space:
        for load in kernel_steps().values():
            load()
        besides = subprocess.run([*pytest, *BESIDES], cwd=ROOT, check=False)
    if in_space.returncode or besides.returncode:
        sys.exit("a test failed whose kernels were to be compiled")


def copy_kernels(package: Path) -> None:
    """Copy the kernels beside the installed files that they were compiled from, where those are not this package."""
    if package.samefile(PACKAGE):
        return
    for source in PACKAGE.rglob("*.py"):
        installed = package / source.relative_to(PACKAGE)
        if not installed.exists() or not filecmp.cmp(source, installed, shallow=False):
            sys.exit(f"{installed}: expected a copy of {source}")
    for kernel in PACKAGE.rglob("__pycache__/*.nb[ci]"):
        copy = package / kernel.relative_to(PACKAGE)
        copy.parent.mkdir(exist_ok=True)
        shutil.copy2(kernel, copy)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        copy_kernels(Path(sys.argv[1]))
    else:
        compile_kernels()
