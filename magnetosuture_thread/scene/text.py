"""Reads the text of scene files, YAML or JSON, within bounds that no text can get past.

Whatever the text is, reading it takes time and memory in proportion to its length: it is bounded, as are its depth
and each word in it, and a text that refers to its own parts (YAML's aliases) is refused.
"""

from __future__ import annotations

import json
import math
import os
import re
import stat
from collections import Counter
from pathlib import Path
from typing import Any

import yaml

from magnetosuture_thread.scene.refusal import refusal

MAX_FILE_BYTES = 1_000_000
MAX_DEPTH = 20
MAX_WORD_CHARS = 1000


class _Loader(yaml.CSafeLoader):  # the loader without libyaml takes ten times as long
    """Reads YAML as the set-up files are read: 1e-5 is a number, nothing is a date, no key stands twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return a mapping whose keys are text, each of them once."""
        keys = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.tag != "tag:yaml.org,2002:str":
                name = f"the name {key.value}" if isinstance(key, yaml.ScalarNode) else "a name"
                raise yaml.constructor.ConstructorError(None, None, f"{name} that is no text", key.start_mark)
            if key.value in keys:
                raise yaml.constructor.ConstructorError(None, None, f"{key.value} is given twice", key.start_mark)
            keys.add(key.value)
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        return mapping


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in entries if not tag.endswith((":float", ":int", ":timestamp"))]
    for first, entries in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver("tag:yaml.org,2002:int", re.compile(r"^[-+]?(?:0|[1-9][0-9]*)$"), list("-+0123456789"))
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(?:(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|\.(?:inf|Inf|INF))$|^\.(?:nan|NaN|NAN)$"),
    list("-+0123456789."),
)


def read_text(path: Path) -> str:
    """Return the text of a regular file of at most `MAX_FILE_BYTES`.

    Raises:
        ConfigurationError: it cannot be read, is a device or a pipe, is too large, or is no text.
    """
    expectation = f"a regular file of at most {MAX_FILE_BYTES // 1000} kB of text"
    try:
        # A pipe that nobody writes into would hold the reader up for good.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as error:
        raise refusal("scene file", getattr(error, "strerror", None) or str(error), expectation, str(path)) from None
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise refusal("scene file", "a folder, pipe or device", expectation, str(path))
        data = b""
        while len(data) <= MAX_FILE_BYTES and (part := os.read(descriptor, MAX_FILE_BYTES + 1 - len(data))):
            data += part
    except OSError as error:
        raise refusal("scene file", error.strerror or str(error), expectation, str(path)) from None
    finally:
        os.close(descriptor)
    if len(data) > MAX_FILE_BYTES:
        raise refusal("scene file", "a larger file", expectation, str(path))
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise refusal("scene file", "bytes that are no UTF-8 text", expectation, str(path)) from None


def parse_yaml(text: str, source: str = "", what: str = "scene file") -> Any:
    """Return what a YAML text holds: mappings with text for keys, lists, numbers, text, true, false and null.

    Raises:
        ConfigurationError: it is no YAML, or uses aliases or tags, or is too deep.
    """
    try:
        depth = 0
        for event in yaml.parse(text, Loader=yaml.CSafeLoader):
            problem = ""
            if isinstance(event, (yaml.SequenceStartEvent, yaml.MappingStartEvent)):
                depth += 1
                problem = f"lists and mappings {depth} deep" if depth > MAX_DEPTH else ""
            elif isinstance(event, (yaml.SequenceEndEvent, yaml.MappingEndEvent)):
                depth -= 1
            elif isinstance(event, yaml.ScalarEvent) and len(event.value) > MAX_WORD_CHARS:
                problem = f"a word of {len(event.value)} characters"
            if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
                problem = "an anchor or alias (& or *)"
            elif isinstance(event, yaml.NodeEvent) and getattr(event, "tag", None) not in (None, "!"):
                problem = "a tag (!)"
            if problem:
                where = f" in line {event.start_mark.line + 1}" if event.start_mark else ""
                raise refusal(what, problem + where, f"plain YAML, at most {MAX_DEPTH} deep", source)
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        problem = " ".join(str(getattr(error, "problem", None) or error).split())
        mark = getattr(error, "problem_mark", None)
        raise refusal(what, problem + (f" in line {mark.line + 1}" if mark else ""), "valid YAML", source) from None
    except (ValueError, UnicodeError):
        raise refusal(what, "a character that YAML does not allow", "valid YAML", source) from None


def parse_json(text: str, source: str = "", what: str = "scene file") -> Any:
    """Return what a JSON text holds; a name that stands twice is refused, as are NaN and Infinity.

    Raises:
        ConfigurationError: it is no JSON, or is too deep.
    """

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        mapping = dict(pairs)
        if len(mapping) < len(pairs):
            twice, _ = Counter(name for name, _ in pairs).most_common(1)[0]
            raise refusal(what, f"{twice} is given twice", "each name once", source)
        return mapping

    def whole(digits: str) -> int:
        if len(digits) > MAX_WORD_CHARS:
            raise refusal(what, digits, "a number that can be written", source)
        return int(digits)

    def constant(name: str) -> float:
        raise refusal(what, name, "finite numbers", source)

    try:
        # Its own depth is bounded by that of Python's stack: the error for it is caught below.
        found = json.loads(text, object_pairs_hook=once, parse_int=whole, parse_constant=constant)
    except json.JSONDecodeError as error:
        raise refusal(what, f"{error.msg} in line {error.lineno}", "valid JSON", source) from None
    except RecursionError:
        raise refusal(what, "lists too deep", f"JSON at most {MAX_DEPTH} deep", source) from None
    return found


def is_number(value: Any) -> bool:
    """Return whether a value is a finite number, and no truth value."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number beyond any float
        return False
