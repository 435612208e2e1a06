"""Time the operator's page in Chromium without a window, on the whole graph around the simulated rig.

From a key press to the filtered velocity at the bridge, and the pictures that the page draws, with 81 segments;
by the stamps of who sends. Needs chromium and playwright. Takes three minutes.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from benchmarks.report import figures_table
from magnetosuture_thread.commands.command import Terminal, whole_number
from magnetosuture_thread.rig.setups import read_setup
from magnetosuture_thread.settings.configuration import read_yaml
from magnetosuture_thread.settings.errors import ConfigurationError, GraphError
from magnetosuture_thread.settings.interface import NEEDLE_COMMAND, NEEDLE_SETPOINT, OPERATOR_COMMAND

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SETUP, SEGMENTS, FRAME_RATE = "petri_35mm_polyamide", 81, 30.0  # the latter in place of the setup's own
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
TIMEOUT = 240.0  # s for the graph to be there; the first start on a machine compiles
GRACE = 90.0  # s for the command to end
KEYS = (("ArrowRight", "ArrowLeft"), ("ArrowUp", "ArrowDown"))  # by axis; the second where the tip is beyond 0
STATIONS = {OPERATOR_COMMAND: "the page's command in the graph", NEEDLE_SETPOINT: "the filtered velocity at the bridge"}
LISTEN = """() => { window.bench_keys = []; addEventListener('keydown', (event) => {
    if (!event.repeat) window.bench_keys.push(performance.timeOrigin + event.timeStamp); }, true); }"""


def key_delays(station: str, keys: Sequence[float], moving: Sequence[float]) -> dict[str, Any]:
    """Return the times from each key press to the first velocity after it: median, p99 and greatest [ms].

    `count` is of those that were answered, `lost` of the others.

    Args:
        station: where the velocity came.
        keys: when a key was pressed, rising [s].
        moving: when a velocity that is not zero came, rising [s]; at least one within a second of a key.
    """
    delays = np.append(moving, np.inf)[np.searchsorted(moving, keys)] - np.asarray(keys)
    answered = 1e3 * delays[delays < 1.0]  # s; after which no velocity counts as its answer
    median, p99, greatest = np.percentile(answered, [50.0, 99.0, 100.0]).tolist()
    figures = {"station": station, "count": len(answered), "lost": len(keys) - len(answered)}
    return {**figures, "median": median, "p99": p99, "greatest": greatest}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--presses", type=whole_number, default=200, metavar="N", help="of a key (default: 200)")


def run(options: argparse.Namespace, terminal: Terminal) -> tuple[dict[str, Any], bool]:
    """Time the page; return the figures."""
    log = terminal.log
    log(f"starting {SETUP} with {SEGMENTS} segments and {FRAME_RATE:g} frames a second, and a browser")
    with terminal.progress("page") as advance:
        delays, rates = _measure(options.presses, advance)
    columns = {"": "{station}", **{name: f"{{{name}:.1f}}" for name in ("median", "p99", "greatest")}}
    columns |= {"keys": "{count}", "lost": "{lost}"}
    title = f"operator's page, simulated rig, n = {SEGMENTS}; ms from a key press"
    terminal.print(figures_table(title, delays, columns))
    log(f"limit: 50 ms at the bridge, 99th percentile; {FRAME_RATE:g} pictures a second")
    log("the page drew {drawn:.1f} pictures a second, of {states:.1f} states and {frames:.1f} frames".format(**rates))
    return {"scenario": SETUP, "segments": SEGMENTS, "delays": delays, **rates}, True


def _measure(presses: int, progress: Callable[[float], None]) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """Press keys in a browser on the page; return the delays, and pictures, states and frames a second.

    Raises:
        ConfigurationError: the browser, or what drives it, is not installed.
        GraphError: the graph does not start, or moves nothing.
    """
    content = read_yaml(read_setup(SETUP).path, "setup file")
    content["/**/thread_model"]["ros__parameters"]["segments"] = SEGMENTS
    content["/**/rig_simulator"]["ros__parameters"]["frame_rate"] = FRAME_RATE
    with TemporaryDirectory() as folder, ExitStack() as stack:
        path = Path(folder) / f"{SETUP}.yaml"
        path.write_text(yaml.safe_dump(content), encoding="utf-8")
        server = stack.enter_context(running_console(str(path)))
        domain, url = int(server.find(r"ROS domain (\d+)")), server.find(r"open (http\S+)")
        server.find(r"(runs; the coils)")
        browser, sent = stack.enter_context(started_browser()), stack.enter_context(_sent(domain))
        page = browser.new_page(viewport={"width": 1366, "height": 768})
        page.goto(url)
        for button in ("#control", "#arm"):
            page.locator(f"{button}:enabled").click(timeout=1e3 * TIMEOUT)
        page.evaluate(LISTEN)
        began, before = time.monotonic(), dict(page.evaluate("() => ({ ...window.console_stats })"))
        _press(page, presses, progress)
        after, took = dict(page.evaluate("() => ({ ...window.console_stats })")), time.monotonic() - began
        keys = [float(stamp) * 1e-3 for stamp in page.evaluate("() => window.bench_keys")]
    if not all(sent.values()):
        raise GraphError("no key moved the needle")
    delays = [key_delays(words, keys, sent[channel.recorded]) for channel, words in STATIONS.items()]
    return delays, {name: (after[name] - before[name]) / took for name in ("drawn", "states", "frames")}


@dataclass
class RunningCommand:
    """The command `magnetosuture`, running; what it prints goes to files."""

    process: subprocess.Popen[bytes]
    output: Path
    errors: Path

    def find(self, pattern: str) -> str:
        """Wait for a line, and return what the pattern's group holds.

        Raises:
            GraphError: the command ended, or prints no such line.
        """
        deadline = time.monotonic() + TIMEOUT
        while time.monotonic() < deadline and self.process.poll() is None:
            if match := re.search(pattern, self.output.read_text(), re.MULTILINE):
                return match[1]
            time.sleep(0.02)
        shown = self.output.read_text() + self.errors.read_text()
        raise GraphError(f"the command ended, or shows no {pattern} after {TIMEOUT:g} s: {shown}")

    def end(self, by: signal.Signals = signal.SIGINT) -> int:
        """Press Ctrl-C, or send another signal; return the exit code."""
        self.process.send_signal(by)
        try:
            return self.process.wait(GRACE)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()


@contextmanager
def running(
    *arguments: object, cwd: Path | None = None, environment: Mapping[str, str] | None = None
) -> Iterator[RunningCommand]:
    """Run the command; end it at the end if it has not."""
    command = [sys.executable, "-u", "-m", "magnetosuture_thread.cli", *map(str, arguments)]
    env = {**os.environ, **(environment or {})}
    with TemporaryDirectory() as folder, ExitStack() as stack:
        out, err = (stack.enter_context(Path(folder, name).open("wb")) for name in ("output", "errors"))
        process = subprocess.Popen(
            command,
            stdout=out,
            stderr=err,
            cwd=cwd,
            env=env,
            start_new_session=True,  # Ctrl-C at a terminal is not for it
            # What runs in a shell's background inherits an ignored SIGINT; a user's terminal does not.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        started = RunningCommand(process, Path(out.name), Path(err.name))
        try:
            yield started
        finally:
            if process.poll() is None:
                started.end()


def running_console(*arguments: str, **environment: str) -> AbstractContextManager[RunningCommand]:
    """Run `magnetosuture console` on a free port."""
    return running("console", *arguments, "--port", "0", environment=environment)


def _press(page: Page, presses: int, progress: Callable[[float], None]) -> None:
    """Hold a key, and release it, again and again; at random times, so that they meet every phase of all loops.

    Each leads the needle towards the dish's centre: at the wall nothing would move.
    """
    chance = random.Random(1)
    for done in range(presses):
        tip = [float(entry) for entry in (page.get_attribute("#dish", "data-tip") or "0,0").split(",")]
        key = KEYS[done % 2][int(tip[done % 2] > 0.0)]
        page.keyboard.down(key)
        time.sleep(0.25 * chance.uniform(0.8, 1.2))
        page.keyboard.up(key)
        time.sleep(0.35 * chance.uniform(0.8, 1.2))
        progress((done + 1) / presses)


@contextmanager
def started_browser() -> Iterator[Browser]:
    """Start a browser without a window."""
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        raise ConfigurationError("browser", "none found", f"one of {', '.join(BROWSERS)}: apt install chromium")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        expected = "what drives the browser: pip install playwright"
        raise ConfigurationError("playwright", "not installed", expected) from None
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        try:
            yield started
        finally:
            started.close()


@contextmanager
def _sent(domain: int) -> Iterator[dict[str, list[float]]]:
    """Yield the times [s] at which a velocity that is not zero was sent on each topic, filled when the block ends.

    By the senders' stamps: when we hear of it does not matter to the coils. A command that got lost on its way to us
    is known by the needle command that followed from it, which keeps its stamp.
    """
    from magnetosuture_thread.bags.reading import header_stamp
    from magnetosuture_thread.nodes import topics
    from magnetosuture_thread.nodes.clients import Recorder
    from magnetosuture_thread.nodes.processes import environment_of, graph_environment

    taken = [topics.OPERATOR_COMMAND, topics.NEEDLE_COMMAND, topics.NEEDLE_SETPOINT]
    times: dict[str, list[float]] = {channel.recorded: [] for channel in STATIONS}

    def receive(topic: str, arrival: int, data: bytes) -> None:
        stamp = header_stamp(data)
        linear = topics.NEEDLE_COMMAND.decode(data).twist.linear
        if stamp is not None and (linear.x or linear.y):
            times[OPERATOR_COMMAND.recorded if topic == NEEDLE_COMMAND.recorded else topic].append(stamp * 1e-9)

    with environment_of(graph_environment(domain)):
        recorder = Recorder(domain, taken, simulated_clock=False, receive=receive)
    over = threading.Event()

    def listen() -> None:
        while not over.is_set():
            recorder.spin(0.05)

    listener = threading.Thread(target=listen)
    listener.start()
    try:
        yield times
    finally:
        over.set()
        listener.join()
        recorder.close()
        for stamps in times.values():
            stamps.sort()
