"""README and docs: links resolve, examples run, and commands, topics, messages and parameters exist in the code."""

from __future__ import annotations

import argparse
import importlib.util
import io
import itertools
import re
import shlex
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from benchmarks.__main__ import main as benchmark
from magnetosuture_thread import interface
from magnetosuture_thread.barrier import BUILT_IN
from magnetosuture_thread.cli.main import make_parser
from magnetosuture_thread.configuration import ROS_PARAMETERS, configuration_fields
from magnetosuture_thread.model.self_contact import SelfContact
from magnetosuture_thread.model.thread import MATERIALS
from magnetosuture_thread.planning.procedure import parse_procedure
from magnetosuture_thread.resources import shipped_procedures
from magnetosuture_thread.scene import read_scene
from magnetosuture_thread.setups import SETTINGS_CLASSES
from magnetosuture_thread.shared_parameters import SHARED_PARAMETERS

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [README, *DOCS]
WITH_COMMANDS = [*PAGES, ROOT / "CONTRIBUTING.md"]
ALL = [*WITH_COMMANDS, ROOT / "CHANGELOG.md"]

# Programs of others, of whose options nothing is known here.
FOREIGN = {".", "apt", "cd", "chrt", "colcon", "dask", "git", "kill", "pip", "rosdep"}
FOREIGN_OPTIONS = {
    "--help",
    "--qos-durability",
    "--ros-args",
    "--enclave",
    "--qos-profile-overrides-path",
    "--all",
    "--topics",
}
FOREIGN_WORDS = {
    "set_parameters_atomically",
    "corner_radus",
    "AWS_ENDPOINT_URL",
    "ROS_SECURITY_ENCLAVE_OVERRIDE",
    "ID_PATH",
}  # of rclcpp and udev; a slip that is shown as such
SCRIPTS = set(re.findall(r'^(\w+) = "magnetosuture_thread\.', (ROOT / "pyproject.toml").read_text(), re.MULTILINE))
TARGETS = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
LAUNCH_ARGUMENTS = set(re.findall(r'argument\("(\w+)"', (ROOT / "launch/magnetosuture.launch.py").read_text()))
SETUPS = {path.stem for path in (ROOT / "config").glob("*.yaml")}
FENCE = re.compile(r"^( *)```(\w*|\{\w+\}[^\n]*)\n(.*?)^\1```$", re.DOTALL | re.MULTILINE)

pages = pytest.mark.parametrize("page", WITH_COMMANDS, ids=lambda page: page.name)


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


def spans(page: Path) -> list[str]:
    """Return the code within sentences and tables."""
    text = "\n".join(line for line in prose(page).splitlines() if not line.startswith("    "))
    return [" ".join(span.split()).replace(r"\|", "|") for span in re.findall(r"(?<!`)`([^`]+)`(?!`)", text)]


def table(page: Path, heading: str) -> list[list[str]]:
    """Return the rows of the first table under a heading."""
    section = re.search(rf"^## {heading}\n(.*?)(?=^## |\Z)", page.read_text(), re.DOTALL | re.MULTILINE)
    assert section is not None, heading
    lines = re.search(r"(?:^\|.*\n)+", section[1], re.MULTILINE)
    assert lines is not None, heading
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[0].splitlines()[2:]]


def table_at_the_top(page: Path) -> list[list[str]]:
    """Return the rows of a page's first table."""
    lines = re.search(r"(?:^\|.*\n)+", page.read_text(), re.MULTILINE)
    assert lines is not None
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[0].splitlines()[2:]]


def subparsers(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of the commands that a parser knows."""
    found: dict[str, argparse.ArgumentParser] = {}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            found.update(action.choices)
    return found


def leaves(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Return a parser and all those below it."""
    yield parser
    for below in subparsers(parser).values():
        yield from leaves(below)


def options_of(parser: argparse.ArgumentParser) -> set[str]:
    """Return the long options of a command."""
    return {option for action in parser._actions for option in action.option_strings if option.startswith("--")}


def placeholders_allowed() -> argparse.ArgumentParser:
    """Return the parser of `magnetosuture`; a word in capitals stands for any value, and output/ need not be there."""
    parser = make_parser()

    def lenient(kind: Callable[[str], Any]) -> Callable[[str], Any]:
        return lambda text: text if text.isupper() or text.startswith("output/") else kind(text)

    for leaf in leaves(parser):
        for action in leaf._actions:
            if callable(action.type):
                action.type = lenient(action.type)
            if action.choices is not None and not isinstance(action, argparse._SubParsersAction):
                action.choices = [
                    *action.choices,
                    *(action.metavar if isinstance(action.metavar, tuple) else ()),
                    "ACTION",
                ]
    return parser


def check_named_files(words: list[str]) -> None:
    """Check that the files and setups of this repository that a command names are there."""
    for before, word in itertools.pairwise(["", *words]):
        if re.match(r"(config|docs|examples|launch|test)/", word) and before != "--output":
            assert (ROOT / word).exists(), word
    for name in re.findall(r"(?:^(?:simulate|console)|--setup) ([a-z]\w+)(?![\w.])", " ".join(words)):
        assert name in SETUPS, name


def check_magnetosuture(words: list[str], *, complete: bool) -> None:
    """Check the arguments of `magnetosuture`."""
    check_named_files(words)
    if not words:  # the program's name
        return
    if complete and "--help" not in words:
        placeholders_allowed().parse_args(words)
        return
    parser, rest = make_parser(), list(words)
    while rest and rest[0] in subparsers(parser):
        parser = subparsers(parser)[rest.pop(0)]
    assert len(rest) < len(words) or words[0].startswith("--") or words[0] == "COMMAND", words
    if subparsers(parser) and rest and words[0] != "COMMAND":
        assert rest[0].startswith("--") or rest[0].isupper(), words
    unknown = {word for word in rest if word.startswith("--")} - options_of(parser) - FOREIGN_OPTIONS
    assert not unknown, words


def check_benchmark(words: list[str]) -> None:
    """Check the arguments of `python -m benchmarks` by its own help."""
    assert {option for option in words if option.startswith("--")} <= benchmark_options(words[0]), words


@cache
def benchmark_options(name: str) -> frozenset[str]:
    """Return the options of a benchmark, as its help has them."""
    text = io.StringIO()
    with redirect_stdout(text), pytest.raises(SystemExit) as ended:
        benchmark([name, "--help"])
    assert ended.value.code == 0, name
    return frozenset(re.findall(r"--[a-z][-a-z]*", text.getvalue()))


def check_ros2(words: list[str]) -> None:
    """Check what `ros2` is asked to run, launch or call."""
    if words[:2] == ["launch", "magnetosuture_thread"]:
        assert (ROOT / "launch" / words[2]).is_file(), words
        given = dict(word.split(":=") for word in words[3:] if ":=" in word)
        assert set(given) <= LAUNCH_ARGUMENTS, words
        assert given.get("setup", "NAME") in SETUPS | {"NAME"}, words
    elif words[:2] == ["run", "magnetosuture_thread"]:
        check(shlex.join(words[2:]), complete=True)
    elif words[:2] == ["service", "call"]:
        package, _, name = words[3].split("/")
        assert interface.SERVICES[words[2].lstrip("/")].type_name == f"{package}/srv/{name}", words
        if package == "magnetosuture_msgs":
            asked = (ROOT / f"msg_defs/srv/{name}.srv").read_text().split("---")[0]
            assert set(yaml.safe_load(words[4])) <= set(re.findall(r"^\w\S* (\w+)", asked, re.MULTILINE)), words


def check_python(words: list[str]) -> None:
    """Check which module or script Python is asked to run."""
    if words[:2] == ["-m", "benchmarks"]:
        check_benchmark(words[2:])
    elif words[:1] == ["-m"]:
        assert importlib.util.find_spec(words[1]) is not None, words
    elif words:  # else the program's name
        assert (ROOT / words[0]).is_file() or words[0] in saved_files(), words


@cache
def saved_files() -> frozenset[str]:
    """Return the files that tutorials have their readers save."""
    return frozenset(name for page in DOCS for name in re.findall(r"^<!-- file: (\S+) -->$", page.read_text(), re.M))


def check_node(words: list[str]) -> None:
    """Check the parameter files and parameters that a node is started with."""
    check_named_files(words)
    given = [word.split(":=")[0] for before, word in itertools.pairwise(words) if before == "-p"]
    assert set(given) <= parameters(), words


def check(line: str, *, complete: bool) -> None:
    """Check one command; one that is only named in a sentence need not be complete."""
    words = shlex.split(line, comments=True)
    while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
        words.pop(0)
    program = words[0].removeprefix(".venv/bin/") if words else ""
    rest = words[1:]
    if program == "magnetosuture":
        check_magnetosuture(rest, complete=complete)
    elif program in ("python", "python3"):
        check_python(rest)
    elif program == "make":
        assert set(rest) <= TARGETS, line
    elif program == "ros2":
        check_ros2(rest)
    elif program in SCRIPTS:
        check_node(rest)
    elif program == "bash":
        assert (ROOT / rest[0]).is_file(), line
    else:
        assert program in FOREIGN, f"an unknown program in {line!r}"


@cache
def parameters() -> frozenset[str]:
    """Return the names of all parameters."""
    return frozenset(
        {about.name for group in SETTINGS_CLASSES for about in configuration_fields(group)}
        | set(SHARED_PARAMETERS)
        | ROS_PARAMETERS
    )


@cache
def words_of_the_code() -> frozenset[str]:
    """Return every word that stands in the package, its messages, setups or build files."""
    found: set[str] = {*SETUPS, *shipped_procedures()}
    for folder in ("magnetosuture_thread", "msg_defs", "config", "launch", "benchmarks"):
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in (".py", ".msg", ".srv", ".action", ".yaml", ".js", ".html", ".txt", ".cmake"):
                found |= set(re.findall(r"\w+", path.read_text()))
    for name in ("Makefile", "pyproject.toml", "package.xml"):
        found |= set(re.findall(r"\w+", (ROOT / name).read_text()))
    return frozenset(found)


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub makes of a page's headings."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_the_readme_is_one_page():
    assert len(README.read_text().splitlines()) < 150
    text = README.read_text()
    assert "no medical device" in text
    assert "All data here is simulated" in text


@pytest.mark.parametrize("page", ALL, ids=lambda page: page.name)
def test_links_resolve(page: Path):
    for target in re.findall(r"\]\(([^)\s]+)\)", FENCE.sub("", page.read_text())):
        if target.startswith("http"):
            continue
        name, _, anchor = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        assert path.is_relative_to(ROOT), target
        assert path.exists(), target
        assert not anchor or anchor in anchors(path), target


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
    if "forecast" in names:
        assert names["forecast"].converged
        assert not names["forecast"].problem
        return
    prediction: Any = names.get("estimate", names.get("prediction"))
    if prediction is None:  # it asserts what it shows by itself
        assert "assert" in code
        return
    assert prediction.converged
    assert prediction.residual < 1e-6
    if page == README:
        assert np.all(np.isfinite(prediction.positions))
        assert -1e-8 < prediction.margins["obstacle"].minimum < 1e-3  # it does lie around the post


def test_every_picture_is_made_by_a_command():
    makers = (ROOT / "docs/make_pictures.py").read_text()
    for path in (ROOT / "docs/pictures").iterdir():
        assert f'"{path.name}"' in makers or path.name == "data_flow.svg", path.name


def test_there_are_examples():
    assert [page for page, _ in EXAMPLES].count(README) == 1
    assert len(EXAMPLES) >= 2


@pages
def test_commands_of_blocks_parse(page: Path):
    for line in shell_lines(page):
        check(line, complete=True)


def variants(span: str) -> list[str]:
    """Return a command with each of its alternatives, `[A | B]` or `a|b`, in turn."""
    span = span.replace("[", "").replace("]", "")
    parts = span.split(" | ")
    if len(parts) > 1:
        words = parts[0].split()
        return [parts[0], *(" ".join([*words[:-1], part]) for part in parts[1:])]
    found = re.search(r"[\w-]+(?:\|[\w-]+)+", span)
    if found is None:
        return [span]
    return [variant for one in found[0].split("|") for variant in variants(span.replace(found[0], one))]


@pages
def test_commands_of_sentences_exist(page: Path):
    known = set(subparsers(make_parser()))
    for span in spans(page):
        words = span.split()
        program = words[0].removeprefix(".venv/bin/")
        if program in ("magnetosuture", "python", "make", "ros2") or (program in SCRIPTS and "--ros-args" in words):
            for variant in variants(span):
                if variant != "ros2":
                    check(variant, complete=False)
        elif program in known and len(words) > 1:
            for variant in variants(span):
                check_magnetosuture(shlex.split(variant), complete=False)


@pages
def test_options_exist(page: Path):
    known = {option for leaf in leaves(make_parser()) for option in options_of(leaf)} | FOREIGN_OPTIONS
    for name in ("solver", "bridge", "page", "keep-out", "attack", "vision", "estimator"):
        with suppress(pytest.fail.Exception, AssertionError):  # that each exists is another test
            known |= benchmark_options(name)
    named = {word for span in spans(page) for word in span.split()[:1] if word.startswith("--")}
    assert named <= known


@pages
def test_files_that_are_named_exist(page: Path):
    folders = "|".join(path.name for path in ROOT.iterdir() if path.is_dir() and path.name[0] != ".")
    for span in spans(page):
        if re.fullmatch(rf"(?:{folders})/[\w./-]+", span) and not span.startswith(("install/", "output/", "build/")):
            on_disk = (ROOT / span).exists()
            assert on_disk or span.split("/")[0] in {channel.name.split("/")[0] for channel in CHANNELS}, span


@pages
def test_names_occur_in_the_code(page: Path):
    """A topic, parameter, field or class that was renamed is not left behind."""
    for span in spans(page):
        for name in re.findall(r"[A-Za-z]\w*", span) if re.fullmatch(r"/?[\w/.]+", span) else ():
            if "_" not in name.strip("_") and not re.fullmatch(r"(?:[A-Z][a-z]+){2,}", name):
                continue
            case_of_the_references = re.fullmatch(r"(?:pa|silk)_[a-z]\w+", name)
            saved = span in saved_files() or name in {Path(file).stem for file in saved_files()}
            if not (case_of_the_references or saved) and name not in FOREIGN_WORDS and not (ROOT / span).exists():
                assert name in words_of_the_code(), span


CHANNELS = [value for value in vars(interface).values() if isinstance(value, interface.Channel)]
NODES_PAGE = ROOT / "docs/reference/nodes.md"


def test_the_table_of_barriers_is_complete():
    rows = {row[0].strip("`") for row in table(ROOT / "docs/explanation/barriers.md", "Of the thread")}
    assert {*BUILT_IN, SelfContact.name} <= rows


def test_messages_of_the_recovery_table_are_those_of_the_code():
    code = "\n".join(path.read_text() for path in (ROOT / "magnetosuture_thread").rglob("*.py"))
    rows = [row[0].strip("`") for row in table(ROOT / "docs/how_to/real_rig.md", "Recovery")]
    assert len(rows) > 15
    assert not [message for message in rows if message not in code]


def test_the_table_of_nodes_is_that_of_the_executables():
    rows = {row[0].strip("`") for row in table_at_the_top(NODES_PAGE)}
    assert rows | {"perception"} == SCRIPTS - {"magnetosuture"}


def test_the_table_of_setups_is_that_of_the_files():
    rows = {row[0].strip("`") for row in table_at_the_top(ROOT / "docs/how_to/configuration.md")}
    assert rows == SETUPS


def test_every_target_is_listed():
    rows = {
        row[0].strip("`").split()[1] for row in table(ROOT / "docs/how_to/installation.md", "In the clone, with make")
    }
    assert rows == TARGETS - {"help"}


def test_materials_are_listed():
    assert set(MATERIALS) <= set(spans(ROOT / "docs/how_to/configuration.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_yaml_blocks_hold(page: Path, tmp_path: Path):
    groups = {group.GROUP: {about.name: about for about in configuration_fields(group)} for group in SETTINGS_CLASSES}
    for block in blocks(page, "yaml"):
        content = yaml.safe_load(block)
        if "dish" in content:
            (tmp_path / "scene.yaml").write_text(block)
            read_scene(str(tmp_path / "scene.yaml"))
            continue
        if "goals" in content:
            parse_procedure(content, page.stem)
            continue
        for section, given in content.items():
            for name, value in given["ros__parameters"].items():
                if name in ROS_PARAMETERS:
                    continue
                shared = {key: about for group in groups.values() for key, about in group.items()}
                (shared if section == "/**" else groups[section.removeprefix("/**/")])[name].checked(value)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_math_is_what_github_renders(page: Path):
    for formula in blocks(page, "math"):
        assert formula.count("{") == formula.count("}")
        begun, ended = (sorted(re.findall(rf"\\{word}{{(\w+)}}", formula)) for word in ("begin", "end"))
        assert begun == ended
        assert formula.count(r"\left") == formula.count(r"\right")
    text = re.sub(r"`[^`]*`", "", prose(page))
    assert "$$" not in text
    assert text.count("$") % 2 == 0
    for formula in re.findall(r"\$([^$]+)\$", text):
        # Markdown takes a backslash before punctuation away.
        assert not re.search(r"\\[^A-Za-z\s]", formula), formula
        assert formula == formula.strip(), formula
        assert formula.count("{") == formula.count("}"), formula
