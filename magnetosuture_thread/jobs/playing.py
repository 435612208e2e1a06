"""What of a bag is played into the live graph, and into which nodes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from magnetosuture_thread.bags.message_types import MESSAGES, typestore
from magnetosuture_thread.bags.reader import RecordedMessage
from magnetosuture_thread.interface import (
    CAMERA,
    CAMERA_INFO,
    MEASURED_THREAD,
    NEEDLE_COMMAND,
    NEEDLE_POSE,
    NODES,
    PROCESSES,
    SCENE,
    Channel,
)
from magnetosuture_thread.jobs.replay_inputs import Given
from magnetosuture_thread.jobs.simulate import SLOWER_BRIDGE
from magnetosuture_thread.offline.changes import CHANGING
from magnetosuture_thread.scene import write_scene

if TYPE_CHECKING:
    from magnetosuture_thread.nodes.topics import Topic

# A replayed bag never moves a needle, so its bridge may arm itself.
NOTHING_MOVES = ("-p", "coil_bridge:driver:=recording", "-p", "coil_bridge:autostart:=armed", *SLOWER_BRIDGE)
MIN_LOOP_DURATION = 1.5  # s; nodes take a jump back of a second and less for messages that come late


@dataclass(frozen=True)
class Playing:
    """A bag to play into nodes that run.

    Attributes:
        given: the bag, and what else is needed.
    """

    given: Given

    @property
    def channels(self) -> list[Channel]:
        """Return what is played."""
        camera = self.given.recording.camera
        source = (camera, CAMERA_INFO) if self.given.source == "camera" else (NEEDLE_POSE, MEASURED_THREAD)
        counts = self.given.recording.counts
        there = [
            channel
            for channel in (*source, NEEDLE_COMMAND, *CHANGING)
            if channel is not None and channel != SCENE and counts.get(channel.recorded)
        ]
        return [SCENE, *there]

    @property
    def nodes(self) -> tuple[str, ...]:
        """Return the nodes of the graph."""
        return NODES if self.given.source == "camera" else tuple(name for name in NODES if name != "vision_tracker")

    @property
    def processes(self) -> tuple[str, ...]:
        """Return the programs that these nodes run as."""
        return PROCESSES if self.given.source == "camera" else self.nodes

    @property
    def transport(self) -> str:
        """Return how the bag has its camera frames: raw or compressed; an empty text where they are not played."""
        played = [transport for transport, channel in CAMERA.items() if channel == self.given.recording.camera]
        return played[0] if played and self.given.source == "camera" else ""

    def topics(self) -> list[Topic]:
        """Return what is played, as nodes know it."""
        from magnetosuture_thread.nodes import topics

        known = [*topics.INPUTS, *topics.SETTINGS, *topics.OUTPUTS]
        return [topic for topic in known if topic.channel in self.channels]

    def arguments(self, qos: Path) -> list[str]:
        """Return the nodes' arguments.

        Args:
            qos: a file that this makes: parameters under which no message is lost; `scene.yaml` is made beside it.
        """
        from magnetosuture_thread.nodes import topics
        from magnetosuture_thread.nodes.replay import DEPTH

        qos.write_text(yaml.safe_dump(topics.lossless(DEPTH)), encoding="utf-8")
        files = [part for path in (self.given.setup.path, qos) for part in ("--params-file", str(path.resolve()))]
        # Nodes begin in the scene that is played, also where the set-up's file names one of another machine.
        scene = qos.with_name("scene.yaml")
        write_scene(self.given.setup.scene, scene)
        arguments = [*files, "-p", f"scene:={scene.resolve()}", "-p", "use_sim_time:=true", *NOTHING_MOVES]
        if self.transport:
            arguments += ["-p", f"vision_tracker:image_transport:={self.transport}"]
        return arguments

    def records(self) -> Iterator[RecordedMessage]:
        """Give the messages to play, by time."""
        given = self.given
        # The scene comes first: the one that the bag tells to be in force, or else the set-up's.
        message = MESSAGES.scene_message(given.begin, given.setup.scene)
        data = bytes(typestore().serialize_cdr(message, SCENE.type_name))
        yield RecordedMessage(SCENE.recorded, SCENE.type_name, given.begin, data)
        if given.start > 0.0:  # what was said before of the thread is in force
            told = [channel for channel in CHANGING if channel != SCENE]
            for record in given.recording.records(told, duration=given.start):
                yield replace(record, time=given.begin)
        version = given.setup.scene.version
        for record in given.recording.records(self.channels, start=given.start, duration=given.duration):
            if record.topic == SCENE.recorded:
                before, version = version, str(record.decode().version)
                if version == before:
                    continue
            yield record
