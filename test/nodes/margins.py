"""Margins messages for tests."""

from __future__ import annotations

from typing import Any

from builtin_interfaces.msg import Time
from magnetosuture_msgs.msg import SafetyMargins
from rclpy.serialization import deserialize_message

from magnetosuture_thread.messages.packing import packed_margins


def no_margins(stamp: Time, reason: str) -> Any:
    """Return the message that says that there are none, and why."""
    return deserialize_message(packed_margins(stamp, None, reason), SafetyMargins)
