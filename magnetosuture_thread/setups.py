"""Set-ups: the settings of all nodes, from one YAML file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.configuration import load_setup
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.model.settings import ThreadModelSettings
from magnetosuture_thread.resources import setup_file
from magnetosuture_thread.vision.settings import VisionTrackerSettings


@dataclass(frozen=True)
class Setup:
    """One set-up.

    Attributes:
        name: the file's name without its ending.
        path: the file.
        vision: settings of the vision tracker.
        model: settings of the thread model.
        coils: settings of the coil bridge.
    """

    name: str
    path: Path
    vision: VisionTrackerSettings
    model: ThreadModelSettings
    coils: CoilBridgeSettings


def read_setup(name: str) -> Setup:
    """Read a set-up, given as a path or as the name of one that ships with the package.

    Raises:
        ConfigurationError: there is no such file, or it holds anything invalid.
    """
    path = setup_file(name)
    settings = load_setup(path, (VisionTrackerSettings, ThreadModelSettings, CoilBridgeSettings))
    seen, predicted = settings["vision_tracker"].thread_length, settings["thread_model"].length
    if seen != predicted:
        name = "vision_tracker.thread_length"
        raise ConfigurationError(name, seen, f"{predicted} m, as thread_model.length", str(path))
    return Setup(path.stem, path, settings["vision_tracker"], settings["thread_model"], settings["coil_bridge"])
