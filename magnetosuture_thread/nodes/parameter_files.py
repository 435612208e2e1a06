"""Parameter files and `-p` for a node in any namespace and under any name.

By itself rcl takes what matches the node's full name, and says nothing of a file of which nothing does: the node would
run on its defaults. It also merges all files and `-p` by key, so that `-p driver:=simulated` or a later file, both
`/**`, are overridden by `/**/coil_bridge` of an earlier file that begins with `/**`. So parameters are worked out here,
as the command line reads, and given to the node as overrides, which come before all that rcl has found.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import rclpy
from rclpy.context import Context
from rclpy.parameter import Parameter
from rclpy.utilities import get_default_context

from magnetosuture_thread import ConfigurationError
from magnetosuture_thread.configuration import parse_parameter_value
from magnetosuture_thread.parameter_files import (
    EVERY_NODE,
    check_list_value,
    format_key,
    key_matches,
    node_of_key,
    read_sections,
)

_ARGUMENTS: WeakKeyDictionary[Context, list[str]] = WeakKeyDictionary()  # of each context, where it is known


@dataclass
class RosArguments:
    """The ROS arguments of a command line: parameters and names.

    Attributes:
        parameters: parameter files, and `-p` rules as (node, name, value), in their order.
        remaps: `-r` rules as (node, name, value), in their order; the node is empty for all.
    """

    parameters: list[Path | tuple[str, str, str]] = field(default_factory=list)
    remaps: list[tuple[str, str, str]] = field(default_factory=list)

    @classmethod
    def of(cls, arguments: Sequence[str]) -> RosArguments:
        """Read a command line; what is not for ROS is left aside, and what is broken is left to rcl to refuse."""
        result = cls()
        for flag, value in _flags(arguments):
            if flag == "--params-file":
                result.parameters.append(Path(value))
            left, sign, right = value.partition(":=")
            node, _, name = left.rpartition(":")
            if sign and flag in ("-p", "--param"):
                result.parameters.append((node, name, right))
            elif sign and flag in ("-r", "--remap"):
                result.remaps.append((node, name, right))
        return result

    def files(self) -> list[Path]:
        """Return the parameter files."""
        return [given for given in self.parameters if isinstance(given, Path)]


def _flags(arguments: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Give each argument between `--ros-args` and `--` with the one after it."""
    is_ros = False
    for flag, value in zip(arguments, [*arguments[1:], ""], strict=False):
        if flag in ("--ros-args", "--"):
            is_ros = flag == "--ros-args"
        elif is_ros:
            yield flag, value


def init(arguments: Sequence[str] | None = None, context: Context | None = None, **options: Any) -> None:
    """Initialise ROS as `rclpy.init` does, and remember the arguments for the nodes of this context.

    Args:
        arguments: of the command line; those of the process if None.
        context: rclpy's default one if None.
        options: for `rclpy.init`.

    Raises:
        ConfigurationError: a parameter file does not exist, or is none.
    """
    given = list(sys.argv if arguments is None else arguments)
    for path in RosArguments.of(given).files():
        read_sections(path)
    context = context or get_default_context()
    rclpy.init(args=given, context=context, **options)
    _ARGUMENTS[context] = given


def node_options(kind: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options for rclpy's node under which it gets every parameter that is meant for it.

    Args:
        kind: the node's own name, under which parameter files know it whatever it is renamed to.
        options: as given to the node: `cli_args`, `namespace`, `parameter_overrides` and others of rclpy.

    Raises:
        ConfigurationError: a parameter file cannot be used, or nothing in it is for this node.
    """
    command_lines = [RosArguments.of(options.get("cli_args") or [])]
    if options.get("use_global_arguments", True):
        command_lines.append(RosArguments.of(_global_arguments(options.get("context"))))
    node = _full_name(kind, str(options.get("namespace") or ""), command_lines)
    given: dict[str, Any] = {}
    for line in reversed(command_lines):  # the node's own arguments override the process's
        given.update(_parameters(line, kind, node))
    explicit = {parameter.name: parameter for parameter in options.get("parameter_overrides") or []}
    overrides = {name: _parameter(kind, name, value) for name, value in given.items()} | explicit
    return {
        **options,
        "automatically_declare_parameters_from_overrides": True,
        "parameter_overrides": list(overrides.values()),
    }


def _global_arguments(context: Context | None) -> list[str]:
    """Return the arguments that a context was initialised with: as `init` saw them, else the process's own."""
    if context is None or context is get_default_context():
        return _ARGUMENTS.get(get_default_context(), sys.argv)
    return _ARGUMENTS.get(context, [])


def _full_name(kind: str, namespace: str, command_lines: Sequence[RosArguments]) -> str:
    """Return the fully qualified name that remapping gives to a node: the first rule that fits, its own before all."""

    def renamed(names: tuple[str, ...], default: str) -> str:
        rules = [rule for line in command_lines for rule in line.remaps]
        return next((value for node, name, value in rules if name in names and node in ("", kind)), default)

    space = renamed(("__ns",), namespace).strip("/")
    return "/".join(["", *([space] if space else []), renamed(("__node", "__name"), kind)])


def _parameters(line: RosArguments, kind: str, node: str) -> dict[str, Any]:
    """Return what a command line gives to a node, by name; nested names with dots."""
    given: dict[str, Any] = {}
    for entry in line.parameters:
        if isinstance(entry, Path):
            for key, values in _sections_for(entry, kind, node):
                flat = _flat("", values)
                for name, value in flat.items():
                    check_list_value(f"{key}.{name}", value, str(entry))
                given.update(flat)
        elif entry[0] in ("", kind, node_of_key(node)):
            given[entry[1]] = parse_parameter_value(entry[2])
    return given


def _sections_for(path: Path, kind: str, node: str) -> list[tuple[str, dict[str, Any]]]:
    """Return the sections of a file that are for a node, by its own name or the one that it was given."""
    sections, space = read_sections(path), node.rpartition("/")[0]
    names = {node, f"{space}/{kind}"}
    fitting = [(key, values) for key, values in sections if any(key_matches(key, name) for name in names)]
    own = {key for key, _ in sections if node_of_key(key) in (kind, node_of_key(node))}
    # A section of its kind that is for another namespace only is as bad as none: the rest would be its defaults.
    if not fitting or (own and not any(key in own for key, _ in fitting)):
        expected = f"one for {node}: {EVERY_NODE}/{kind} or {node}" + ("" if own else f" or {EVERY_NODE}")
        raise ConfigurationError(
            "sections", ", ".join(format_key(key) for key, _ in sections) or "none", expected, str(path)
        )
    return fitting


def _flat(above: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return parameters with the names that ROS gives them: `a.b` for b within a."""
    result: dict[str, Any] = {}
    for name, value in values.items():
        whole = f"{above}.{name}" if above else str(name)
        result.update(_flat(whole, value) if isinstance(value, Mapping) else {whole: value})
    return result


def _parameter(kind: str, name: str, value: Any) -> Parameter:
    """Return a parameter of the type that ROS gives to a value."""
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        value = str(value)
    try:
        return Parameter(name, value=value)
    except (TypeError, ValueError):
        expected = "a number, a text, true or false, or a list of one of these"
        raise ConfigurationError(f"{kind}.{name}", value, expected) from None
