"""Setups: the settings of all nodes, from one YAML file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import get_type_hints

from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.geometry.scene_files import SceneServerSettings, read_scene
from magnetosuture_thread.planning.follower import PathFollowerSettings
from magnetosuture_thread.planning.procedure import Procedure
from magnetosuture_thread.planning.session import NeedlePlannerSettings
from magnetosuture_thread.rig.settings import RigSettings
from magnetosuture_thread.settings.configuration import Configuration, errors_of_file
from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.settings.files import find_file
from magnetosuture_thread.settings.shared_parameters import EVERY_NODE, SHARED_PARAMETERS, load_setup
from magnetosuture_thread.vision.settings import VisionTrackerSettings


@dataclass(frozen=True)
class Setup:
    """The settings of all nodes, and their scene.

    Attributes:
        name: the file's name without its ending.
        path: the file.
        vision: settings of the vision tracker.
        model: settings of the thread model.
        coils: settings of the coil bridge.
        rig: settings of the simulated rig.
        follower: settings of the path follower.
        planner: settings of the needle planner.
        console: settings of the operator's page.
    """

    name: str
    path: Path
    vision: VisionTrackerSettings
    model: ThreadModelSettings
    coils: CoilBridgeSettings
    rig: RigSettings
    follower: PathFollowerSettings
    planner: NeedlePlannerSettings
    console: ConsoleSettings

    def with_scene(self, scene: Scene) -> Setup:
        """Return the setup with another scene, as that of a bag."""
        other = replace(self)
        other.__dict__["scene"] = scene  # where the cached property looks first
        return other

    @cached_property
    def scene(self) -> Scene:
        """The scene that all nodes start from.

        Raises:
            ConfigurationError: the setup names none, or its file cannot be used.
        """
        if not self.model.scene:
            raise ConfigurationError("scene", "none", f"a scene file under {EVERY_NODE}", str(self.path))
        with errors_of_file(str(self.path)):
            return read_scene(self.model.scene)


SETTINGS_CLASSES: tuple[type[Configuration], ...] = tuple(
    kind for kind in get_type_hints(Setup).values() if issubclass(kind, Configuration)
)


def _check_agreement(settings: Mapping[str, Configuration]) -> None:
    """Refuse two values of one shared parameter, as of `/**` and of a node's section; the rig's are the truth."""
    for name in SHARED_PARAMETERS:
        values = {group: getattr(node, name) for group, node in settings.items() if hasattr(node, name)}
        values.pop(RigSettings.GROUP, None)
        owner, *others = values
        for group in others:
            if values[group] != values[owner]:
                words = f"{values[owner]!r}, as {owner}.{name}; what nodes share is written once, under {EVERY_NODE}"
                raise ConfigurationError(f"{group}.{name}", values[group], words)


def _check_pull(coils: CoilBridgeSettings, speed: float) -> None:
    """Refuse a bound of the thread's pull that its own drag exceeds at the speed of the path [m/s]."""
    drag = coils.thread_drag * speed
    if coils.motion_compensation and coils.max_pull < drag:
        rule = f"the drag of the straight thread at path_follower.speed, {speed:g} m/s"
        raise ConfigurationError(f"{coils.GROUP}.max_pull", coils.max_pull, f"at least {drag:.2g} N, {rule}")


def read_setup(name: str, scene: Scene | None = None) -> Setup:
    """Read a setup, given as a path or as the name of one that ships with the package.

    Args:
        name: of the setup, or the path of its file.
        scene: in place of the one that the file names.

    Raises:
        ConfigurationError: there is no such file, or it holds anything invalid.
    """
    path = find_file("setup", name)
    settings = load_setup(path, (*SETTINGS_CLASSES, SceneServerSettings))
    with errors_of_file(str(path)):
        _check_agreement(settings)
        setup = Setup(path.stem, path, *(settings[cls.GROUP] for cls in SETTINGS_CLASSES))
        _check_pull(setup.coils, setup.follower.speed)
        if scene is not None:  # as of a bag, of which no path is followed
            return setup.with_scene(scene)
        if setup.model.scene:
            setup.follower.check_path(setup.scene)
    return setup


def read_vision_setup(name: str, scene: Scene | None = None) -> tuple[VisionTrackerSettings, Scene]:
    """Read what the vision tracker needs of a setup, whatever the file says of other nodes.

    Args:
        name: of the setup, or the path of its file.
        scene: in place of the one that the file names.

    Raises:
        ConfigurationError: there is no such file, it holds anything invalid for the tracker, or no scene is named.
    """
    path = find_file("setup", name)
    settings = load_setup(path, (*SETTINGS_CLASSES, SceneServerSettings), {VisionTrackerSettings.GROUP})
    vision: VisionTrackerSettings = settings[VisionTrackerSettings.GROUP]
    if scene is None and not vision.scene:
        expected = f"a scene file under {EVERY_NODE}, or --scene or --dish-diameter"
        raise ConfigurationError("scene", "none", expected, str(path))
    with errors_of_file(str(path)):
        return vision, scene or read_scene(vision.scene)


def read_procedure_setup(procedure: Procedure, name: str = "") -> Setup:
    """Read the setup of a procedure, with the procedure's scene if it names one.

    Args:
        procedure: to execute.
        name: of another setup than the procedure's, or the path of its file.

    Raises:
        ConfigurationError: neither names a setup, a goal is to be pursued faster than the bridge allows, or the dish
            reaches beyond the coils; or see `read_setup` and `read_scene`.
    """
    if not (name or procedure.setup):
        raise ConfigurationError("setup", "nothing", f"a setup, as the procedure {procedure.name} names none")
    setup = read_setup(name or procedure.setup)
    for index, limits in enumerate(procedure.limits):
        if limits.speed > setup.coils.max_speed:
            expected = f"at most coil_bridge.max_speed of {setup.name}, {setup.coils.max_speed:g} m/s"
            raise ConfigurationError(f"goals[{index}].limits.speed", limits.speed, expected)
    if not procedure.scene:
        return setup
    scene, reach = read_scene(procedure.scene), setup.coils.reach
    if scene.dish.radius > reach:
        expected = f"at most {2e3 * reach:.3g} mm, which the coils of {setup.name} leave"
        raise ConfigurationError("scene.dish.diameter", f"{1e3 * scene.dish.diameter:.3g} mm", expected)
    return setup.with_scene(scene)
