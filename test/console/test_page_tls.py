"""The page over TLS in a real browser."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from test.console.conftest import ServedConsole

pytestmark = pytest.mark.slow


@pytest.fixture
def over_tls(certificate: tuple[Path, Path]) -> Iterator[ServedConsole]:
    """Serve the page over TLS."""
    path, key = map(str, certificate)
    console = ServedConsole(certificate=path, private_key=key)
    console.url = console.run(console.server.start())
    yield console
    console.close()  # which holds that no connection is left open


def opened(browser: Browser, url: str) -> Page:
    """Return the page at an address whose certificate the person accepts."""
    page = browser.new_context(ignore_https_errors=True).new_page()
    page.goto(url)
    return page


def test_a_person_takes_control_and_stops_over_tls(browser: Browser, over_tls: ServedConsole):
    assert over_tls.url.startswith("https://127.0.0.1:")
    page = opened(browser, over_tls.url)
    expect(page.locator("#control")).to_be_enabled()
    page.click("#control")
    expect(page.locator("#control")).to_have_text("Release control")
    page.keyboard.press("Space")
    deadline = time.monotonic() + 15.0
    while "stop" not in over_tls.graph.actions:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    page.context.close()
