"""Makes `docs/pictures/console.png`: the operator's page while the needle draws its thread around the hernia.

The whole graph runs around the simulated rig, and a program presses arrow keys in a browser without a window (Chromium,
which has to be installed). Run it from the top: python examples/console_picture.py
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Page, ViewportSize, sync_playwright

from benchmarks.page import BROWSERS

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "console.png"
SCREEN: ViewportSize = {"width": 1366, "height": 768}
WAIT = 240.0  # s; the needle is slow where it is narrow, and may need several goes
SPEED = 4e-3  # m/s
REACHED = 8e-4  # m; near enough to a point to go for the next
SETUPS = Path(__file__).parents[1] / "config"
CHANGES = {
    "needle_start": "[-0.002, -0.0084, -0.12]",
    "thread_start_curvature": "-62.5",
}
KEEP = 1.15  # of the way that the keys make which are held
LOOK = 25  # ms between two looks at the needle
RESTS = 1.5  # s at one place, with keys held, after which somebody backs off
BACKS_OFF = 0.7  # s, the first time; longer each time it did not help
SAME_PLACE = 1e-4  # m
PATH = ((0.0, -7.5e-3), (0.0, -2.6e-3))  # m; to the penetration path, and through
AROUND = ((-2.4e-3, -1.6e-3), (-5.3e-3, 0.6e-3))  # m; along the ring
NAMES = {(-1, 0): "ArrowLeft", (1, 0): "ArrowRight", (0, -1): "ArrowDown", (0, 1): "ArrowUp"}
WAYS = [(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]  # one arrow, or two


class Pilot:
    """Somebody before the page, who sees where the needle is and presses keys.

    Args:
        page: the operator's page, which has been opened.
    """

    def __init__(self, page: Page) -> None:
        self.page = page
        self._pressed: set[str] = set()
        self._way = WAYS[0]

    def shown(self, name: str) -> str:
        """Return what the drawing of the dish says of itself."""
        return str(self.page.get_attribute("#dish", f"data-{name}") or "")

    def tip(self) -> NDArray[np.float64]:
        """Return where the needle's tip is drawn [m]."""
        return np.array([float(entry) for entry in self.shown("tip").split(",")])

    def until(self, condition: Callable[[], Any], what: str) -> None:
        """Wait until a condition holds, the page going on meanwhile."""
        end = time.monotonic() + WAIT
        while not condition():
            if time.monotonic() > end:
                said = self.page.text_content("#notice"), self.page.inner_text("body")
                raise TimeoutError(f"waited for {what}; the page says {said}")
            self.page.wait_for_timeout(LOOK)

    def begin(self) -> None:
        """Take control and arm, when the needle is seen and the thread predicted."""
        self.until(lambda: self.shown("image") == "yes" and self.shown("tip"), "a camera image and the needle")
        self.until(lambda: self.shown("friction") in ("free", "sliding", "stuck"), "a prediction")
        self.page.click("#control")
        self.page.click("#arm")
        self.until(lambda: self.page.inner_text("#coils") == "armed", "the coils to be armed")

    def at_speed(self, speed: float) -> None:
        """Move the slider to a speed [m/s]."""
        self.page.fill("#speed", f"{1e3 * speed:.1f}")
        self.page.locator("#speed").blur()  # the slider has arrow keys of its own

    def press(self, *keys: str) -> None:
        """Hold these keys and no other."""
        for key in self._pressed - set(keys):
            self.page.keyboard.up(key)
        for key in set(keys) - self._pressed:
            self.page.keyboard.down(key)
        self._pressed = set(keys)

    def follow(self, points: Sequence[tuple[float, float]], enough: Callable[[], bool] = lambda: False) -> None:
        """Steer along points [m] until the last is reached or it is enough; the last keys stay held.

        Between needle, tissue and friction the safety filter can answer a command by rest. Then somebody backs off
        for a moment, straight or to either side, and tries again, as a person does.
        """
        left = list(points)
        place, since, back_until, goes = self.tip(), time.monotonic(), 0.0, 0

        def arrived() -> bool:
            nonlocal place, since, back_until, goes
            tip, now = self.tip(), time.monotonic()
            if np.linalg.norm(tip - place) > SAME_PLACE:
                place, since = tip, now
            while left and np.linalg.norm(left[0] - tip) < REACHED:
                left.pop(0)
            if not left or enough():
                return True
            if now - since > RESTS:
                goes += 1
                since = back_until = now + BACKS_OFF * (1.0 + 0.5 * goes)
            aim = left[0] - tip
            if now < back_until:
                x, y = -aim
                aside = (0.0, 1.0, -1.0)[goes % 3]
                aim = np.array([x - aside * y, y + aside * x])
            x, y = self._way = max(WAYS, key=lambda way: self._worth(way, aim))
            self.press(*(NAMES[one] for one in ((x, 0), (0, y)) if one in NAMES))
            return False

        self.until(arrived, f"the needle to reach {points[-1]}")

    def _worth(self, way: tuple[int, int], aim: NDArray[np.float64]) -> float:
        """Return how well keys lead to where one wants to go; those that are held are kept a little longer."""
        return float(aim @ way / np.hypot(*way)) * (KEEP if way == self._way else 1.0)


def nearby(folder: Path) -> Path:
    """Write the setup with a needle that begins below the penetration path."""
    text = (SETUPS / "hernia_ring.yaml").read_text()
    for name, value in CHANGES.items():
        text, changes = re.subn(rf"(\n    {name}): .*", rf"\1: {value}", text)
        if changes != 1:
            raise ValueError(f"hernia_ring.yaml has {changes} lines {name}, expected 1")
    path = folder / "hernia_ring.yaml"
    path.write_text(text)
    return path


@contextmanager
def served(setup: Path) -> Iterator[str]:
    """Run the command with a setup, and yield the page's address."""
    command = [sys.executable, "-m", "magnetosuture_thread.cli", "console", str(setup), "--port", "0"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None
        try:
            yield next(found[1] for line in process.stdout if (found := re.search(r"open (http://\S+)", line)))
        finally:
            process.send_signal(signal.SIGINT)


def main() -> None:
    """Take the picture anew."""
    path = next(found for name in BROWSERS if (found := shutil.which(name)))
    with (
        TemporaryDirectory() as folder,
        served(nearby(Path(folder))) as address,
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        page = browser.new_page(viewport=SCREEN, color_scheme="light")
        page.goto(address)
        pilot = Pilot(page)
        pilot.begin()
        pilot.at_speed(SPEED)
        pilot.follow(PATH)
        pilot.follow(AROUND)
        pilot.until(lambda: "Slowed to" in page.inner_text("#status"), "the needle to be slowed by friction")
        page.screenshot(path=PICTURE)
        pilot.press()
        browser.close()


if __name__ == "__main__":
    main()
