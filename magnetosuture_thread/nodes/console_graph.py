"""The operator's page's side of a running graph: what is steered, and what is seen."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import CompressedImage, Image

from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.nodes import console_messages, topics
from magnetosuture_thread.nodes.console_inbox import Inbox, Latest
from magnetosuture_thread.nodes.console_switches import ACTIONS, ConsoleSwitches
from magnetosuture_thread.nodes.messages import MESSAGES
from magnetosuture_thread.rig.camera.dish_camera import encode_jpeg
from magnetosuture_thread.scene import read_scene
from magnetosuture_thread.vision.images import unpack_image

SILENT = 3.0  # s, after which a node that says nothing of itself any more is silent
SEEN_PERIOD = 0.1  # s; a path of a hundred poses takes a millisecond to read
REPORTS = 100  # on /diagnostics, that may wait to be looked at
JPEG_QUALITY = 80
READERS = {
    "tracker": (topics.TRACKER_STATE, console_messages.tracker, 0.0),
    "needle": (topics.NEEDLE_POSE, console_messages.needle, 0.0),
    "seen": (topics.SEEN_THREAD, console_messages.seen, SEEN_PERIOD),
    "predicted": (topics.PREDICTED_THREAD, console_messages.predicted, 0.0),
    "margins": (topics.MARGINS, console_messages.margins, 0.0),
    "scene": (topics.SCENE, console_messages.scene, 0.0),
    "filter": (topics.FILTER_STATE, console_messages.filter_state, 0.0),
    "bridge": (topics.BRIDGE_STATE, console_messages.bridge, 0.0),
}
AT_REST = {
    "source": "",
    "commanded": [0.0, 0.0],
    "filtered": [0.0, 0.0],
    "applied": [0.0, 0.0],
    "slowdown": 1.0,
    "active": [],
    "overridden": "",
    "age": 0.0,
}
AGED = ("needle", "predicted", "filter", "bridge")


class ConsoleGraph:
    """A running graph as `console.graph.Graph` wants it.

    Nothing runs between two calls: messages wait in the middleware until somebody looks.

    Args:
        node: in the graph; no executor spins it. With `use_sim_time` its time is that of /clock.
        settings: of the page.

    Attributes:
        node: as given.
        settings: in force.
        held: why nothing may be steered or switched on now; empty if it may.

    Raises:
        ConfigurationError: the settings' scene cannot be read.
    """

    def __init__(self, node: Node, settings: ConsoleSettings) -> None:
        self.node = node
        self.held = ""
        self.switches = ConsoleSwitches(node)
        self._commands = topics.OPERATOR_COMMAND.publisher(node)
        self._clock = Inbox(node, topics.CLOCK, 1) if node.get_parameter("use_sim_time").value else None
        self._number = 0
        self._open(settings, _file_scene(settings))

    def begin(self, settings: ConsoleSettings) -> None:
        """Begin anew: forget all that was heard, for a graph whose nodes were started anew.

        Raises:
            ConfigurationError: the settings' scene cannot be read; nothing has changed.
        """
        scene = _file_scene(settings)
        for latest in self._latest.values():
            latest.close()
        self._camera.close()
        self._reports.close()
        self._open(settings, scene)

    def steer(self, velocity: tuple[float, float]) -> None:
        """Publish the operator's wish now; while the graph is held, nothing."""
        if not self.held:
            self._commands.publish(MESSAGES.twist_message(self.now().to_msg(), np.asarray(velocity, dtype=float)))

    async def act(self, action: str) -> str:
        """Arm, disarm, stop or reset; return an empty text, or the refusal.

        The emergency stop is pressed before anything else is done, whatever holds the graph.
        """
        if action not in ACTIONS:
            return f"action: got {action!r}, expected one of {', '.join(ACTIONS)}"
        if self.held and action != "stop":
            return self.held
        return await self.switches.act(action)

    def state(self) -> dict[str, Any]:
        """Return what is known now; see `console.graph`."""
        for latest in self._latest.values():
            latest.look()
        settings = self.settings
        parts: dict[str, Any] = {
            name: latest.aged() if name in AGED else latest.value or ([] if name == "seen" else None)
            for name, latest in self._latest.items()
        }
        if self.held:
            parts["filter"] = {**AT_REST, "reason": self.held}
        return {
            "time": self.now().nanoseconds * 1e-9,
            "needle_length": settings.needle_length,
            "needle_curvature": settings.needle_curvature,
            **parts,
            "scene": parts["scene"] or self._scene,
            "nodes": self.nodes(),
        }

    def nodes(self) -> dict[str, dict[str, Any]]:
        """Return what each node said of itself last, and how long ago."""
        for report, arrived in self._reports.read():
            for status in report.status:
                self._said[status.name.split(":")[0]] = (console_messages.node_state(status), arrived)
        return dict(self._aged_nodes())

    def says(self, name: str) -> bool:
        """Return whether a node says something of itself now."""
        return any(said == name and about["level"] != "silent" for said, about in self.nodes().items())

    def frame(self) -> tuple[int, bytes] | None:
        """Return number and JPEG or PNG bytes of the newest camera frame; a raw one is encoded only here."""
        if self._camera.look():
            self._number += 1
        return None if self._camera.value is None else (self._number, self._camera.value)

    def now(self) -> Time:
        """Return the graph's time."""
        clock = self.node.get_clock()
        for told, _ in self._clock.read() if self._clock is not None else ():
            clock.set_ros_time_override(Time.from_msg(told.clock, clock_type=clock.clock_type))
        return clock.now()

    def _open(self, settings: ConsoleSettings, scene: dict[str, Any] | None) -> None:
        self.settings, self._scene = settings, scene
        self._latest = {name: Latest(self.node, *reader) for name, reader in READERS.items()}
        self._reports = Inbox(self.node, topics.DIAGNOSTICS, REPORTS)
        self._said: dict[str, tuple[dict[str, Any], int]] = {}
        raw = settings.image_transport == "raw"
        image, read = (topics.IMAGE, _encoded) if raw else (topics.COMPRESSED_IMAGE, _compressed)
        self._camera = Latest(self.node, image, read)

    def _aged_nodes(self) -> Iterator[tuple[str, dict[str, Any]]]:
        for name, (said, arrived) in sorted(self._said.items()):
            age = max(0.0, time.time() - arrived * 1e-9)
            yield name, {**said, "level": "silent" if age > SILENT else said["level"], "age": age}


def _file_scene(settings: ConsoleSettings) -> dict[str, Any] | None:
    """Return the scene to show until one is heard; None where the settings name none."""
    return console_messages.shown_scene(read_scene(settings.scene)) if settings.scene else None


def _compressed(message: CompressedImage) -> bytes:
    return bytes(message.data)


def _encoded(message: Image) -> bytes:
    image = unpack_image(message.data, message.height, message.width, message.step, message.encoding)
    return encode_jpeg(image, JPEG_QUALITY).tobytes()
