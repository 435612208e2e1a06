"""Imports run one way through the house, and every package outside has one room that knows it."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import magnetosuture_thread
from magnetosuture_thread.interface import NODES, RIG_NODES

HOUSE = Path(magnetosuture_thread.__file__).parent

# What each room may import of the house, itself aside.
BASE = {"errors", "configuration", "resources", "shared_parameters", "parameter_files", "scene"}
ALLOWED = {
    "errors": set(),
    "configuration": {"errors"},
    "resources": {"errors"},
    "shared_parameters": {"configuration"},
    "parameter_files": {"errors", "configuration", "shared_parameters"},
    "interface": set(),
    "compiled": set(),
    "barrier": {"errors", "geometry"},
    "geometry": {"errors", "compiled"},
    "scene": {*BASE, "geometry", "interface", "shared_parameters"},
    "model": {*BASE, "barrier", "compiled", "geometry", "scene", "shared_parameters"},
    "vision": {*BASE, "compiled", "geometry", "scene", "shared_parameters"},
    "safety": {*BASE, "barrier", "compiled", "geometry", "scene"},
    "coils": {*BASE, "barrier", "geometry", "safety", "scene", "shared_parameters"},
    "guidance": {*BASE, "geometry", "scene", "shared_parameters"},
    "console": {*BASE, "geometry", "scene", "shared_parameters"},
    "rig": {*BASE, "compiled", "geometry", "scene", "shared_parameters"},
    "bags": {*BASE, "interface", "messages"},
    "messages": {"errors", "interface", "geometry", "scene", "model", "vision", "coils"},
    "evaluation": {"barrier", "messages", "errors", "geometry", "interface", "model", "scene"},
    "calibration": {"barrier", "errors", "geometry", "scene", "model", "evaluation"},
    "nodes": {
        *BASE,
        *("interface", "messages", "geometry", "scene", "model", "vision", "coils", "guidance", "rig", "console"),
        "parameter_files",
    },
    "offline": {*BASE, "interface", "messages", "geometry", "scene", "model", "vision", "bags", "evaluation", "setups"},
    "setups": {
        *BASE,
        *("scene", "model", "vision", "coils", "guidance", "rig", "console", "parameter_files", "shared_parameters"),
    },
    "jobs": {
        *BASE,
        *(
            "interface",
            "geometry",
            "scene",
            "model",
            "vision",
            "coils",
            "guidance",
            "rig",
            "console",
            "scene",
            "bags",
            "evaluation",
            "calibration",
            "nodes",
            "setups",
            "offline",
            "messages",
        ),
    },
    "reproduce": {
        *BASE,
        *("interface", "geometry", "model", "vision", "safety", "bags", "evaluation", "setups", "jobs", "messages"),
    },
    "cli": {
        *("errors", "geometry", "scene", "setups", "bags", "coils", "vision", "nodes", "jobs", "reproduce"),
        *("evaluation", "calibration"),
    },
}

# Packages that only some rooms may know.
OWNERS = {
    "aiohttp": {"console"},
    "basicmicro": {"coils"},
    "serial": {"coils"},
    "cv2": {"vision", "rig"},
    "mcap": {"bags"},
    "rosbags": {"bags"},
    "zstandard": {"bags"},
    "numba": {"compiled"},
    "playwright": set(),
    "osqp": {"model"},
    "shapely": {"geometry", "scene"},
    "jinja2": {"evaluation"},
    "matplotlib": {"evaluation", "calibration", "reproduce"},
    "plotly": {"evaluation"},
    "rich": {"cli", "evaluation", "calibration", "reproduce"},
    "rclpy": {"nodes"},
    "rcl_interfaces": {"nodes"},
    "builtin_interfaces": {"nodes"},
    "diagnostic_msgs": {"nodes"},
    "geometry_msgs": {"nodes"},
    "lifecycle_msgs": {"nodes"},
    "magnetosuture_msgs": {"nodes"},
    "nav_msgs": {"nodes"},
    "rosgraph_msgs": {"nodes"},
    "sensor_msgs": {"nodes"},
    "std_msgs": {"nodes"},
    "std_srvs": {"nodes"},
    "visualization_msgs": {"nodes"},
}

MODULES = sorted(HOUSE.rglob("*.py"))


def imported(path: Path) -> set[str]:
    """Return the full names of all modules that a file imports, wherever in the file."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            assert node.module is not None
            names.add(node.module)
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return names


def room(path: Path) -> str:
    """Return the room that a file is in: its folder, or its own name at the top."""
    return path.relative_to(HOUSE).parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(HOUSE)))
def test_imports_run_one_way(path: Path):
    here = room(path)
    if here == "__init__":  # the public API, whose names are imported when they are first used
        at_import = [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.Import | ast.ImportFrom)]
        assert {getattr(node, "module", None) for node in at_import} == {"importlib", "typing"}
        return
    rooms = {name.split(".")[1] for name in imported(path) if name.startswith("magnetosuture_thread.")} - {here}
    assert rooms <= ALLOWED[here], f"{here} may not import {rooms - ALLOWED[here]}"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(HOUSE)))
def test_packages_outside_are_known_in_their_rooms_only(path: Path):
    here = room(path)
    strangers = {
        package
        for package in (name.split(".")[0] for name in imported(path))
        if here not in OWNERS.get(package, {here})
    }
    assert not strangers, f"{here} may not know {strangers}"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(HOUSE)))
def test_what_is_installed_needs_nothing_of_the_source_tree(path: Path):
    assert not {name.split(".")[0] for name in imported(path)} & {"benchmarks", "examples", "test"}


def test_no_room_is_missing_from_the_rules():
    assert {room(path) for path in MODULES} - {"__init__"} == set(ALLOWED)


def test_modules_stay_small():
    """A file is one concept, and its functions are bounded in complexity by the linter; this only keeps heaps away."""
    sizes = {str(path.relative_to(HOUSE)): len(path.read_text().splitlines()) for path in MODULES}
    assert not {name: size for name, size in sizes.items() if size > 400}
    nodes = {
        name: size for name, size in sizes.items() if name in {f"nodes/{n}.py" for n in (*NODES, *RIG_NODES, "console")}
    }
    assert len(nodes) == 6
    assert not {name: size for name, size in nodes.items() if size > 200}
