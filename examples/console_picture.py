"""Makes `docs/pictures/console.png`: the operator's page while the needle draws its thread around the hernia.

The whole graph runs around the simulated rig, at half speed, and a program presses the buttons of a procedure in a
browser without a window (Chromium, which has to be installed). Run it from the top: python examples/console_picture.py
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from playwright.sync_api import ViewportSize, sync_playwright

from benchmarks.page import BROWSERS

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "console.png"
SETUP = Path(__file__).parents[1] / "config" / "hernia_ring.yaml"
SCREEN: ViewportSize = {"width": 1366, "height": 768}
WAIT = 240e3  # ms


@contextmanager
def served() -> Iterator[str]:
    """Run the command with the setup at half speed, and yield the page's address."""
    with TemporaryDirectory() as folder:
        setup = Path(folder) / SETUP.name
        setup.write_text(SETUP.read_text().replace("    frame_rate:", "    rate: 0.5\n    frame_rate:"))
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
    with served() as address, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        page = browser.new_page(viewport=SCREEN, color_scheme="light")
        page.set_default_timeout(WAIT)
        page.goto(address)
        for button in ("control", "plan-procedure", "arm", "run-procedure"):
            page.click(f"#{button}")
        # Through the channel, and on around the ring.
        page.wait_for_function("document.getElementById('goals').textContent.startsWith('✓')")
        page.wait_for_timeout(20e3)
        page.screenshot(path=PICTURE)
        browser.close()


if __name__ == "__main__":
    main()
