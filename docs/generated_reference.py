"""Writes the parts of the reference that are taken from the code: a page asks for one by a block `{generated} NAME`."""

from __future__ import annotations

import argparse
import ast
import re
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from sphinx.pycode import ModuleAnalyzer

import magnetosuture_thread
from magnetosuture_thread import MATERIALS
from magnetosuture_thread.cli import make_parser
from magnetosuture_thread.rig.setups import SETTINGS_CLASSES
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.configuration import Configuration, ConfigurationField, configuration_fields
from magnetosuture_thread.settings.shared_parameters import SHARED_PARAMETERS

ROOT = Path(__file__).parents[1]
NODES = ROOT / "magnetosuture_thread" / "nodes"
DEFINITIONS = ROOT / "msg_defs"
CHANNELS = {name: value for name, value in vars(interface).items() if isinstance(value, interface.Channel)}
COMMENTS = {
    names: " ".join(lines).strip()
    for names, lines in ModuleAnalyzer.for_module(interface.__name__).find_attr_docs().items()
}
_BLOCK = re.compile(r"^```\{generated\} (\w+)\n```$", re.MULTILINE)


def write_generated(text: str) -> str:
    """Return a page with its generated parts."""
    return _BLOCK.sub(lambda found: WRITERS[found[1]](), text)


def table(header: str, rows: Iterator[tuple[str, ...]]) -> str:
    """Return a table in Markdown; the header's cells are separated by `|`."""
    names = header.split("|")
    lines = [names, ["---"] * len(names), *([cell.replace("|", r"\|") for cell in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def code(text: str) -> str:
    """Return a text as code, nothing where it is empty."""
    return f"`{text}`" if text else ""


# Parameters.


def parameters() -> str:
    """Return a table of the shared parameters, and one of each node's own."""
    fields = [field for settings in SETTINGS_CLASSES for field in configuration_fields(settings)]
    shared = {field.name: field for field in reversed(fields) if field.name in SHARED_PARAMETERS}
    parts = ["## Shared\n", _parameter_table([shared[name] for name in SHARED_PARAMETERS])]
    for settings in SETTINGS_CLASSES:
        own = [field for field in configuration_fields(settings) if field.name not in SHARED_PARAMETERS]
        parts += [f"## `{settings.GROUP}`\n", f"{_also_shared(settings)}\n", _parameter_table(own)]
    return "\n".join(parts)


def _also_shared(settings: type[Configuration]) -> str:
    names = [code(field.name) for field in configuration_fields(settings) if field.name in SHARED_PARAMETERS]
    return f"Besides, of the shared ones: {', '.join(names)}." if names else "None of the shared ones."


def _parameter_table(fields: list[ConfigurationField]) -> str:
    return table("parameter|default|unit|bounds|meaning", (_parameter_row(field) for field in fields))


def _parameter_row(field: ConfigurationField) -> tuple[str, ...]:
    about = field.quantity
    default = field.default
    if field.kind is tuple:
        shown = "[" + ", ".join(str(entry) for entry in default) + "]"
    else:
        shown = str(default).lower() if field.kind is bool else str(default)
    bounds = ", ".join(map(code, about.choices)) or {bool: "true, false"}.get(field.kind, about.bounds)
    bounds = bounds.removeprefix("from ").removeprefix("of ")
    return code(field.name), code(shown), about.unit, bounds, about.description


# Topics and services.


def topics() -> str:
    """Return a table of all topics, with the nodes that publish and receive each."""
    traffic = {node: traffic_of(node) for node in (*interface.ALL_NODES, "console")}

    def users(name: str, way: int) -> str:
        return ", ".join(code(node) for node, used in traffic.items() if name in used[way])

    rows = (
        (f"{_topic_name(name, each)}<br>{_type(each.type_name)}", COMMENTS["", name], users(name, 0), users(name, 1))
        for name, each in CHANNELS.items()
    )
    return table("topic, type|content|published by|received by", rows)


def _topic_name(name: str, channel: interface.Channel) -> str:
    return code(channel.recorded if name in ("CLOCK", "DIAGNOSTICS") else channel.name)


def _type(name: str) -> str:
    """Return the name of a type, linked where it is one of ours."""
    package, _, plain = name.split("/")
    return f"[{plain}](messages.md#{plain.lower()})" if package == "magnetosuture_msgs" else f"{package}/{plain}"


def traffic_of(node: str) -> tuple[set[str], set[str]]:
    """Return the topics that a node publishes and those that it receives, by their names in `interface`."""
    published: set[str] = set()
    received: set[str] = set()
    for path in _modules_of(node):
        for used, parent in _topics_in(ast.parse(path.read_text(encoding="utf-8"))):
            if used not in CHANNELS:
                continue
            method = parent.attr if isinstance(parent, ast.Attribute) else "subscribe"
            if method == "publisher" or (
                isinstance(parent, ast.Call) and ast.unparse(parent.func) == "topics.publishing"
            ):
                published.add(used)
            elif method.startswith("subscribe"):
                received.add(used)
    return published, received


def _topics_in(tree: ast.Module) -> Iterator[tuple[str, ast.AST]]:
    """Yield each use of a topic, `topics.NAME` or an imported `NAME`, with what it is used in."""
    imported = {
        name.name
        for each in ast.walk(tree)
        if isinstance(each, ast.ImportFrom) and each.module == "magnetosuture_thread.nodes.topics"
        for name in each.names
    }
    for parent in ast.walk(tree):
        for child in ast.iter_child_nodes(parent):
            if isinstance(child, ast.Attribute) and isinstance(child.value, ast.Name) and child.value.id == "topics":
                yield child.attr, parent
            elif isinstance(child, ast.Name) and child.id in imported:
                yield child.id, parent


def _modules_of(node: str) -> set[Path]:
    """Return the files in `nodes/` that a node consists of: its own, and all that these import."""
    waiting = [NODES / f"{node}.py"]
    found: set[Path] = set()
    while waiting:
        path = waiting.pop()
        if path in found or path == NODES / "topics.py":
            continue
        found.add(path)
        for each in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(each, ast.ImportFrom) and (each.module or "").startswith("magnetosuture_thread.nodes"):
                base = ROOT / str(each.module).replace(".", "/")
                modules = [base.with_suffix(".py"), *(base / f"{name.name}.py" for name in each.names)]
                waiting += [module for module in modules if module.is_file()]
    return found


def services() -> str:
    """Return a table of all services."""
    rows = (
        (code(each.value), _type(each.type_name), code(each.node), COMMENTS["Service", each.name])
        for each in interface.Service
    )
    return table("service|type|node|what it does", rows)


# Messages.


def messages() -> str:
    """Return a section for each message, service and action, from their definitions."""
    paths = [path for kind in ("msg", "srv", "action") for path in sorted((DEFINITIONS / kind).glob(f"*.{kind}"))]
    return "\n".join(_definition(path) for path in paths)


PARTS = {".msg": ("",), ".srv": ("request", "response"), ".action": ("goal", "result", "feedback")}


def _definition(path: Path) -> str:
    text = path.read_text(encoding="utf-8")
    found = re.match(r"(?:#.*\n)+\n", text)
    assert found is not None, f"{path.name} does not begin with a comment and an empty line"
    about = " ".join(line.lstrip("# ") for line in found[0].splitlines())
    kind = {".msg": "", ".srv": "service: ", ".action": "action: "}[path.suffix]
    lines = [f"## {path.stem}\n", f"{kind}{about.strip()}\n"]
    for part, content in zip(PARTS[path.suffix], text[found.end() :].split("---\n"), strict=True):
        lines.append(table(f"{part or 'field'}|type|meaning", _fields(content)))
    return "\n".join(lines)


def _linked(kind: str) -> str:
    """Return a field's type, linked where its definition is on the page."""
    plain = re.sub(r"\[.*\]", "", kind)
    own = (DEFINITIONS / "msg" / f"{plain}.msg").is_file()
    return f"[{plain}](messages.md#{plain.lower()}){kind[len(plain) :]}" if own else kind


def _fields(content: str) -> Iterator[tuple[str, ...]]:
    """Yield name, type and comment of each field and constant; a comment goes on in lines that hold nothing else."""
    rows: list[list[str]] = []
    for line in content.splitlines():
        field = re.match(r"([\w/\[\]<=]+) +(\w+(?:=\S+)?) *(?:# *(.*))?$", line)
        if field is not None:
            rows.append([code(field[2]), _linked(field[1]), field[3] or ""])
        elif line.strip():
            assert rows, line
            assert line.strip().startswith("#"), line
            rows[-1][2] += " " + line.strip("# ")
    yield from (tuple(row) for row in rows)


# Commands.


def commands() -> str:
    """Return a section for each sub-command of `magnetosuture`."""
    return "\n".join(_command(parser) for parser in _leaves(make_parser()))


def _leaves(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    below = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not below:
        yield parser
    for each in below:
        for child in each.choices.values():
            yield from _leaves(child)


def _command(parser: argparse.ArgumentParser) -> str:
    shown = [action for action in parser._actions if not isinstance(action, argparse._HelpAction)]
    about = "\n\n".join(_paragraph(part) for part in (parser.description or "").strip().split("\n\n"))
    lines = [f"## {parser.prog.partition(' ')[2]}\n", f"{about}\n", f"```text\n{_usage(parser)}\n```\n"]
    lines.append(table("argument|meaning", ((_argument(action), _meaning(action, parser)) for action in shown)))
    return "\n".join(lines)


def _paragraph(text: str) -> str:
    """Return a paragraph of a description; one with indented lines is a table that stays as it is."""
    return f"```text\n{text}\n```" if re.search(r"^ ", text, re.MULTILINE) else " ".join(text.split())


def _usage(parser: argparse.ArgumentParser) -> str:
    usage = " ".join(parser.format_usage().split()).removeprefix("usage: ").replace("[-h] ", "")
    return "\n".join(textwrap.wrap(usage, 100, subsequent_indent="    ", break_on_hyphens=False))


def _argument(action: argparse.Action) -> str:
    value = action.metavar or action.dest.upper()
    values = " ".join(value) if isinstance(value, tuple) else value
    if not action.option_strings:
        return code(values)
    name = ", ".join(action.option_strings)
    return code(name if action.nargs == 0 else f"{name} {values}") + (" (needed)" if action.required else "")


def _meaning(action: argparse.Action, parser: argparse.ArgumentParser) -> str:
    return (action.help or "") % {**vars(action), "prog": parser.prog}


# The Python interface.


def python_interface() -> str:
    """Return the directives that document every public name."""
    names = "\n".join(f".. {_directive(name)}:: {name}" for name in magnetosuture_thread.__all__ if name != "MATERIALS")
    materials = f".. py:data:: MATERIALS\n\n   Every `Material` by its name: {', '.join(map(code, MATERIALS))}.\n"
    return f"```{{eval-rst}}\n.. currentmodule:: magnetosuture_thread\n\n{names}\n{materials}```\n"


_SECTION = re.compile(r"(Args|Attributes|Raises|Returns|Yields|Source|Deviation):")
_MARKUP = re.compile(r"(`[^`]*`)|([*|\\]|_\b)")


def literal_docstring(lines: list[str]) -> None:
    """Change a docstring into reStructuredText in place: formulas stand as they are, and only backticks are markup."""
    changed: list[str] = []
    in_section = in_formula = False
    for line in lines:
        in_section = in_section or _SECTION.match(line) is not None
        if line.startswith("    ") and not in_section:
            if not in_formula:
                changed += [".. code-block:: text", ""]
            in_formula = True
            changed.append(line)
            continue
        in_formula = in_formula and not line
        changed.append(_MARKUP.sub(lambda found: found[1] or "\\" + found[2], line))
    lines[:] = changed


def _directive(name: str) -> str:
    return "autoclass" if isinstance(getattr(magnetosuture_thread, name), type) else "autofunction"


WRITERS: dict[str, Callable[[], str]] = {
    writer.__name__: writer for writer in (parameters, topics, services, messages, commands, python_interface)
}


def setup(app: Any) -> dict[str, bool]:
    """Register at Sphinx."""

    def fill(_app: Any, _page: str, source: list[str]) -> None:
        source[0] = write_generated(source[0])

    def plain(_app: Any, _kind: str, _name: str, _object: Any, _options: Any, lines: list[str]) -> None:
        literal_docstring(lines)

    app.connect("source-read", fill)
    app.connect("autodoc-process-docstring", plain, priority=100)  # before the sections are read
    return {"parallel_read_safe": True}
