"""A configuration class as the parameters of a node: declared, and changed while it runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from types import MappingProxyType
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from magnetosuture_thread import ConfigurationError, MagnetosutureError
from magnetosuture_thread.configuration import (
    ROS_PARAMETERS,
    Configuration,
    ConfigurationField,
    configuration_fields,
    from_mapping,
    to_mapping,
)
from magnetosuture_thread.shared_parameters import SHARED_PARAMETERS

C = TypeVar("C", bound=Configuration)

_TYPES = {
    float: Parameter.Type.DOUBLE,
    int: Parameter.Type.INTEGER,
    str: Parameter.Type.STRING,
    bool: Parameter.Type.BOOL,
}
_ARRAYS = {
    float: Parameter.Type.DOUBLE_ARRAY,
    int: Parameter.Type.INTEGER_ARRAY,
    str: Parameter.Type.STRING_ARRAY,
}
MAX_LIST_LENGTH = 1000  # entries that a parameter may be set to while the node runs: what it builds of them takes time
_MAX_REASON_CHARS = 400  # characters


def _type(about: ConfigurationField) -> Parameter.Type:
    return _ARRAYS[about.entry] if about.kind is tuple else _TYPES[about.kind]


def declare(node: Node, cls: type[C], *, read_only: bool = True, fixed: Mapping[str, str] = MappingProxyType({})) -> C:
    """Declare every field of a configuration class and return the settings in force.

    The node must have been made with the options of `nodes/parameter_files.py`: only so is a parameter that was set
    from outside but that the node does not know, a slip of the pen, noticed. Shared parameters that it does not know
    are meant for others, and left aside.

    Args:
        node: that gets the parameters.
        cls: the configuration class.
        read_only: whether they stay as they are for good; else they can be declared again.
        fixed: those that the node keeps while it is configured, by name, and why, or an empty text; for their
            descriptions.

    Raises:
        ConfigurationError: a parameter is unknown, of the wrong type or out of its bounds.
    """
    given = {
        name: plain_value(parameter)
        for name, parameter in node.get_parameters_by_prefix("").items()
        if name.split(".")[0] not in ROS_PARAMETERS
    }
    known = {about.name for about in configuration_fields(cls)}
    for name in sorted(given.keys() & set(SHARED_PARAMETERS) - known):
        node.undeclare_parameter(name)
        del given[name]
    settings = from_mapping(cls, given)
    values = to_mapping(settings)
    for about in configuration_fields(cls):
        if about.name in given:
            node.undeclare_parameter(about.name)
        descriptor = _descriptor(about, read_only, fixed.get(about.name))
        _declare(node, about, values[about.name], descriptor)
    return settings


def declare_unchecked(node: Node, cls: type[Configuration]) -> None:
    """Declare all fields of a node that `declare` refused, so that each can be set before `declare` is called again.

    What was given stays, also where it is invalid, and may be set to a value of another type.
    """
    for about in configuration_fields(cls):
        if not node.has_parameter(about.name):
            _declare(node, about, about.default, _descriptor(about, False, None))
        elif (value := plain_value(node.get_parameter(about.name))) not in (None, []):
            node.undeclare_parameter(about.name)
            node.declare_parameter(about.name, value, ParameterDescriptor(dynamic_typing=True), ignore_override=True)


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
    value = plain_value(parameter)
    if about is None:
        return parameter
    if about.kind is tuple and value == []:
        return Parameter(parameter.name, _type(about), [])
    if (_type(about), parameter.type_) == (Parameter.Type.DOUBLE, Parameter.Type.INTEGER):
        return Parameter(parameter.name, _type(about), float(value))
    if (_type(about), parameter.type_) == (Parameter.Type.DOUBLE, Parameter.Type.STRING):
        with suppress(ValueError):  # no number: refused by its type
            return Parameter(parameter.name, _type(about), float(value))
    if (_type(about), parameter.type_) == (Parameter.Type.DOUBLE_ARRAY, Parameter.Type.INTEGER_ARRAY):
        return Parameter(parameter.name, _type(about), [float(entry) for entry in value])
    return parameter


class Changeable(Generic[C]):
    """Settings that follow a node's parameters while it runs.

    Whatever is asked for, by service or by `set`, is checked together with all that stays, by the configuration
    class. Nothing is changed before all of the node's callbacks have agreed; then it is at once.

    Args:
        node: has these settings declared as its parameters.
        settings: in force.
        prepare: makes what the node needs of other settings and returns what puts them in force, which must not
            fail; raises a `MagnetosutureError` where they cannot be used.

    Attributes:
        settings: in force.
    """

    def __init__(self, node: Node, settings: C, prepare: Callable[[C], Callable[[], None]]) -> None:
        self.settings = settings
        self._node, self._prepare = node, prepare
        self._about = {about.name: about for about in configuration_fields(type(settings))}
        self._agreed: tuple[C, Callable[[], None]] | None = None
        node.add_pre_set_parameters_callback(self._as_declared)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._put_in_force)

    def close(self) -> None:
        """Follow the parameters no more."""
        self._node.remove_pre_set_parameters_callback(self._as_declared)
        self._node.remove_on_set_parameters_callback(self._check)
        self._node.remove_post_set_parameters_callback(self._put_in_force)

    def set(self, values: Mapping[str, Any]) -> None:
        """Set parameters together, as the service does.

        Raises:
            MagnetosutureError: they are refused; nothing has changed.
        """
        parameters = [Parameter(name, _type(self._about[name]), value) for name, value in values.items()]
        if not parameters:
            return
        result = self._node.set_parameters_atomically(parameters)
        if not result.successful:
            raise MagnetosutureError(result.reason)

    def _as_declared(self, parameters: Sequence[Parameter]) -> list[Parameter]:
        return as_declared(type(self.settings), parameters)

    def _check(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        self._agreed = None
        asked = {entry.name: plain_value(entry) for entry in parameters if entry.name in self._about}
        if not asked:
            return SetParametersResult(successful=True)
        try:
            self._check_lengths(asked)
            settings = from_mapping(type(self.settings), {**to_mapping(self.settings), **asked})
            self._agreed = settings, self._prepare(settings)
        except MagnetosutureError as error:
            return SetParametersResult(successful=False, reason=_reason(error, asked))
        return SetParametersResult(successful=True)

    def _check_lengths(self, asked: Mapping[str, Any]) -> None:
        for name, value in asked.items():
            if isinstance(value, list) and len(value) > MAX_LIST_LENGTH:
                where = f"{self.settings.GROUP}.{name}"
                raise ConfigurationError(
                    where, f"{len(value)} entries", f"at most {MAX_LIST_LENGTH} while the node runs"
                )

    def _put_in_force(self, parameters: Sequence[Parameter]) -> None:
        if self._agreed is not None:
            (self.settings, put_in_force), self._agreed = self._agreed, None
            put_in_force()


def _reason(error: MagnetosutureError, asked: Mapping[str, Any]) -> str:
    """Return why a change was refused, in one line: of a long list its beginning and what was expected."""
    text = " ".join(str(error).split())
    if len(text) > _MAX_REASON_CHARS:
        text = f"{text[: _MAX_REASON_CHARS // 2]} … {text[-_MAX_REASON_CHARS // 2 :]}"
    named = error.name.partition(".")[2] if isinstance(error, ConfigurationError) else ""
    return (
        text if named in ("", *asked) else f"{text}; what belongs together is set at once, by set_parameters_atomically"
    )


def _declare(node: Node, about: ConfigurationField, value: Any, descriptor: ParameterDescriptor) -> None:
    if not isinstance(value, (list, tuple)) or len(value):
        node.declare_parameter(about.name, value, descriptor, ignore_override=True)
        return
    # By its value alone rclpy would take an empty list for one of bytes, for good.
    node.declare_parameter(about.name, _type(about), ParameterDescriptor(), ignore_override=True)
    node.set_parameters([Parameter(about.name, _type(about), [])])
    node.set_descriptor(about.name, descriptor)


def plain_value(parameter: Parameter) -> Any:
    """Return a parameter's value as YAML has it: an array as a list."""
    value = parameter.value
    return list(value) if hasattr(value, "typecode") or isinstance(value, tuple) else value


def _descriptor(about: ConfigurationField, read_only: bool, fixed: str | None) -> ParameterDescriptor:
    quantity, why = about.quantity, f": {fixed}" if fixed else ""
    expectation = quantity.expectation(about.kind)
    descriptor = ParameterDescriptor(
        name=about.name,
        type=_type(about).value,
        description=f"{quantity.description} [{quantity.unit}]" if quantity.unit else quantity.description,
        additional_constraints=expectation
        if fixed is None
        else f"{expectation}; stays while the node is configured{why}",
        read_only=read_only,
    )
    if quantity.minimum is not None and quantity.maximum is not None:
        if about.kind is float:
            bounds = FloatingPointRange(from_value=float(quantity.minimum), to_value=float(quantity.maximum))
            descriptor.floating_point_range = [bounds]
        elif about.kind is int:
            whole = IntegerRange(from_value=int(quantity.minimum), to_value=int(quantity.maximum), step=1)
            descriptor.integer_range = [whole]
    return descriptor
