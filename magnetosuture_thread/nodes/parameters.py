"""Declares a configuration class as the parameters of a node."""

from __future__ import annotations

from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from magnetosuture_thread.configuration import OF_ROS, Configuration, Described, described, from_mapping, to_mapping

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


def _type(about: Described) -> Parameter.Type:
    return _ARRAYS[about.entry] if about.kind is tuple else _TYPES[about.kind]


def declare(node: Node, cls: type[C], *, read_only: bool = True) -> C:
    """Declare every field of a configuration class and return the settings in force.

    The node must have been made with `automatically_declare_parameters_from_overrides=True`: only so
    is a parameter that was set from outside but that the node does not know, a slip of the pen,
    noticed.

    Args:
        node: that gets the parameters.
        cls: the configuration class.
        read_only: whether they stay as they are for good; else they can be declared again.

    Raises:
        ConfigurationError: a parameter is unknown, of the wrong type or out of its bounds.
    """
    given = {
        name: parameter.value
        for name, parameter in node.get_parameters_by_prefix("").items()
        if name.split(".")[0] not in OF_ROS
    }
    settings = from_mapping(cls, {name: _plain(value) for name, value in given.items()})
    values = to_mapping(settings)
    for about in described(cls):
        if about.name in given:
            node.undeclare_parameter(about.name)
        parameter = Parameter(about.name, _type(about), values[about.name])
        node.declare_parameter(about.name, parameter.value, _descriptor(about, read_only), ignore_override=True)
    return settings


def _plain(value: Any) -> Any:
    """Return a parameter's value as YAML has it: an array as a list."""
    return list(value) if hasattr(value, "typecode") or isinstance(value, tuple) else value


def _descriptor(about: Described, read_only: bool) -> ParameterDescriptor:
    quantity = about.quantity
    descriptor = ParameterDescriptor(
        name=about.name,
        type=_type(about).value,
        description=f"{quantity.description} [{quantity.unit}]" if quantity.unit else quantity.description,
        additional_constraints=quantity.expectation(about.kind),
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
