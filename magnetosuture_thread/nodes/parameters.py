"""A node's settings as ROS parameters: what files and the command line give, and how they are declared.

By itself rcl takes what matches the node's full name, and says nothing of a file of which nothing does: the node would
run on its defaults. It also merges all files and `-p` by key, so that `-p driver:=simulated` or a later file, both
`/**`, are overridden by `/**/coil_bridge` of an earlier file that begins with `/**`. So parameters are worked out here,
as the command line reads.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any, TypeVar, cast
from weakref import WeakKeyDictionary

import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.utilities import get_default_context

from magnetosuture_thread import ConfigurationError
from magnetosuture_thread.settings.configuration import (
    ROS_PARAMETERS,
    Configuration,
    ConfigurationField,
    configuration_fields,
    from_mapping,
    parse_parameter_value,
    to_mapping,
)
from magnetosuture_thread.settings.parameter_files import (
    EVERY_NODE,
    check_list_value,
    format_key,
    key_matches,
    node_of_key,
    read_sections,
)
from magnetosuture_thread.settings.shared_parameters import SHARED_PARAMETERS

C = TypeVar("C", bound=Configuration)

_ARGUMENTS: WeakKeyDictionary[Context, list[str]] = WeakKeyDictionary()  # of each context, where it is known


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
    for flag, value in _flags(given):
        if flag == "--params-file":
            read_sections(Path(value))
    context = context or get_default_context()
    rclpy.init(args=given, context=context, **options)
    _ARGUMENTS[context] = given


def given_parameters(node: Node, kind: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters that are meant for a node, by name, without those of rclpy; what comes later counts.

    `use_sim_time` is put in force here, as rcl does not know sections by a node's kind.

    Args:
        node: in any namespace and under any name.
        kind: the node's own name, under which parameter files know it whatever it is renamed to.
        options: as given to the node: `cli_args`, `parameter_overrides` and others of rclpy.

    Raises:
        ConfigurationError: a parameter file cannot be used, or nothing in it is for this node.
    """
    arguments = list(_flags(options.get("cli_args") or []))  # the node's own override the process's
    if options.get("use_global_arguments", True):
        context, default = options.get("context"), get_default_context()
        # Those that the context was initialised with: as `init` saw them, else the process's own.
        whole = _ARGUMENTS.get(context or default, sys.argv if context in (None, default) else [])
        arguments = [*_flags(whole), *arguments]
    given: dict[str, Any] = {}
    for flag, value in arguments:
        if flag == "--params-file":
            for key, section in _sections_for(Path(value), kind, node.get_fully_qualified_name()):
                for name, entry in section.items():
                    check_list_value(f"{key}.{name}", entry, value)
                given.update(section)
        elif flag in ("-p", "--param"):
            left, _, right = value.partition(":=")
            owner, _, name = left.rpartition(":")
            if owner in ("", kind, node.get_name()):
                given[name] = parse_parameter_value(right)
    given.update({each.name: plain_value(each) for each in options.get("parameter_overrides") or []})
    if isinstance(clock := given.get("use_sim_time"), bool):
        node.set_parameters([Parameter("use_sim_time", value=clock)])
    return {name: value for name, value in given.items() if name.split(".")[0] not in ROS_PARAMETERS}


def settings_of(node: Node, cls: type[C], options: Mapping[str, Any]) -> C:
    """Return the settings of another kind of node in the namespace of this one, as the same files give them.

    What no file gives keeps its default.

    Args:
        node: this one.
        cls: settings of the other.
        options: as given to this node; of its own parameters those count that nodes share.

    Raises:
        ConfigurationError: a value is invalid.
    """
    name = f"{node.get_fully_qualified_name().rpartition('/')[0]}/{cls.GROUP}"
    other = SimpleNamespace(
        get_name=lambda: cls.GROUP, get_fully_qualified_name=lambda: name, set_parameters=lambda _: None
    )
    own = [each for each in options.get("parameter_overrides") or [] if each.name in SHARED_PARAMETERS]
    known, given = {each.name for each in configuration_fields(cls)}, {each.name: plain_value(each) for each in own}
    with suppress(ConfigurationError):  # a file that is for this node alone
        given = given_parameters(cast(Node, other), cls.GROUP, {**options, "parameter_overrides": own})
    return from_mapping(cls, {name: value for name, value in given.items() if name in known})


def _flags(arguments: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Give each argument between `--ros-args` and `--` with the one after it; rcl refuses what is broken."""
    is_ros = False
    for flag, value in zip(arguments, [*arguments[1:], ""], strict=False):
        if flag in ("--ros-args", "--"):
            is_ros = flag == "--ros-args"
        elif is_ros:
            yield flag, value


def _sections_for(path: Path, kind: str, node: str) -> list[tuple[str, dict[str, Any]]]:
    """Return the sections of a file that are for a node, by its own name or the one that it was given."""
    sections, space = read_sections(path), node.rpartition("/")[0]
    names = {node, f"{space}/{kind}"}
    fitting = [(key, values) for key, values in sections if any(key_matches(key, name) for name in names)]
    own = {key for key, _ in sections if node_of_key(key) in (kind, node_of_key(node))}
    # A section of its kind that is for another namespace only is as bad as none: the rest would be its defaults.
    if not fitting or (own and not any(key in own for key, _ in fitting)):
        expected = f"one for {node}: {EVERY_NODE}/{kind} or {node}" + ("" if own else f" or {EVERY_NODE}")
        found = ", ".join(format_key(key) for key, _ in sections) or "none"
        raise ConfigurationError("sections", found, expected, str(path))
    return fitting


def declare(
    node: Node,
    cls: type[C],
    given: Mapping[str, Any],
    *,
    read_only: bool = True,
    fixed: Mapping[str, str] = MappingProxyType({}),
) -> C:
    """Declare every field of a configuration class and return the settings in force.

    Shared parameters that the class does not know are meant for others, and left aside.

    Args:
        node: that gets the parameters.
        cls: the configuration class.
        given: values by name.
        read_only: whether they stay as they are for good.
        fixed: those that the node keeps while it is configured, by name, and why, or an empty text; for their
            descriptions.

    Raises:
        ConfigurationError: a parameter is unknown, of the wrong type or out of its bounds.
    """
    fields = configuration_fields(cls)
    others = set(SHARED_PARAMETERS) - {about.name for about in fields}
    settings = from_mapping(cls, {name: value for name, value in given.items() if name not in others})
    for name, value in to_mapping(settings).items():
        about = next(field for field in fields if field.name == name)
        descriptor = _descriptor(about, read_only, fixed.get(name))
        if not isinstance(value, (list, tuple)) or len(value):
            node.declare_parameter(name, value, descriptor, ignore_override=True)
        else:  # by its value alone rclpy would take an empty list for one of bytes, for good
            node.declare_parameter(name, _type(about), ParameterDescriptor(), ignore_override=True)
            node.set_parameters([Parameter(name, _type(about), [])])
            node.set_descriptor(name, descriptor)
    return settings


def _descriptor(about: ConfigurationField, read_only: bool, fixed: str | None) -> ParameterDescriptor:
    quantity, constraints = about.quantity, about.quantity.expectation(about.kind)
    if fixed is not None:
        constraints += "; stays while the node is configured" + (f": {fixed}" if fixed else "")
    low, high = quantity.minimum, quantity.maximum
    ranges: dict[str, Any] = {}
    if low is not None and high is not None and about.kind is float:
        ranges["floating_point_range"] = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    elif low is not None and high is not None and about.kind is int:
        ranges["integer_range"] = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    return ParameterDescriptor(
        name=about.name,
        type=_type(about).value,
        description=f"{quantity.description} [{quantity.unit}]" if quantity.unit else quantity.description,
        additional_constraints=constraints,
        read_only=read_only,
        **ranges,
    )


def _type(about: ConfigurationField) -> Parameter.Type:
    kinds = {float: Parameter.Type.DOUBLE, int: Parameter.Type.INTEGER, str: Parameter.Type.STRING}
    if about.kind is tuple:
        return Parameter.Type[f"{kinds[about.entry].name}_ARRAY"]
    return Parameter.Type.BOOL if about.kind is bool else kinds[about.kind]


def as_declared(cls: type[C], parameters: Sequence[Parameter]) -> list[Parameter]:
    """Take whole numbers for real ones and any empty list for an empty one of its kind, as `declare` does.

    `ros2 param load` sends an empty list as one of truth values, and 1e-05, a text for YAML 1.1, as a text.

    Args:
        cls: the configuration class whose fields are declared.
        parameters: to be set.
    """
    fields = {about.name: about for about in configuration_fields(cls)}
    return [_converted(fields.get(parameter.name), parameter) for parameter in parameters]


def _converted(about: ConfigurationField | None, parameter: Parameter) -> Parameter:
    if about is None:
        return parameter
    value, kind = plain_value(parameter), parameter.type_
    if about.kind is tuple and value == []:
        return Parameter(parameter.name, _type(about), [])
    if about.kind is float and kind in (Parameter.Type.INTEGER, Parameter.Type.STRING):
        with suppress(ValueError):  # no number: refused by its type
            return Parameter(parameter.name, Parameter.Type.DOUBLE, float(value))
    if _type(about) is Parameter.Type.DOUBLE_ARRAY and kind is Parameter.Type.INTEGER_ARRAY:
        return Parameter(parameter.name, Parameter.Type.DOUBLE_ARRAY, [float(entry) for entry in value])
    return parameter


def plain_value(parameter: Parameter) -> Any:
    """Return a parameter's value as YAML has it: an array as a list."""
    value = parameter.value
    return list(value) if hasattr(value, "typecode") or isinstance(value, tuple) else value
