"""README and docs: links resolve, Python examples run, commands parse, parameters and messages exist in the code."""

from __future__ import annotations

import argparse
import importlib.util
import re
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from magnetosuture_thread.cli import make_parser
from magnetosuture_thread.geometry.scene_files import read_scene
from magnetosuture_thread.planning.procedure import parse_procedure
from magnetosuture_thread.rig.setups import SETTINGS_CLASSES
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.configuration import ROS_PARAMETERS, configuration_fields
from test.shared import ROOT, known

README = ROOT / "README.md"
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [README, *DOCS]
CONTRIBUTING = ROOT / "CONTRIBUTING.md"
ALL = [*PAGES, CONTRIBUTING, *(ROOT / f"{name}.md" for name in ("CHANGELOG", "QUALITY_DECLARATION"))]
SCRIPTS = set(re.findall(r'^(\w+) = "magnetosuture_thread\.', (ROOT / "pyproject.toml").read_text(), re.MULTILINE))
TARGETS = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
LAUNCH_ARGUMENTS = set(
    re.findall(r'^ +(?:argument\()?"(\w+)"[,:]', (ROOT / "launch/magnetosuture.launch.py").read_text(), re.M)
)
SETUPS = {path.stem for path in (ROOT / "config").glob("*.yaml")}
FENCE = re.compile(r"^( *)```(\w*|\{\w+\}[^\n]*)\n(.*?)^\1```$", re.DOTALL | re.MULTILINE)

pages = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def blocks(page: Path, language: str) -> list[str]:
    """Return the fenced blocks of a language."""
    return [found[3] for found in FENCE.finditer(page.read_text()) if found[2] == language]


def prose(page: Path) -> str:
    """Return the text without fenced blocks."""
    return FENCE.sub("", page.read_text())


def shell_lines(page: Path) -> list[str]:
    """Return the commands of the indented blocks, which hold nothing else, and of those of bash."""
    text = re.sub(r"\\\n\s*", " ", prose(page))
    lines = [line.strip() for line in text.splitlines() if line.startswith("    ")]
    lines += [line.strip() for block in blocks(page, "bash") for line in block.splitlines() if line]
    return [part for line in lines if not line.startswith("#") for part in line.split(" && ")]


def first_column(page: Path, heading: str) -> list[str]:
    """Return the first cells of the first table after a heading."""
    section = page.read_text().partition(heading)[2]
    found = known(re.search(r"(?:^\|.*\n)+", section, re.MULTILINE))
    return [line.strip("|").split("|")[0].strip().strip("`") for line in found[0].splitlines()[2:]]


def leaves(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Return a parser and all those below it."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                yield from leaves(below)


def parser_with_placeholders() -> argparse.ArgumentParser:
    """Return the parser of `magnetosuture`; a word in capitals stands for any value, and output/ need not be there."""
    parser = make_parser()

    def lenient(kind: Callable[[str], Any]) -> Callable[[str], Any]:
        return lambda text: text if text.isupper() or text.startswith("output/") else kind(text)

    for leaf in leaves(parser):
        for action in leaf._actions:
            if callable(action.type):
                action.type = lenient(action.type)
            if action.choices is not None and not isinstance(action, argparse._SubParsersAction):
                action.choices = [*action.choices, *(action.metavar if isinstance(action.metavar, tuple) else ())]
    return parser


def check(line: str) -> None:
    """Check one command of a block; those of other programs are not known here."""
    words = shlex.split(line, comments=True)
    while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
        words.pop(0)
    program, rest = (words[0].removeprefix(".venv/bin/"), words[1:]) if words else ("", [])
    if program == "ros2" and rest[:2] == ["run", "magnetosuture_thread"]:
        program, rest = rest[2], rest[3:]
    if program == "magnetosuture" and "--help" not in rest:
        parser_with_placeholders().parse_args(rest)
    elif program == "make":
        assert set(rest) <= TARGETS, line
    elif program == "python" and rest[:1] == ["-m"]:
        assert importlib.util.find_spec(rest[1]) is not None, line
    elif program == "ros2" and rest[:2] == ["launch", "magnetosuture_thread"]:
        given = dict(word.split(":=") for word in rest[3:])
        assert set(given) <= LAUNCH_ARGUMENTS, line
        assert given.get("setup", "NAME") in SETUPS | {"NAME"}, line
    elif program == "ros2" and rest[:2] == ["service", "call"]:
        package, _, name = rest[3].split("/")
        assert interface.SERVICES[rest[2].lstrip("/")].type_name == f"{package}/srv/{name}", line
    elif "--ros-args" in rest:
        assert program in SCRIPTS | {"rviz2"}, line


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub makes of a page's headings."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", ALL, ids=lambda page: page.name)
def test_links_resolve(page: Path):
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if target.startswith("http"):
            continue
        name, _, anchor = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        assert path.is_relative_to(ROOT), target
        assert path.exists(), target
        assert not anchor or anchor in anchors(path), target


def test_files_of_the_source_tree_that_pages_name_exist():
    """Those by a path from its root: `test/...`, `config/...`."""
    folders = "benchmarks|config|docs|examples|launch|magnetosuture_thread|msg_defs|test"
    for page in [*PAGES, CONTRIBUTING]:
        for path in re.findall(rf"`((?:{folders})/[\w./-]+)`", prose(page)):
            assert (ROOT / path).exists(), (page.name, path)


def test_every_page_and_picture_is_reached():
    index = ROOT / "docs/index.md"
    listed = {line for tree in blocks(index, "{toctree}") for line in tree.splitlines() if line and line[0] != ":"}
    assert listed == {str(page.relative_to(index.parent).with_suffix("")) for page in DOCS if page != index}
    shown = {name for page in PAGES for name in re.findall(r"!\[[^]]*\]\([\w./]*pictures/([\w.]+)\)", page.read_text())}
    assert {path.name for path in (ROOT / "docs/pictures").iterdir()} == shown


IN_ORDER = ROOT / "docs/tutorials"  # whose blocks go on from each other, see test_tutorials.py
EXAMPLES = [(page, code) for page in PAGES if page.parent != IN_ORDER for code in blocks(page, "python")]


@pytest.mark.parametrize(("page", "code"), EXAMPLES, ids=[page.name for page, _ in EXAMPLES])
def test_python_examples_run(page: Path, code: str, capsys: pytest.CaptureFixture[str]):
    names: dict[str, Any] = {}
    exec(compile(code, str(page), "exec"), names)
    assert capsys.readouterr().out
    result = names.get("forecast", names.get("estimate", names.get("prediction")))
    if result is None:  # it asserts what it shows by itself
        assert "assert" in code
        return
    assert result.converged
    if page == README:
        assert np.all(np.isfinite(result.positions))
        assert -1e-8 < result.margins["obstacle"].minimum < 1e-3  # it does lie around the post


@pages
def test_commands_of_blocks_parse(page: Path):
    for line in shell_lines(page):
        check(line)


def test_messages_of_the_recovery_table_are_those_of_the_code():
    code = "\n".join(path.read_text() for path in (ROOT / "magnetosuture_thread").rglob("*.py"))
    assert not [
        message for message in first_column(ROOT / "docs/how_to/real_rig.md", "## Recovery") if message not in code
    ]


def test_tables_of_nodes_and_setups_are_complete():
    assert {*first_column(ROOT / "docs/reference/nodes.md", "# Nodes"), "perception"} == SCRIPTS - {"magnetosuture"}
    assert set(first_column(ROOT / "docs/how_to/configuration.md", "# Configuration")) == SETUPS


@pages
def test_yaml_blocks_hold(page: Path, tmp_path: Path):
    groups = {group.GROUP: {about.name: about for about in configuration_fields(group)} for group in SETTINGS_CLASSES}
    shared = {key: about for group in groups.values() for key, about in group.items()}
    for block in blocks(page, "yaml"):
        content = yaml.safe_load(block)
        if "dish" in content:
            (tmp_path / "scene.yaml").write_text(block)
            read_scene(str(tmp_path / "scene.yaml"))
        elif "goals" in content:
            parse_procedure(content, page.stem)
        else:
            for section, given in content.items():
                for name, value in given["ros__parameters"].items():
                    if name not in ROS_PARAMETERS:
                        (shared if section == "/**" else groups[section.removeprefix("/**/")])[name].checked(value)
