"""The switches of a running bridge, pressed from the command line."""

from __future__ import annotations

import pytest

from magnetosuture_thread.cli import main
from magnetosuture_thread.nodes import clients
from magnetosuture_thread.nodes.coil_bridge import CoilBridgeNode


def press(capsys, action: str, *options: str) -> tuple[int, str]:
    """Run the command and return its exit code and what it printed."""
    code = main(["coils", action, *options])
    printed = capsys.readouterr()
    return code, printed.out + printed.err


def test_every_switch_works_and_shows_the_state(
    graph, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(graph.domain))
    node = graph.add(CoilBridgeNode, namespace="lab1", autostart="inactive", scene="dish_35mm")
    here = ("--namespace", "lab1")
    for action, state in (
        ("activate", "active"),
        ("arm", "active, armed"),
        ("disarm", "active"),
        ("stop", "fault"),
        ("reset", "active"),
    ):
        code, said = press(capsys, action, *here)
        assert code == 0, said
        assert said.splitlines()[0].split(maxsplit=1) == ["state", state]
    code, said = press(capsys, "configure", *here)
    assert code == 1
    assert "rejected configure" in said
    assert node.stage == "active"


def test_a_bridge_that_is_not_there_is_said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(clients, "TIMEOUT", 0.5)
    code, printed = press(capsys, "stop", "--namespace", "/lab2")
    assert code == 1
    assert "no coil_bridge" in printed
    monkeypatch.undo()
    code, printed = press(capsys, "arm", "--namespace", "/lab2")  # whoever waits for longer has looked away
    assert code == 1
    assert "no service coils/arm within 3 s" in printed
    with pytest.raises(SystemExit):
        press(capsys, "stop", "--namespace", "2 labs")
    assert "is no ROS namespace" in capsys.readouterr().err
