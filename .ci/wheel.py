"""Builds sdist and wheel, installs the wheel into a clean environment, and uses it there: without ROS, then with it.

Without the extra `ros` the Python interface and every command that needs no graph must work, and nodes must name what
is missing. With it nodes must run. All is done away from the source tree, so that nothing is found in it.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

from installed_nodes import NODES, check_nodes
from kernels import copy_kernels

ROOT = Path(__file__).resolve().parent.parent
BACKEND = next(re.finditer(r"scikit-build-core==[\d.]+", (ROOT / "pyproject.toml").read_text()))[0]
ENVIRONMENT = {
    **os.environ,
    "PIP_CONSTRAINT": str(ROOT / "constraints.txt"),
    "PIP_DISABLE_PIP_VERSION_CHECK": "1",
    "PIP_NO_COMPILE": "no",  # pip takes this "no" for a yes
}


def run(*command: str | Path, code: int = 0) -> str:
    """Run a command, which must end with an exit code, and return what it writes."""
    done = subprocess.run(command, env=ENVIRONMENT, cwd=Path.cwd(), capture_output=True, text=True, check=False)
    written = done.stdout + done.stderr
    if done.returncode != code:
        sys.exit(f"{' '.join(map(str, command))}: exit code {done.returncode}, expected {code}\n{written}")
    return written


def expect(words: str, written: str) -> None:
    """End where words are not in what a command has written."""
    if words not in written:
        sys.exit(f"expected {words!r} in: {written}")


def build(folder: Path) -> Path:
    """Return the wheel that is built from the sdist, which is built from the source tree."""
    backend = folder / "backend"
    run(sys.executable, "-m", "pip", "install", "-q", "--target", backend, BACKEND)
    program = "import os, sys; sys.path.insert(0, sys.argv[1]); from scikit_build_core.build import build_sdist; "
    program += "os.chdir(sys.argv[2]); build_sdist(sys.argv[3])"
    run(sys.executable, "-c", program, backend, ROOT, folder)
    (sdist,) = folder.glob("*.tar.gz")
    run(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, sdist)
    (wheel,) = folder.glob("*.whl")
    print(f"{sdist.name}, {wheel.name}: built")
    return wheel


def check_without_ros(programs: Path) -> None:
    """Check what works without ROS, and that the rest names what is missing."""
    version = next(re.finditer(r'^version = "(.+)"', (ROOT / "pyproject.toml").read_text(), re.MULTILINE))[1]
    expect(f"magnetosuture {version}", run(programs / "magnetosuture", "--version"))
    example = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[0]
    run(programs / "python", "-c", example)
    run(programs / "magnetosuture", "scene", "check", "hernia_ring")
    run(programs / "magnetosuture", "replay", ROOT / "examples" / "post_wrap", "--offline", "--output", "replayed")
    missing = "need ROS 2 Jazzy"
    expect(missing, run(programs / "magnetosuture", "simulate", "hernia_ring", "--output", "simulated", code=1))
    for name in NODES:
        expect(missing, run(programs / name, code=1))
    print("without ROS: the Python interface, scene check and replay --offline work; nodes name what is missing")


def main() -> int:
    """Build, install and use the wheel; return 0 if all of it works."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.chdir(folder)
        wheel = build(folder)
        programs = folder / "clean" / "bin"
        venv.create(folder / "clean", with_pip=True)
        run(programs / "python", "-m", "pip", "install", "-q", wheel)
        (package,) = (folder / "clean").glob("lib/python*/site-packages/magnetosuture_thread")
        copy_kernels(package)
        check_without_ros(programs)
        run(programs / "python", "-m", "pip", "install", "-q", f"{wheel}[ros]")
        # Three of them: CI starts all after the build by colcon.
        started = {name: f'exec "{programs / name}"' for name in ("scene_server", "thread_model", "coil_bridge")}
        return check_nodes(started, programs / "python", folder, 100)


if __name__ == "__main__":
    sys.exit(main())
