"""The page over TLS in a real browser."""

from __future__ import annotations

import socket
import ssl
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


@pytest.mark.parametrize("last_header", ["Connection: close", "Connection: keep-alive"])
def test_stopping_closes_a_connection_that_the_browser_does_not_close(over_tls: ServedConsole, last_header: str):
    port = int(over_tls.url.split(":")[2].split("/")[0])
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with socket.create_connection(("127.0.0.1", port)) as plain, context.wrap_socket(plain) as encrypted:
        encrypted.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n{last_header}\r\n\r\n".encode())
        assert encrypted.recv(15) == b"HTTP/1.1 200 OK"
        over_tls.run(over_tls.server.stop())
        over_tls.run(over_tls.all_closed())
