"""The operator's page of the command, in a real browser, on the whole graph around the simulated rig."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from examples.console_picture import AROUND, PATH, SCREEN, SPEED, WAIT, Pilot, nearby
from magnetosuture_thread.nodes.clients import Inbox
from test.console.conftest import browser
from test.jobs.test_console import running, wire

__all__ = ["browser"]

pytestmark = [pytest.mark.whole_graph, pytest.mark.slow]

DRIFT = 1.8e-4  # m/s; at rest the needle may still be pulled by its thread: 0.1 mm in eleven frames at 20 Hz


@dataclass
class Bench:
    """Somebody before the page, and what goes to the simulated coils."""

    pilot: Pilot
    currents: Inbox
    complaints: list[str]

    @property
    def page(self) -> Page:
        """Return the page."""
        return self.pilot.page

    def says(self, name: str, words: str) -> None:
        """Wait until the page says something."""
        self.pilot.until(lambda: words in self.page.inner_text(f"#{name}"), f"{name} to say {words}")

    def without_current(self) -> None:
        """Wait until ten messages on the wire after each other hold no current."""
        row: list[bool] = []

        def enough() -> bool:
            row.extend(not any(message.current) for message, _ in self.currents.read())
            return len(row) >= 10 and all(row[-10:])

        self.pilot.until(enough, "coils without a current")

    def with_current(self) -> None:
        """Wait until a current is on the wire."""
        list(self.currents.take())
        self.pilot.until(lambda: any(any(message.current) for message, _ in self.currents.read()), "a current")

    def frames(self) -> int:
        """Return how many camera frames the page has got."""
        return int(self.page.evaluate("window.console_stats.frames"))

    def under_friction(self) -> int:
        """Return how many nodes the page says are under friction."""
        found = re.search(r"(\d+) node", self.page.inner_text("#friction"))
        return int(found[1]) if found else 0

    def rests(self) -> None:
        """Wait until the needle, without a current, moves no more than its thread draws it, over five camera frames."""
        self.without_current()
        before, since, seen = self.pilot.tip(), time.monotonic(), self.frames()

        def still() -> bool:
            nonlocal before, since, seen
            elapsed = time.monotonic() - since
            if elapsed < 0.5 or self.frames() < seen + 5:
                return False
            moved = float(np.linalg.norm(self.pilot.tip() - before))
            before, since, seen = self.pilot.tip(), time.monotonic(), self.frames()
            return moved < DRIFT * elapsed

        self.pilot.until(still, "the needle to rest")

    def pull_until_stuck(self) -> None:
        """Pull the thread around until it stays where it is; one that slips back is pulled again."""
        end = time.monotonic() + WAIT
        while self.pilot.shown("friction") != "stuck":
            assert time.monotonic() < end, "the thread slips back each time"
            self.pilot.follow(AROUND, lambda: self.under_friction() >= 3)
            self.pilot.press()
            self.pilot.until(lambda: self.pilot.shown("friction") != "sliding", "the thread to rest or to slip back")

    def colour_of_thread(self) -> list[int]:
        """Return how many pixels of the dish have the thread's colour, as it is said and drawn."""
        return list(
            self.page.evaluate(
                """() => {
                    const canvas = document.getElementById("dish");
                    const wanted = canvas.dataset.colour.match(/\\w\\w/g).map((entry) => parseInt(entry, 16));
                    const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d");
                    copy.drawImage(canvas, 0, 0);
                    const data = copy.getImageData(0, 0, canvas.width, canvas.height).data;
                    let count = 0;
                    for (let at = 0; at < data.length; at += 4)
                        if (wanted.every((entry, which) => Math.abs(entry - data[at + which]) < 6)) count += 1;
                    return [count, ...wanted];
                }"""
            )
        )


@pytest.fixture(scope="module")
def bench(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Run the command, and open its page."""
    with running(str(nearby(tmp_path_factory.mktemp("setup")))) as console:
        domain = int(console.find(r"ROS domain (\d+)"))
        url = console.find(r"open (http://\S+)$")
        with wire(domain) as currents:
            page = browser.new_page(viewport=SCREEN, color_scheme="light")
            complaints: list[str] = []
            page.on("console", lambda message: complaints.append(f"{message.type}: {message.text}"))
            page.on("pageerror", lambda error: complaints.append(str(error)))
            page.on("requestfailed", lambda request: complaints.append(f"{request.url} failed"))
            page.on("response", lambda response: complaints.append(response.url) if response.status >= 400 else None)
            page.goto(url)
            yield Bench(Pilot(page), currents, complaints)
            page.close()
        assert console.end() == 0


def light_and_dark(page: Page, folder: Path, name: str) -> None:
    """Leave pictures for a person to look at."""
    page.screenshot(path=folder / f"{name}_light.png")
    page.emulate_media(color_scheme="dark")
    page.screenshot(path=folder / f"{name}_dark.png")
    page.emulate_media(color_scheme="light")


def test_a_person_steers_around_the_hernia_by_keys(bench: Bench, tmp_path: Path):
    pilot, page = bench.pilot, bench.page
    pilot.begin()
    assert bench.complaints == []
    assert bench.frames() > 0

    before = pilot.tip()
    pilot.press("ArrowRight")
    pilot.until(lambda: pilot.tip()[0] - before[0] > 1e-3, "the needle to move to the right")
    right, up = pilot.tip() - before
    assert abs(up) < right  # it turns a little while the thread begins to follow
    expect(page.locator("#dish")).to_have_attribute("data-ghosts", "3")  # by the graph's own forecasts
    pilot.press()
    bench.rests()

    pilot.at_speed(SPEED)
    pilot.follow(PATH)
    pilot.follow(AROUND, lambda: pilot.shown("friction") == "sliding" and "Slowed to" in page.inner_text("#status"))
    count, red, green, blue = bench.colour_of_thread()
    assert count > 50
    assert red > green > blue  # orange
    light_and_dark(page, tmp_path, "sliding")
    stuck = False
    while not stuck:  # the thread may slip back before its colour is read
        bench.pull_until_stuck()
        count, red, green, blue = bench.colour_of_thread()
        stuck = pilot.shown("friction") == "stuck"
    assert count > 50
    assert blue > green > red
    bench.says("friction", "stuck")

    pilot.press("ArrowLeft")
    bench.with_current()
    page.keyboard.press("Space")
    bench.says("headline", "Emergency stop is pressed")
    bench.without_current()
    expect(page.locator("#arm")).to_be_disabled()
    pilot.press()
    page.click("#reset")
    page.click("#arm")
    bench.says("coils", "armed")
    pilot.press("ArrowRight")
    bench.with_current()
    pilot.press()
    assert bench.complaints == []


def test_a_dropped_connection_stops_the_needle(bench: Bench):
    pilot, page = bench.pilot, bench.page
    pilot.press("ArrowUp")
    bench.with_current()
    page.context.set_offline(True)
    bench.without_current()
    page.context.set_offline(False)
    pilot.until(lambda: pilot.shown("tip"), "the needle to be seen")
    bench.rests()
    pilot.press()
    assert page.evaluate("window.console_stats.errors") == 0
