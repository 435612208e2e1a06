"""The launch file, over stand-ins for launch: which arguments it takes, and what it starts with which parameters."""

from __future__ import annotations

import configparser
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import pytest

from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.settings.configuration import configuration_fields
from magnetosuture_thread.settings.interface import (
    ALL_NODES,
    FRAME_PREFIX_VARIABLE,
    NODES,
    PROCESSES,
    RIG_NODES,
    STANDBY_NODES,
)
from test.shared import ROOT, load_module

INSTALLED: dict[str, str] = {}  # packages of the ROS installation
LIFECYCLE = {"perception", "coil_bridge", *(set(STANDBY_NODES) & set(ALL_NODES) - set(NODES))}
AUTOSTART = next(a.quantity.choices for a in configuration_fields(CoilBridgeSettings) if a.name == "autostart")


def kept(kind: str) -> Callable[..., SimpleNamespace]:
    """Return what stands in for a class of launch: it keeps what it is given."""
    return lambda *given, **named: SimpleNamespace(kind=kind, given=given, **named)


class Context(dict[str, str]):
    """Stands in for LaunchContext: the arguments, and what a group around the launch file has set."""

    launch_configurations: ClassVar[dict[str, str]] = {}


class Configuration:
    """Stands in for LaunchConfiguration."""

    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, context: dict[str, str]) -> str:
        """Return the argument's value."""
        return context[self.name]


@pytest.fixture
def description(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return what the launch file describes."""
    modules: dict[str, dict[str, Any]] = {
        "ament_index_python": {},
        "ament_index_python.packages": {
            "get_package_share_directory": lambda package: str(ROOT),
            "get_packages_with_prefixes": lambda: INSTALLED,
        },
        "launch": {"LaunchContext": Context, "LaunchDescription": lambda entries: entries},
        "launch.actions": {"DeclareLaunchArgument": kept("argument"), "OpaqueFunction": kept("function")},
        "launch.conditions": {"IfCondition": kept("if"), "UnlessCondition": kept("unless")},
        "launch.substitutions": {"LaunchConfiguration": Configuration},
        "launch_ros": {},
        "launch_ros.actions": {"Node": kept("node")},
    }
    for name, contents in modules.items():
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
        vars(sys.modules[name]).update(contents)
    return list(load_module(ROOT / "launch" / "magnetosuture.launch.py").generate_launch_description())


def nodes(description: list[Any], **arguments: str) -> list[Any]:
    """Return the nodes that are started with arguments."""
    declared = {entry.given[0]: entry for entry in description if entry.kind == "argument"}
    given = {name: arguments.get(name, entry.default_value) for name, entry in declared.items()}
    (function,) = (entry for entry in description if entry.kind == "function")
    return list(function.function(Context(given)))


def test_every_node_gets_the_same_file_and_namespace(description):
    started = nodes(description, setup="hernia_ring")
    assert {node.executable for node in started} == {"scene_server", *PROCESSES, *RIG_NODES, "console"}
    for node in started:
        # Two nodes in one process: a name would be that of both.
        assert node.name == (None if node.executable == "perception" else node.executable)
        assert node.parameters[0] == str(ROOT / "config" / "hernia_ring.yaml")
        assert node.namespace.name == "namespace"
        assert node.parameters[1] == {"use_sim_time": False}
    bridges = {node.condition.kind: node.parameters[2:] for node in started if node.executable == "coil_bridge"}
    assert bridges == {"unless": [], "if": [{"driver": "simulated", "autostart": "armed"}]}


@pytest.mark.parametrize("word", ["true", "True", "TRUE", "1", " true", "false", "False", "0"])
def test_a_switch_is_what_conditions_of_launch_take(description, word: str):
    started = nodes(description, planner=word, use_sim_time=word)
    is_on = word.strip().lower() in ("true", "1")
    assert ("needle_planner" in {node.executable for node in started}) == is_on
    assert {node.parameters[1]["use_sim_time"] for node in started} == {is_on}


@pytest.mark.parametrize("name", ["use_sim_time", "planner", "enclaves", "simulated", "console"])
def test_another_word_for_a_switch_is_refused(description, name: str):
    with pytest.raises(ValueError, match=f"{name}: got 'on', expected true or false"):
        nodes(description, **{name: "on"})


@pytest.mark.parametrize("planner", ["True", "false"])
def test_lifecycle_nodes_alone_go_as_far_as_autostart_says(description, planner: str):
    (choices,) = (e.choices for e in description if e.kind == "argument" and e.given[0] == "autostart")
    assert choices == ["", *(state for state in AUTOSTART if state != "armed")]
    for node in nodes(description, planner=planner, autostart="inactive"):
        given: dict[str, str] = {}
        for parameters in node.parameters[1:]:
            given |= parameters
        assert given.get("autostart") == ("inactive" if node.executable in LIFECYCLE else None)


@pytest.mark.parametrize(("prefix", "remapped"), [("", [("/tf_static", "tf_static")]), ("left/", [])])
def test_the_frames_of_a_rig_have_its_prefix(
    description, monkeypatch: pytest.MonkeyPatch, prefix: str, remapped: list[tuple[str, str]]
):
    monkeypatch.setitem(INSTALLED, "tf2_ros", "/opt/ros/jazzy")
    *robot, transform = nodes(description, frame_prefix=prefix)
    assert all(node.additional_env == {FRAME_PREFIX_VARIABLE: prefix} for node in robot)
    assert transform.arguments == ["--frame-id", "map", "--child-frame-id", f"{prefix}dish"]
    assert transform.remappings == remapped


def test_the_systemd_unit_launches_with_its_arguments_and_signals_its_whole_group(description, tmp_path: Path):
    unit = configparser.ConfigParser(interpolation=None, strict=False)
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read(ROOT / "config" / "systemd" / "magnetosuture.service")
    service = dict(unit["Service"])
    assert (service["KillMode"], service["KillSignal"], service["Restart"]) == ("control-group", "SIGINT", "no")
    (tmp_path / "install").mkdir()
    (tmp_path / "install" / "setup.bash").write_text('PATH="$WORKSPACE:$PATH"\n')
    (tmp_path / "ros2").write_text('#!/bin/sh\necho "$@"\n')
    (tmp_path / "ros2").chmod(0o755)
    command = [word.replace("$$", "$") for word in shlex.split(service["ExecStart"])]  # as systemd reads it
    name, _, given = service["Environment"].partition("=")  # the last of that name
    environment = {**os.environ, "WORKSPACE": str(tmp_path), name: f"{given} console:=true"}
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    *words, setup, console = done.stdout.split()
    assert [*words, console] == ["launch", "magnetosuture_thread", "magnetosuture.launch.py", "console:=true"]
    argument, _, value = setup.partition(":=")
    (declared,) = (each for each in description if each.kind == "argument" and each.given[0] == argument)
    assert value in declared.choices


def test_what_moves_the_needle_never_comes_back_by_itself(description):
    started = {node.executable: node for planner in ("true", "false") for node in nodes(description, planner=planner)}
    respawned = {name for name, node in started.items() if node.respawn}
    assert respawned == {"perception", "console"}
    assert all(started[name].respawn_delay > 0.0 for name in respawned)
    (page,) = (ROOT / "docs").rglob("nodes.md")
    documented = dict(re.findall(r"^\| `(\w+)` \| (yes|no):", page.read_text(), re.MULTILINE))
    assert documented == {name: "yes" if name in respawned else "no" for name in started}


def test_a_file_of_ones_own_comes_in_place_of_a_name_and_must_be_there(
    description, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    mine = tmp_path / "mine.yaml"
    mine.write_text("")
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("~/mine.yaml", str(mine)):
        assert {node.parameters[0] for node in nodes(description, setup_file=name)} == {str(mine)}
    with pytest.raises(FileNotFoundError, match=r"setup_file: got '.*nowhere\.yaml', expected a parameter file"):
        nodes(description, setup_file=str(tmp_path / "nowhere.yaml"))
