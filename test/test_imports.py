"""Imports run one way through the package, and every third-party package is known to one subpackage."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import magnetosuture_thread
from magnetosuture_thread.interface import NODES, RIG_NODES

PACKAGE = Path(magnetosuture_thread.__file__).parent

# What each subpackage or top-level module may import of the package, itself aside.
BASE = {"errors", "configuration", "resources", "shared_parameters", "parameter_files", "scene"}
ALLOWED = {
    "errors": set(),
    "configuration": {"errors"},
    "resources": {"errors"},
    "shared_parameters": {"configuration"},
    "parameter_files": {"errors", "configuration", "shared_parameters"},
    "interface": set(),
    "compiled": set(),
    "geometry": {"errors", "compiled"},
    "scene": {*BASE, "geometry", "interface", "shared_parameters"},
    "model": {*BASE, "compiled", "geometry", "scene", "shared_parameters"},
    "vision": {*BASE, "compiled", "geometry", "scene", "shared_parameters"},
    "safety": {*BASE, "compiled", "geometry", "scene"},
    "coils": {*BASE, "geometry", "safety", "scene", "shared_parameters"},
    "guidance": {*BASE, "geometry", "scene", "shared_parameters"},
    "console": {*BASE, "geometry", "scene", "shared_parameters"},
    "rig": {*BASE, "compiled", "geometry", "scene", "shared_parameters"},
    "bags": {*BASE, "interface"},
    "packing": {"interface", "geometry", "model"},
    "study": {"errors", "compiled", "geometry", "interface", "model", "safety", "scene"},
    "nodes": {
        *BASE,
        *("interface", "packing", "geometry", "scene", "model", "vision", "coils", "guidance", "rig", "console"),
        "parameter_files",
    },
    "offline": {*BASE, "interface", "packing", "geometry", "scene", "model", "vision", "bags", "study", "setups"},
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
            "study",
            "nodes",
            "setups",
            "offline",
            "packing",
        ),
    },
    "cli": {"errors", "scene", "setups", "jobs", "study"},
}

# Third-party packages that only some subpackages may import.
OWNERS = {
    "aiohttp": {"console"},
    "basicmicro": {"coils"},
    "serial": {"coils"},
    "cv2": {"vision", "rig"},
    "mcap": {"bags"},
    "rosbags": {"bags"},
    "zstandard": {"bags"},
    "numba": {"compiled"},
    "playwright": {"jobs"},
    "osqp": {"model"},
    "shapely": {"geometry", "scene"},
    "jinja2": {"study"},
    "matplotlib": {"study"},
    "plotly": {"study"},
    "rich": {"cli", "study"},
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

MODULES = sorted(PACKAGE.rglob("*.py"))


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


def part(path: Path) -> str:
    """Return the part that a file belongs to: its subpackage, or its own name at the top level."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_run_one_way(path: Path):
    here = part(path)
    if here == "__init__":
        assert imported(path) == set()
        return
    parts = {name.split(".")[1] for name in imported(path) if name.startswith("magnetosuture_thread.")} - {here}
    assert parts <= ALLOWED[here], f"{here} may not import {parts - ALLOWED[here]}"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_third_party_packages_are_imported_by_their_owners_only(path: Path):
    here = part(path)
    foreign = {
        package
        for package in (name.split(".")[0] for name in imported(path))
        if here not in OWNERS.get(package, {here})
    }
    assert not foreign, f"{here} may not import {foreign}"


def test_no_subpackage_is_missing_from_the_rules():
    assert {part(path) for path in MODULES} - {"__init__"} == set(ALLOWED)


def test_modules_stay_small():
    """A file is one concept, with functions bounded in complexity by the linter; this bounds the size of a file."""
    sizes = {str(path.relative_to(PACKAGE)): len(path.read_text().splitlines()) for path in MODULES}
    assert not {name: size for name, size in sizes.items() if size > 400}
    nodes = {
        name: size for name, size in sizes.items() if name in {f"nodes/{n}.py" for n in (*NODES, *RIG_NODES, "console")}
    }
    assert len(nodes) == 6
    assert not {name: size for name, size in nodes.items() if size > 200}
