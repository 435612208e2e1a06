"""One concept has one word, and one public name has one meaning."""

from __future__ import annotations

import argparse
import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

import magnetosuture_thread
from magnetosuture_thread.cli.main import make_parser
from magnetosuture_thread.resources import share_directory
from magnetosuture_thread.setups import SETTINGS_CLASSES

PACKAGE = Path(magnetosuture_thread.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))

# What is not said, and what is said instead.
OLD_WORDS = {
    "sight sights seen": "measured, observation",
    "truth": "ground_truth",
    "asked wish wished": "commanded",
    "outcome proof": "result",
    "glued": "clamped",
    "stretch": "strain",
    "held_nodes": "fixed_nodes",
    "surroundings": "workspace",
    "touching": "in_contact",
    "outward pushing": "normal, active",
    "memory": "buffers",
    "go_on set_out": "solve_step, init_step",
    "pulled resting": "sliding, stuck",
    "say tell told said words": "log, report, text",
    "most least longest shortest": "max, min",
    "patience": "timeout",
    "choices_of gone_on succession": "factory, resample",
    "house room strangers": "package, part",
    "verdict judge": "salvage, check, measure",
    "peers vandal": "baselines, fuzz",
    "spread moments": "percentiles, worst frames",
    "pace": "rate",
    "scenario": "setup",
}
# Keys of the files that `--json` writes, which others read.
JSON_KEYS = {
    "error_seen",
    "error_truth",
    "seen_share",
    "least_margins",
    "stretch",
    "max_stretch",
    "truth_before",
    "truth_after",
    "truth_held_out",
    "most_friction",
    "longest_rest_s",
}
ALLOWED = JSON_KEYS
ENTRY_POINTS = {"main", "run", "add"}  # of programs, and of each command

# In what is printed, drawn or logged.
OLD_PHRASES = re.compile(
    r"seen centreline|simulated truth|\bgreatest\b|\bleast margin|own word|root of the mean|thread seen|"
    r"\bjudg(?:ed|ing)\b|no truth|what is seen"
)

_OLD = re.compile(rf"(?:^|_)({'|'.join(' '.join(OLD_WORDS).split())})(?:_|$)")


def old_word(name: str) -> str:
    """Return the old word in a name, or nothing."""
    plain = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()
    found = None if name in ALLOWED else _OLD.search(plain.replace("ground_truth", ""))
    return found.group(1) if found else ""


def public_names(path: Path) -> Iterator[str]:
    """Yield the names that a module offers: its own, classes, functions, parameters, attributes, constants."""
    yield path.stem
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign):
            yield from (target.id for target in node.targets if isinstance(target, ast.Name))
        elif isinstance(node, ast.FunctionDef):
            yield from _function_names(node)
        elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield node.name
            for part in node.body:
                if isinstance(part, ast.FunctionDef):
                    yield from _function_names(part)
                elif isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
                    yield part.target.id


def _function_names(node: ast.FunctionDef) -> Iterator[str]:
    if not node.name.startswith("_"):
        yield node.name
        yield from (argument.arg for argument in [*node.args.args, *node.args.kwonlyargs])


@pytest.mark.parametrize("name", ["SeenThread", "least_margin", "MOST_STEPS", "tell", "truth_needle", "go_on"])
def test_an_old_word_is_recognised(name: str):
    assert old_word(name)


@pytest.mark.parametrize("name", ["ground_truth", "GROUND_TRUTH_NEEDLE", "almost", "atmost", "roommate", "error_seen"])
def test_other_words_are_not_taken_for_old_ones(name: str):
    assert not old_word(name)


def test_public_names_have_no_old_word():
    names = {path: [name for name in public_names(path) if not name.startswith("_")] for path in MODULES}
    assert sum(map(len, names.values())) > 1000
    old = {str(path.relative_to(PACKAGE)): list(filter(old_word, each)) for path, each in names.items()}
    assert not {path: found for path, found in old.items() if found}


def texts(path: Path) -> Iterator[str]:
    """Yield the texts of a module that are no docstrings and no names."""
    if path.suffix == ".html":
        yield path.read_text(encoding="utf-8")
        return
    tree = ast.parse(path.read_text(encoding="utf-8"))
    statements = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in statements:
            yield node.value


def test_no_text_that_is_shown_has_an_old_phrase():
    shown = {path: list(texts(path)) for path in [*MODULES, *PACKAGE.rglob("*.html")]}
    assert sum(map(len, shown.values())) > 1000
    old = {str(path.relative_to(PACKAGE)): list(filter(OLD_PHRASES.search, each)) for path, each in shown.items()}
    assert not {path: found for path, found in old.items() if found}


def test_an_old_phrase_is_recognised_in_a_text_and_not_in_a_docstring(tmp_path: Path):
    module = tmp_path / "module.py"
    module.write_text('"""The greatest of all."""\nx = f"greatest stretch {1}"\n')
    assert [bool(OLD_PHRASES.search(text)) for text in texts(module)] == [True]


def test_what_is_on_the_wire_has_no_old_word():
    definitions = [
        *(share_directory("magnetosuture_msgs") / "msg").glob("*.msg"),
        *(share_directory("magnetosuture_msgs") / "srv").glob("*.srv"),
        *(share_directory("magnetosuture_msgs") / "action").glob("*.action"),
    ]
    assert len(definitions) > 5
    fields = [word for path in definitions for word in re.findall(r"^\S+ +(\w+)", path.read_text(), re.MULTILINE)]
    assert not [name for name in [path.stem for path in definitions] + fields if old_word(name)]


def test_parameters_and_options_have_no_old_word():
    parameters = [name for settings in SETTINGS_CLASSES for name in settings.__dataclass_fields__]
    assert len(parameters) > 100
    assert not [name for name in parameters if old_word(name)]
    options = list(_options(make_parser()))
    assert len(options) > 50
    assert not [name for name in options if old_word(name.strip("-").replace("-", "_"))]


def _options(parser: argparse.ArgumentParser) -> Iterator[str]:
    for action in parser._actions:
        yield from action.option_strings
        if isinstance(action, argparse._SubParsersAction):
            for name, command in action.choices.items():
                yield name
                yield from _options(command)


def test_no_two_public_classes_or_functions_share_a_name():
    homes: dict[str, list[str]] = defaultdict(list)
    for path in MODULES:
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
                homes[node.name].append(str(path.relative_to(PACKAGE)))
    assert not {name: paths for name, paths in homes.items() if len(paths) > 1 and name not in ENTRY_POINTS}
