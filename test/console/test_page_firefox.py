"""The operator's page in Firefox: a key that is released always stops the needle there too."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from test.console.conftest import ServedConsole

pytestmark = pytest.mark.slow

WAIT_TIMEOUT = 60.0  # [s]
UP, SPACE = "\ue013", " "
REST, NORTH = (0.0, 0.0), pytest.approx((0.0, 0.003), abs=1e-9)


def until(condition: Callable[[], Any]) -> Any:
    """Wait until a condition holds, and return what it gave."""
    end = time.monotonic() + WAIT_TIMEOUT
    while not (result := condition()):
        assert time.monotonic() < end, "the condition has not come true"
        time.sleep(0.02)
    return result


class Firefox:
    """Firefox without a window, driven by its own protocol, Marionette: JSON after its length, on a local port."""

    def __init__(self, program: str, profile: Path) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        (profile / "user.js").write_text(f'user_pref("marionette.port", {port});\n')
        command = [program, "--headless", "--marionette", "--no-remote", "--profile", str(profile)]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self._count = 0
        self._socket = until(lambda: self._connected(port))
        self._answer()
        self.call("WebDriver:NewSession")

    def _connected(self, port: int) -> socket.socket | None:
        try:
            return socket.create_connection(("127.0.0.1", port), WAIT_TIMEOUT)
        except ConnectionError:
            return None

    def _answer(self) -> Any:
        length = b""
        while not length.endswith(b":"):
            length += self._socket.recv(1)
        text = b""
        while len(text) < int(length[:-1]):
            text += self._socket.recv(int(length[:-1]) - len(text))
        return json.loads(text)

    def call(self, command: str, **parameters: Any) -> Any:
        """Execute a command, and return its result."""
        self._count += 1
        text = json.dumps([0, self._count, f"{command}", parameters]).encode()
        self._socket.sendall(b"%d:%b" % (len(text), text))
        _, _, error, result = self._answer()
        assert error is None, error
        return result

    def run(self, script: str) -> Any:
        """Run a script in the page, and return its value."""
        return self.call("WebDriver:ExecuteScript", script=script, args=[])["value"]

    def act(self, kind: str, *actions: dict[str, Any]) -> None:
        """Use the keyboard (`key`) or the mouse (`pointer`)."""
        self.call("WebDriver:PerformActions", actions=[{"type": kind, "id": kind, "actions": list(actions)}])

    def key(self, what: str, value: str) -> None:
        """Press (`keyDown`) or release (`keyUp`) a key."""
        self.act("key", {"type": what, "value": value})

    def click(self, selector: str, button: int = 0) -> None:
        """Click on an element."""
        box = f"const box = document.querySelector('{selector}').getBoundingClientRect();"
        x, y = self.run(f"{box} return [Math.round(box.x + box.width / 2), Math.round(box.y + box.height / 2)];")
        pressed = [{"type": kind, "button": button} for kind in ("pointerDown", "pointerUp")]
        self.act("pointer", {"type": "pointerMove", "x": x, "y": y}, *pressed)

    def close(self) -> None:
        """End the browser."""
        self._socket.close()
        self.process.terminate()
        self.process.wait(WAIT_TIMEOUT)


@pytest.fixture
def firefox(tmp_path: Path, served: ServedConsole) -> Iterator[Firefox]:
    """Start Firefox on the page, and take control."""
    program = shutil.which("firefox-esr") or shutil.which("firefox")
    if program is None:
        pytest.skip("no firefox is installed")
    opened = Firefox(program, tmp_path)
    opened.call("WebDriver:Navigate", url=served.url)
    until(lambda: not opened.run("return document.getElementById('control').disabled;"))
    opened.click("#control")
    until(lambda: opened.run("return document.getElementById('holder').textContent;") == "you have control")
    yield opened
    opened.close()


def test_a_released_key_and_space_reach_the_page_whatever_is_open(firefox: Firefox, served: ServedConsole):
    until(lambda: not firefox.run("return document.getElementById('setup').disabled;"))
    for selector, button in (("#setup", 0), ("#again", 0), ("#dish", 2), ("#speed", 2), ("#nodes", 2), ("h1", 2)):
        firefox.run("document.getElementById('dish').focus();")
        firefox.key("keyDown", UP)
        until(lambda: served.graph.last == NORTH)
        firefox.click(selector, button)
        until(lambda: served.graph.last == REST)  # the hold has ended before the key is released
        firefox.key("keyUp", UP)
        count = len(served.graph.commands)
        firefox.key("keyDown", SPACE)
        firefox.key("keyUp", SPACE)
        until(lambda: "stop" in served.graph.actions)
        assert len(served.graph.commands) == count
        firefox.run("document.getElementById('setup').focus(); document.getElementById('cancel').click();")
        served.graph.actions.clear()
        served.graph.shown["bridge"].update(armed=True, emergency_stopped=False, state="active", reasons=[])
        until(lambda: firefox.run("return document.getElementById('coils').textContent;") == "armed")
