"""Makes `docs/pictures/console.png`: the operator's page with the hernia repair planned, before it runs.

The whole graph runs around the simulated rig, and a program presses the buttons in a browser without a window
(Chromium, which has to be installed). Run it from the top: python examples/console_picture.py
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

from playwright.sync_api import ViewportSize, sync_playwright

from benchmarks.page import BROWSERS

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "console.png"
SCREEN: ViewportSize = {"width": 1366, "height": 768}
WAIT = 240e3  # ms


@contextmanager
def served() -> Iterator[str]:
    """Run the command, and yield the page's address."""
    command = [sys.executable, "-m", "magnetosuture_thread.cli", "console", "hernia_ring", "--port", "0"]
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
        for button in ("control", "plan-procedure", "arm"):
            page.click(f"#{button}")
        page.wait_for_selector("#run-procedure:enabled")
        page.wait_for_timeout(3e3)  # for the plots
        page.screenshot(path=PICTURE)
        browser.close()


if __name__ == "__main__":
    main()
