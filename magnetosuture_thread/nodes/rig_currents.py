"""Where the simulated rig's currents come from: messages, or simulated boards that a driver writes to."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from magnetosuture_msgs.msg import CoilCurrents
from numpy.typing import NDArray
from rclpy.clock import Clock
from rclpy.node import Node

from magnetosuture_thread.nodes import topics
from magnetosuture_thread.rig.settings import RigSettings

PERIOD = 0.005  # s between two looks at the boards, which keep real time whatever the pace


class RigCurrents:
    """Hands on what the settings name.

    Args:
        node: that has the rig.
        settings: of the rig.
        clock: that the boards are looked at by.
        apply: takes the coils' currents from now on, shape (m,) [A].

    Attributes:
        stage: the simulated boards, None where currents come as messages.

    Raises:
        ConfigurationError: a path for the boards cannot be used.
    """

    def __init__(
        self, node: Node, settings: RigSettings, clock: Clock, apply: Callable[[NDArray[np.float64]], None]
    ) -> None:
        self._apply = apply
        self.stage = stage = settings.power()
        if stage is None:
            topics.RIG_CURRENTS.subscribe(node, self.on_currents)
        else:
            stage.open()
            node.create_timer(PERIOD, lambda: apply(stage.currents()), clock=clock)

    def on_currents(self, message: CoilCurrents) -> None:
        """Take currents that came as a message."""
        self._apply(np.asarray(message.current, dtype=float))

    def close(self) -> None:
        """Take the boards' lines away."""
        if self.stage is not None:
            self.stage.close()
