"""The thread's pull on the needle, as the bridge's node receives it."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from magnetosuture_msgs.msg import PredictedThread
from rclpy.subscription import Subscription

from magnetosuture_thread import InvalidInputError
from magnetosuture_thread.coils.bridge import CoilBridge
from magnetosuture_thread.messages import reading
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.node import PackageNode

INPUT_ERRORS = (InvalidInputError, ArithmeticError, ValueError)  # the last two in case a check is missing


class PullSubscription:
    """Hands the predicted force on the needle to a bridge that compensates it; with any other it subscribes to nothing.

    Args:
        node: of the bridge.
        refuse: called with what is wrong with a message.
    """

    def __init__(self, node: PackageNode, refuse: Callable[[Exception], None]) -> None:
        self._node = node
        self._refuse = refuse
        self._subscription: Subscription | None = None
        self._bridge: CoilBridge | None = None

    def follow(self, bridge: CoilBridge | None) -> None:
        """Serve a bridge from now on, or none."""
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
        self._bridge, self._subscription = bridge, None
        if bridge is not None and bridge.feedforward is not None:
            self._subscription = topics.PREDICTED_THREAD.subscribe(self._node, self.on_prediction)

    def on_prediction(self, message: PredictedThread) -> None:
        """Register the thread's pull on the needle, for the next currents."""
        if self._bridge is None or self._bridge.feedforward is None:
            return
        name = topics.PREDICTED_THREAD.name
        try:
            reading.require_dish_frame(message.header.frame_id, name)
            stamp = reading.checked_nanoseconds(message.header.stamp, f"{name}.header.stamp") * 1e-9
            force = np.array([message.needle_force.x, message.needle_force.y])
            if not len(message.tension):  # no force is known
                force[:] = np.nan
            self._bridge.feedforward.update(force, stamp, time.monotonic())
        except INPUT_ERRORS as error:
            self._refuse(error)
