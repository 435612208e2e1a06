"""Measures the time from a key press to the velocity at the bridge, and the page's pictures."""

from __future__ import annotations

import random
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import yaml

from benchmarks.page.report import KeyDelays, PageReport
from magnetosuture_thread.configuration import read_yaml
from magnetosuture_thread.errors import ConfigurationError, GraphError
from magnetosuture_thread.interface import NEEDLE_COMMAND, NEEDLE_SETPOINT, OPERATOR_COMMAND
from magnetosuture_thread.setups import read_setup

if TYPE_CHECKING:
    from playwright.sync_api import Page

SETUP = "petri_35mm_polyamide"
SEGMENTS, FRAME_RATE = 81, 30.0  # in place of the scenario's own
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
WIDTH, HEIGHT = 1366, 768  # of the page [px]
TIMEOUT = 240.0  # s for the graph to be there; the first start on a machine compiles
HELD, LET_GO = 0.25, 0.35  # s that a key is held, and not held, on average
KEYS = (("ArrowRight", "ArrowLeft"), ("ArrowUp", "ArrowDown"))  # by axis; the second where the tip is beyond 0
GRACE = 20.0  # s for the command to end
LISTEN = "() => { window.bench_keys = []; addEventListener('keydown', (event) => { if (!event.repeat)"
LISTEN += " window.bench_keys.push(performance.timeOrigin + event.timeStamp); }, true); }"

Log = Callable[[str], None]
Times = dict[str, list[float]]


class Server:
    """The command `magnetosuture console`, running.

    Args:
        scenario: of the simulated rig.
    """

    def __init__(self, scenario: str) -> None:
        command = [sys.executable, "-m", "magnetosuture_thread.cli", "console", scenario, "--port", "0"]
        self._process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
        )
        self._lines: list[str] = []
        self._reading = threading.Thread(target=self._read, daemon=True)
        self._reading.start()

    def says(self, pattern: str) -> str:
        """Wait for a line, and return what the pattern's group holds.

        Raises:
            GraphError: the command ended, or says no such thing.
        """
        deadline = time.monotonic() + TIMEOUT
        while time.monotonic() < deadline:
            if found := re.search(pattern, "\n".join(self._lines)):
                return found[1]
            if self._process.poll() is not None:
                raise GraphError(f"the console ended: {self._lines[-1] if self._lines else 'it said nothing'}")
            time.sleep(0.05)
        raise GraphError(f"after {TIMEOUT:g} s the console is not ready: {self._lines[-1:]}")

    def end(self) -> None:
        """Press Ctrl-C."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(GRACE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reading.join()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.append(line.rstrip())


def measure_page(
    presses: int, log: Log = lambda text: None, progress: Callable[[float], None] = lambda share: None
) -> PageReport:
    """Press keys in a browser without a window, on the page of the whole graph around the simulated rig.

    Args:
        presses: of a key.
        log: called with a line for a person at each stage.
        progress: called with the share done, 0 to 1.

    Raises:
        ConfigurationError: the browser, or what drives it, is not installed.
        GraphError: the graph does not start, or moves nothing.
    """
    browser = _browser()
    log(f"starting {SETUP} with {SEGMENTS} segments and {FRAME_RATE:g} frames a second, and a browser")
    with TemporaryDirectory() as folder, _serving(Path(folder)) as server:
        domain = int(server.says(r"ROS domain (\d+)"))
        url = server.says(r"open (http\S+)")
        server.says(r"(runs; the coils)")
        with _page(browser, url) as page, _heard(domain) as heard:
            _click(page, "#control")
            _click(page, "#arm")
            page.evaluate(LISTEN)
            began, before = time.monotonic(), _stats(page)
            _press(page, presses, progress)
            after, took = _stats(page), time.monotonic() - began
            keys = [float(stamp) * 1e-3 for stamp in page.evaluate("() => window.bench_keys")]
    if not all(heard.values()):
        raise GraphError("no key moved the needle")
    rates = {name: (after[name] - before[name]) / took for name in ("drawn", "states", "frames")}
    delays = [KeyDelays.between(words, keys, heard[channel.recorded]) for channel, words in _STATIONS]
    return PageReport(SETUP, SEGMENTS, tuple(delays), rates["drawn"], rates["states"], rates["frames"])


@contextmanager
def _serving(folder: Path) -> Iterator[Server]:
    """Run the command with the scenario that is measured."""
    content = read_yaml(read_setup(SETUP).path, "setup file")
    content["/**/thread_model"]["ros__parameters"]["segments"] = SEGMENTS
    content["/**/rig_simulator"]["ros__parameters"]["frame_rate"] = FRAME_RATE
    path = folder / f"{SETUP}.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    server = Server(str(path))
    try:
        yield server
    finally:
        server.end()


_STATIONS = (
    (OPERATOR_COMMAND, "the page's wish in the graph"),
    (NEEDLE_SETPOINT, "the filtered velocity at the bridge"),
)


def _press(page: Page, presses: int, progress: Callable[[float], None]) -> None:
    """Hold a key, and let it go, again and again; at random times, so that they meet every phase of all loops.

    Each leads the needle towards the dish's centre: at the wall nothing would move.
    """
    chance = random.Random(1)
    for done in range(presses):
        tip = [float(entry) for entry in (page.get_attribute("#dish", "data-tip") or "0,0").split(",")]
        axis = done % 2
        key = KEYS[axis][int(tip[axis] > 0.0)]
        page.keyboard.down(key)
        time.sleep(HELD * chance.uniform(0.8, 1.2))
        page.keyboard.up(key)
        time.sleep(LET_GO * chance.uniform(0.8, 1.2))
        progress((done + 1) / presses)


def _click(page: Page, what: str) -> None:
    page.locator(f"{what}:enabled").click(timeout=1e3 * TIMEOUT)


def _stats(page: Page) -> dict[str, Any]:
    return dict(page.evaluate("() => ({ ...window.console_stats })"))


def _browser() -> str:
    """Return the browser's program."""
    found = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if found is None:
        raise ConfigurationError("browser", "none found", f"one of {', '.join(BROWSERS)}: apt install chromium")
    return found


@contextmanager
def _page(browser: str, url: str) -> Iterator[Page]:
    """Open a page in a browser without a window."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise ConfigurationError(
            "playwright", "not installed", "what drives the browser: pip install playwright"
        ) from None
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        try:
            page = started.new_page(viewport={"width": WIDTH, "height": HEIGHT})
            page.goto(url)
            yield page
        finally:
            started.close()


@contextmanager
def _heard(domain: int) -> Iterator[Times]:
    """Give the times [s] at which a velocity that is not zero was sent on each topic, filled when the block ends.

    By the senders' stamps: when we hear of it is no concern of the coils. A wish that got lost on its way to us is
    known by the command that followed from it, which keeps its stamp.
    """
    from magnetosuture_thread.messages.cdr import header_stamp
    from magnetosuture_thread.nodes import topics
    from magnetosuture_thread.nodes.processes import environment_of, graph_environment
    from magnetosuture_thread.nodes.recorder import Recorder

    taken = [topics.OPERATOR_COMMAND, topics.NEEDLE_COMMAND, topics.NEEDLE_SETPOINT]
    came: list[tuple[str, bytes]] = []
    with environment_of(graph_environment(domain)):
        recorder = Recorder(
            domain, taken, simulated_clock=False, receive=lambda topic, _, data: came.append((topic, data))
        )
    times: Times = {channel.recorded: [] for channel, _ in _STATIONS}
    over = threading.Event()

    def listen() -> None:
        while not over.is_set():
            recorder.spin(0.05)

    thread = threading.Thread(target=listen)
    thread.start()
    try:
        yield times
    finally:
        over.set()
        thread.join()
        recorder.close()
        for topic, data in came:
            stamp = header_stamp(data)
            linear = topics.NEEDLE_COMMAND.decode(data).twist.linear
            if stamp is not None and (linear.x or linear.y):
                times[OPERATOR_COMMAND.recorded if topic == NEEDLE_COMMAND.recorded else topic].append(stamp * 1e-9)
        for found in times.values():
            found.sort()
