"""Imports run one way through the package, and every third-party package is known to one subpackage."""

from __future__ import annotations

import ast
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import pytest

import magnetosuture_thread
from magnetosuture_thread.nodes.program import MAKERS
from test.shared import run_python

PACKAGE = Path(magnetosuture_thread.__file__).parent

# Imports run one way: a module imports from its own layer and the layers before it, not from those after it.
LAYERS = (
    {"settings"},
    {"geometry"},
    {"thread", "console"},
    {"estimator", "vision", "coils"},
    {"forecast"},
    {"planning", "bags"},
    {"rig"},
    {"evaluation"},
    {"calibration"},
    {"nodes"},
    {"commands"},
    {"cli"},
)

# Third-party packages that only some subpackages may import.
OF_ROS = "rclpy rcl_interfaces builtin_interfaces diagnostic_msgs geometry_msgs lifecycle_msgs magnetosuture_msgs"
OWNED = (
    ("aiohttp", {"console"}),
    ("basicmicro serial", {"coils"}),
    ("cv2", {"vision", "rig"}),
    ("mcap rosbags zstandard", {"bags"}),
    ("numba", {"geometry"}),
    ("playwright", set[str]()),
    ("osqp", {"thread"}),
    ("dask distributed pyarrow", {"evaluation"}),
    ("upath", {"settings"}),
    ("shapely", {"geometry", "planning", "rig"}),
    ("simplejpeg", {"vision"}),
    ("matplotlib", {"evaluation", "calibration", "commands"}),
    ("rich", {"commands", "evaluation", "calibration"}),
    (f"{OF_ROS} nav_msgs rosgraph_msgs sensor_msgs std_msgs std_srvs visualization_msgs", {"nodes"}),
)
OWNERS = {package: owners for packages, owners in OWNED for package in packages.split()}

MODULES = sorted(PACKAGE.rglob("*.py"))


PUBLIC = {name: f"magnetosuture_thread.{module}" for name, module in magnetosuture_thread._MODULES.items()}


@cache
def imported(path: Path) -> frozenset[str]:
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
    public = {f"magnetosuture_thread.{name}": module for name, module in PUBLIC.items()}
    return frozenset(public.get(name, name) for name in names)


def part(path: Path) -> str:
    """Return the part that a file belongs to: its subpackage, or its own name at the top level."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def assert_none(found: dict[Path, set[str]], what: str) -> None:
    """Check that nothing is found in any module, else name each module with what is."""
    lines = [f"{path.relative_to(PACKAGE)} {what} {names}" for path, names in found.items() if names]
    assert not lines


def layer(name: str) -> int:
    """Return the layer of a part."""
    return next((number for number, parts in enumerate(LAYERS) if name in parts), -1)


def test_imports_run_one_way():
    for node in ast.parse((PACKAGE / "__init__.py").read_text()).body:  # whose names are imported when first used
        if isinstance(node, ast.Import | ast.ImportFrom):
            assert getattr(node, "module", None) in {"importlib", "typing"}
    found = {}
    for path in MODULES:
        here = part(path)
        if here != "__init__":
            ours = {name.split(".")[1] for name in imported(path) if name.startswith("magnetosuture_thread.")}
            found[path] = {name for name in ours if layer(name) > layer(here)}
    assert_none(found, "may not import")


def test_nodes_and_commands_use_the_public_api():
    found = {}
    for path in MODULES:
        if part(path) in {"nodes", "commands", "cli"}:
            imports = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
            inside = [node for node in imports if str(node.module).startswith("magnetosuture_thread.")]
            found[path] = {alias.name for node in inside for alias in node.names if alias.name in PUBLIC}
    assert_none(found, "imports from inside")


def test_third_party_packages_are_imported_by_their_owners_only():
    packages = {path: {name.split(".")[0] for name in imported(path)} for path in MODULES}
    foreign = {
        path: {name for name in names if part(path) not in OWNERS.get(name, {part(path)})}
        for path, names in packages.items()
    }
    assert_none(foreign, "may not import")


def test_what_is_installed_needs_nothing_of_the_source_tree():
    outside = {"benchmarks", "examples", "test"}
    assert_none({path: {name.split(".")[0] for name in imported(path)} & outside for path in MODULES}, "may not import")


LATE = {"matplotlib", "scipy.interpolate", "scipy.optimize", "scipy.spatial", "scipy.stats"}


def loaded_by(modules: Iterable[str]) -> set[str]:
    """Return the names of all modules that a process has after it has imported some of the package."""
    code = "import sys, " + ", ".join(f"magnetosuture_thread.{name}" for name in modules) + "; print(*sys.modules)"
    return set(run_python("-c", code).split())


@pytest.mark.parametrize(("modules", "allowed"), [(sorted(MAKERS), set[str]()), (["console"], {"aiohttp"})])
def test_a_node_needs_no_library_for_plots_bags_or_pages(modules: list[str], allowed: set[str]):
    """Only the node that serves the page has that of its server."""
    unneeded = {"matplotlib", "rich", "rosbags", "mcap", "lz4", "zstandard", "pyarrow", "aiohttp"}
    assert unneeded & loaded_by(f"nodes.{name}" for name in modules) == allowed


def test_what_few_need_delays_no_start():
    """Each of these takes a third of a second or more to import, and a graph is many processes."""
    modules = ["nodes.scene_server", "nodes.rig_simulator", "nodes.perception", "nodes.coil_bridge"]
    modules += ["nodes.path_follower", "nodes.console", "commands.simulate", "commands.replay", "commands.campaign"]
    assert not LATE & loaded_by(modules)
