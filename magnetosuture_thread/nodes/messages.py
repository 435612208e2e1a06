"""Messages of rclpy, built as everywhere, and what is read of their bytes."""

from __future__ import annotations

from array import array
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from geometry_msgs.msg import TwistStamped
from rclpy.serialization import deserialize_message

from magnetosuture_thread.messages.building import MessageBuilder
from magnetosuture_thread.messages.reading import nanoseconds
from magnetosuture_thread.nodes import topics


@cache
def _type(type_name: str) -> Any:
    package, _, name = type_name.split("/")
    return getattr(import_module(f"{package}.msg"), name)


def _make(type_name: str, **fields: Any) -> Any:
    return _type(type_name)(**fields)


def _numbers(kind: str, values: Any) -> array[Any]:
    # Of any other type, rclpy would check each number for itself.
    return array(kind, np.asarray(values, dtype=kind).tobytes())


MESSAGES = MessageBuilder(_make, _numbers)
"""Builds messages of rclpy."""


def serialised_velocity(data: bytes) -> np.ndarray:
    """Return the velocity of a serialised stamped twist, shape (2,) [m/s]."""
    linear = deserialize_message(data, TwistStamped).twist.linear
    return np.array([linear.x, linear.y])


def command_stamp(data: bytes) -> int | None:
    """Return the stamp of the command that serialised currents follow [ns]; None if they follow none."""
    return nanoseconds(topics.CURRENTS.decode(data).command) or None
