"""The page over TLS in a real browser."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Error, Page, expect

from test.console.conftest import ServedConsole


@pytest.fixture
def over_tls(certificate: tuple[Path, Path]) -> Iterator[ServedConsole]:
    """Serve the page over TLS."""
    path, key = map(str, certificate)
    console = ServedConsole(certificate=path, private_key=key)
    console.url = console.run(console.server.start())
    yield console
    console.close()


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


def test_without_the_token_one_only_watches_over_tls_too(browser: Browser, over_tls: ServedConsole):
    page = opened(browser, over_tls.url.split("#")[0])
    page.wait_for_function("() => window.console_stats.states > 0")
    expect(page.locator("#control")).to_be_disabled()
    page.context.close()


def test_a_browser_refuses_a_certificate_that_nobody_vouches_for(browser: Browser, over_tls: ServedConsole):
    page = browser.new_context().new_page()
    with pytest.raises(Error, match="ERR_CERT_AUTHORITY_INVALID"):
        page.goto(over_tls.url)
    page.context.close()
