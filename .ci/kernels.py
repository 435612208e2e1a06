"""Compiles the kernels that each process of the tests would compile by itself, or hands compiled ones on.

With a folder, that of the package as it is installed elsewhere, the kernels of this tree are copied there: numba takes
them for a file of the same content and time of change. Else they are compiled.
"""

from __future__ import annotations

import filecmp
import os
import shutil
import sys
from pathlib import Path

from magnetosuture_thread.compiled import PACKAGE
from magnetosuture_thread.forecast.making import make_forecaster
from magnetosuture_thread.model.estimator import EstimatorOptions, ThreadEstimator
from magnetosuture_thread.rig.rig import Rig
from magnetosuture_thread.setups import read_setup
from magnetosuture_thread.vision.warm_up import warm_up

SETUP = "petri_35mm_polyamide_post"


def compile_kernels() -> None:
    """Compile what rig, thread model, estimator, tracker and forecast run."""
    setup = read_setup(SETUP)
    Rig(setup.rig, setup.scene).warm_up()
    ThreadEstimator(setup.model.predictor(setup.scene), EstimatorOptions()).warm_up()
    warm_up()
    make_forecaster(setup.model, setup.scene).warm_up()


def copy_kernels(package: Path) -> None:
    """Copy the kernels beside the installed files that they were compiled from."""
    for source in PACKAGE.rglob("*.py"):
        installed = package / source.relative_to(PACKAGE)
        if not installed.exists() or not filecmp.cmp(source, installed, shallow=False):
            sys.exit(f"{installed}: expected a copy of {source}")
        status = source.stat()
        os.utime(installed, ns=(status.st_atime_ns, status.st_mtime_ns))
    for kernel in [*PACKAGE.rglob("__pycache__/*.nb[ci]"), PACKAGE / "__pycache__" / "kernels.stamp"]:
        copy = package / kernel.relative_to(PACKAGE)
        copy.parent.mkdir(exist_ok=True)
        shutil.copy2(kernel, copy)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        copy_kernels(Path(sys.argv[1]))
    else:
        compile_kernels()
