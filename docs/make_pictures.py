"""Makes the pictures of the documentation, each by the command that a reader would run.

    python docs/make_pictures.py NAME...

All of them are simulated. `data_flow.svg` is drawn by hand.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from procedure_animation import draw_procedure

ROOT = Path(__file__).parents[1]
PICTURES = ROOT / "docs" / "pictures"
BAG = ROOT / "examples" / "post_wrap"
FRAMES = ("usual", "cover_3mm", "crossing_itself", "hand_instrument", "glare_thread", "tilt_10deg")
TILE = (480, 360)  # pixels of a frame in a picture of several


def run(*words: str | Path, folder: Path = ROOT) -> None:
    """Run `magnetosuture` or Python, and end where it fails."""
    subprocess.run([sys.executable, *map(str, words)], cwd=folder, check=True)


def magnetosuture(*words: str | Path) -> None:
    """Run a command of the package."""
    run("-m", "magnetosuture_thread.cli", *words)


def demo(folder: Path) -> Path:
    """Return the picture of a replay without a graph."""
    magnetosuture("replay", BAG, "--offline", "--output", folder / "replay")
    return (folder / "replay" / "summary.png").rename(folder / "demo.png")


def frames(folder: Path) -> Path:
    """Return rendered frames with what the tracker finds in them."""
    (folder / "frames").mkdir()
    for name in FRAMES:
        run("-m", "benchmarks", "vision", "--save", name, "1", folder / "frames" / f"{name}.png")
    magnetosuture("track", folder / "frames", "--setup", "petri_35mm_polyamide", "--overlay", folder / "drawn")
    tiles = []
    for name in FRAMES:
        drawn = cv2.imread(str(folder / "drawn" / f"{name}.png"))
        assert drawn is not None
        tiles.append(cv2.resize(drawn, TILE, interpolation=cv2.INTER_AREA))
    cv2.imwrite(str(folder / "frames.jpg"), np.vstack([np.hstack(tiles[:3]), np.hstack(tiles[3:])]))
    return folder / "frames.jpg"


def calibration(folder: Path) -> Path:
    """Return the picture of the tutorial's fit."""
    magnetosuture("calibrate", BAG, "--parameters", "elastic_modulus", "--output", folder / "thread.yaml")
    return (folder / "thread.png").rename(folder / "calibration.png")


def own_barrier(folder: Path) -> Path:
    """Return what the tutorial's own program draws."""
    text = (ROOT / "docs" / "tutorials" / "own_barrier.md").read_text(encoding="utf-8")
    for name, code in re.findall(r"^<!-- file: (\S+) -->\n```\w+\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
        (folder / name).write_text(code, encoding="utf-8")
    run("with_barrier.py", folder=folder)
    return folder / "own_barrier.png"


def behaviour(folder: Path) -> Path:
    """Return the paper's thread-behavior tests in closed loop."""
    magnetosuture("reproduce", "thread-behavior", "--output", folder / "behaviour")
    return folder / "behaviour" / "behaviour.png"


def hernia(folder: Path) -> Path:
    """Return the paper's hernia repair, replayed in the thread model."""
    magnetosuture("reproduce", "hernia", ROOT / "examples" / "hernia_steering", "--output", folder / "hernia")
    return folder / "hernia" / "hernia.png"


def hernia_animation(folder: Path) -> Path:
    """Return the same as an animation."""
    bag = ROOT / "examples" / "hernia_steering"
    magnetosuture("reproduce", "hernia", bag, "--output", folder / "hernia", "--animation")
    return folder / "hernia" / "hernia.gif"


def autonomous_hernia(folder: Path) -> Path:
    """Return the hernia repair by a procedure on the whole graph, over frames of its camera."""
    magnetosuture("simulate", "hernia_ring", "--procedure", "hernia", "--output", folder / "bag")
    draw_procedure(folder / "bag", "hernia_ring", folder / "autonomous_hernia.gif")
    return folder / "autonomous_hernia.gif"


def console(folder: Path) -> Path:
    """Return the operator page of the whole graph; the example writes it to its place by itself."""
    run(ROOT / "examples" / "console_picture.py")
    return Path(shutil.copy(PICTURES / "console.png", folder))


MAKERS: dict[str, Callable[[Path], Path]] = {
    maker.__name__: maker
    for maker in (
        demo,
        frames,
        calibration,
        own_barrier,
        behaviour,
        hernia,
        hernia_animation,
        autonomous_hernia,
        console,
    )
}


def main(names: list[str]) -> None:
    """Make the pictures of these names."""
    for name in names:
        with TemporaryDirectory() as folder:
            made = MAKERS[name](Path(folder))
            print("made", shutil.copy(made, PICTURES / made.name))


if __name__ == "__main__":
    if not sys.argv[1:] or not set(sys.argv[1:]) <= set(MAKERS):
        sys.exit(f"name some of: {', '.join(MAKERS)}")
    main(sys.argv[1:])
