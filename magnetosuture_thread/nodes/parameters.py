"""A node's settings as ROS parameters: what files and the command line give, and how they are declared.

By itself rcl takes what matches the node's full name, and says nothing of a file of which nothing does: the node would
run on its defaults. It also merges all files and `-p` by key, so that `-p driver:=simulated` or a later file, both
`/**`, are overridden by `/**/coil_bridge` of an earlier file that begins with `/**`. So parameters are worked out here,
as the command line reads.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar
from weakref import WeakKeyDictionary, ref

import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.context import Context
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.utilities import get_default_context

from magnetosuture_thread import ConfigurationError, MagnetosutureError
from magnetosuture_thread.settings import configuration
from magnetosuture_thread.settings import shared_parameters as shared
from magnetosuture_thread.settings.configuration import Configuration, ConfigurationField, from_mapping

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
        MagnetosutureError: see `start_ros`.
    """
    line = list(sys.argv if arguments is None else arguments)
    for flag, value in _flags(line):
        if flag == "--params-file":
            shared.read_sections(Path(value))
    context = context or get_default_context()
    start_ros(context, args=line, **options)
    _ARGUMENTS[context] = line


def start_ros(context: Context, **options: Any) -> None:
    """Initialise a context as `rclpy.init` does.

    Raises:
        MagnetosutureError: ROS cannot start, as where its folder for logs cannot be written.
    """
    try:
        rclpy.init(context=context, **options)
    except RuntimeError as error:  # rclpy's own kinds of it are private
        remedy = "; set ROS_LOG_DIR to a folder that can be written" if "logging" in str(error) else ""
        raise MagnetosutureError(f"{error}{remedy}") from None


def declare(node: Node, cls: type[C], options: Mapping[str, Any], fixed: Mapping[str, str] | None = None) -> C:
    """Declare every field of a configuration class and return the settings in force.

    Their values are those of the parameter files and the command line that are meant for this node, of which the later
    one counts. Shared parameters that the class does not know are meant for others, and left aside. `use_sim_time` is
    put in force, as rcl does not know sections by a node's kind.

    Args:
        node: that gets the parameters, in any namespace and under any name.
        cls: the configuration class; by its `GROUP` parameter files know the node whatever it is renamed to.
        options: as given to the node: `cli_args`, `parameter_overrides` and others of rclpy.
        fixed: those that the node keeps while it is configured, by name, and why, or an empty text; if None, all stay
            as they are for good.

    Raises:
        ConfigurationError: a parameter is unknown, of the wrong type or out of its bounds, a parameter file cannot be
            used, or nothing in it is for this node.
    """
    values = _parameters(cls.GROUP, node.get_fully_qualified_name(), options)
    if isinstance(clock := values.get("use_sim_time"), bool):
        node.set_parameters([Parameter("use_sim_time", value=clock)])
    others = {*shared.SHARED_PARAMETERS, *configuration.ROS_PARAMETERS} - shared.names_of(cls)
    settings = from_mapping(cls, {name: value for name, value in values.items() if name.split(".")[0] not in others})
    fields = configuration.configuration_fields(cls)
    for setting in fields:  # by their types: by its value rclpy would take an empty list for one of bytes, for good
        node.declare_parameter(setting.name, _type(setting), ignore_override=True)
    node.set_parameters_atomically([_parameter(setting, getattr(settings, setting.name)) for setting in fields])
    for setting in fields:
        node.set_descriptor(setting.name, _descriptor(setting, fixed))
    weak = ref(node)  # where a constructor fails, nothing may keep the node: it would stay in the graph
    node.add_pre_set_parameters_callback(lambda parameters: _as_declared(weak(), cls, parameters))
    return settings


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
    overrides = [item for item in options.get("parameter_overrides") or [] if item.name in shared.SHARED_PARAMETERS]
    name = f"{node.get_fully_qualified_name().rpartition('/')[0]}/{cls.GROUP}"
    values = _parameters(cls.GROUP, name, {**options, "parameter_overrides": overrides}, is_required=False)
    return from_mapping(cls, {name: values[name] for name in values.keys() & shared.names_of(cls)})


def _parameters(kind: str, node: str, options: Mapping[str, Any], *, is_required: bool = True) -> dict[str, Any]:
    """Return the parameters for a node of a kind and a full name, by name; what comes later counts."""
    arguments = list(_flags(options.get("cli_args") or []))  # the node's own override the process's
    if options.get("use_global_arguments", True):
        context, default = options.get("context"), get_default_context()
        # Those that the context was initialised with: as `init` saw them, else the process's own.
        whole = _ARGUMENTS.get(context or default, sys.argv if context in (None, default) else [])
        arguments = [*_flags(whole), *arguments]
    values: dict[str, Any] = {}
    for flag, value in arguments:
        if flag == "--params-file":
            for section in _sections_for(Path(value), kind, node, is_required):
                values.update(section)
        elif flag in ("-p", "--param"):
            left, _, right = value.partition(":=")
            owner, _, name = left.rpartition(":")
            if owner in ("", kind, node.rpartition("/")[2]):
                values[name] = configuration.parse_parameter_value(right)
    return values | {override.name: plain_value(override) for override in options.get("parameter_overrides") or []}


def _flags(arguments: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield each argument between `--ros-args` and `--` with the one after it; rcl refuses what is broken."""
    is_ros = False
    for flag, value in zip(arguments, [*arguments[1:], ""], strict=False):
        if flag in ("--ros-args", "--"):
            is_ros = flag == "--ros-args"
        elif is_ros:
            yield flag, value


def _sections_for(path: Path, kind: str, node: str, is_required: bool) -> list[dict[str, Any]]:
    """Return the sections of a file that are for a node, by its own name or the one that it was given."""
    sections, (space, _, name) = shared.read_sections(path), node.rpartition("/")
    names, every = (node, f"{space}/{kind}"), shared.EVERY_NODE
    fitting = {key for key, _ in sections if any(shared.key_matches(key, name) for name in names)}
    of_kind = {key for key, _ in sections if key.rpartition("/")[2] in (kind, name)}
    # A section of its kind that is for another namespace only is as bad as none: the rest would be its defaults.
    if is_required and (not fitting or (of_kind and not fitting & of_kind)):
        expected = f"one for {node}: {every}/{kind} or {node}" + ("" if of_kind else f" or {every}")
        keys = ", ".join(key for key, _ in sections) or "none"
        raise ConfigurationError("sections", keys, expected, str(path))
    return [values for key, values in sections if key in fitting]


def _descriptor(setting: ConfigurationField, fixed: Mapping[str, str] | None) -> ParameterDescriptor:
    quantity, constraints = setting.quantity, setting.quantity.expectation(setting.kind, entry=setting.entry)
    if fixed is not None and setting.name in fixed:
        why = fixed[setting.name]
        constraints += "; stays while the node is configured" + (f": {why}" if why else "")
    ranges: dict[str, Any] = {}
    if setting.kind in (float, int) and math.isfinite(quantity.maximum):
        limits = {"from_value": setting.kind(quantity.minimum), "to_value": setting.kind(quantity.maximum)}
        if setting.kind is float:
            ranges = {"floating_point_range": [FloatingPointRange(**limits)]}
        else:
            ranges = {"integer_range": [IntegerRange(**limits, step=1)]}
    description = f"{quantity.description} [{quantity.unit}]" if quantity.unit else quantity.description
    texts = {"description": description, "additional_constraints": constraints}
    return ParameterDescriptor(type=_type(setting).value, read_only=fixed is None, **texts, **ranges)


def _type(setting: ConfigurationField) -> Parameter.Type:
    return Parameter.Type.from_parameter_value([setting.entry()] if setting.kind is tuple else setting.kind())


def _parameter(setting: ConfigurationField, value: Any) -> Parameter:
    return Parameter(setting.name, _type(setting), list(value) if setting.kind is tuple else value)


def _as_declared(node: Any, cls: type[Configuration], parameters: Sequence[Parameter]) -> list[Parameter]:
    """Return parameters in the types of the fields: a whole number for a real one, any empty list for one of its kind.

    `ros2 param load` sends an empty list as one of truth values, and 1e-05, a text for YAML 1.1, as a text. What is not
    valid stays as it is, to be refused by its type or bounds.

    Raises:
        ParameterNotDeclaredException: an unknown name. The services of rclpy answer its text; by itself rclpy forgets
            the name.
    """
    fields = {setting.name: setting for setting in configuration.configuration_fields(cls)}
    converted = []
    for parameter in parameters:
        name, value, setting = parameter.name, plain_value(parameter), fields.get(parameter.name)
        if setting is None and not (name and node.has_parameter(name)):
            expected = configuration.suggest_names(name, list(fields))
            raise ParameterNotDeclaredException(str(ConfigurationError(f"{cls.GROUP}.{name}", value, expected)))
        if setting is not None and value is not None:
            if isinstance(value, str) and setting.kind is float:
                value = configuration.parse_parameter_value(value)
            with suppress(ConfigurationError):
                parameter = _parameter(setting, setting.checked(value))
        converted.append(parameter)
    return converted


def plain_value(parameter: Parameter) -> Any:
    """Return a parameter's value as YAML has it: an array as a list."""
    value = parameter.value
    return list(value) if hasattr(value, "typecode") or isinstance(value, tuple) else value
