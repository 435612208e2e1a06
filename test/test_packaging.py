"""The files that the three builds read say the same."""

from __future__ import annotations

import ast
import importlib.util
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml

import magnetosuture_thread
from magnetosuture_thread.resources import share_directory

ROOT = Path(__file__).parent.parent
PYPROJECT = (ROOT / "pyproject.toml").read_text()
REUSE = (ROOT / "REUSE.toml").read_text()


def package_xml(path: Path) -> ElementTree.Element:
    """Return the root element of a package.xml."""
    return ElementTree.parse(path).getroot()


def test_the_version_is_the_same_everywhere():
    version = re.search(r'^version = "(.+)"$', PYPROJECT, re.MULTILINE)
    assert version is not None
    for path in (ROOT / "package.xml", ROOT / "msg_defs" / "package.xml"):
        assert package_xml(path).findtext("version") == version[1]
    assert magnetosuture_thread.__version__ == version[1]
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == version[1]
    assert re.search(
        rf"^## \[{re.escape(version[1])}\] - \d{{4}}-\d\d-\d\d$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE
    )


def test_maintainer_and_addresses_are_those_of_pyproject_everywhere():
    maintainer = re.search(r'^maintainers = \[\{ name = "(.+?)", email = "(.+?)" \}\]$', PYPROJECT, re.MULTILINE)
    assert maintainer is not None
    name, address = maintainer.groups()
    urls = re.search(r"^\[project\.urls\].*\n((?:\w+ = .+\n)+)", PYPROJECT, re.MULTILINE)
    assert urls is not None
    known = dict(re.findall(r'^(\w+) = "(.+)"$', urls[1], re.MULTILINE))
    for path in (ROOT / "package.xml", ROOT / "msg_defs" / "package.xml"):
        package = package_xml(path)
        assert [(entry.text, entry.get("email")) for entry in package.findall("maintainer")] == [(name, address)], path
        repeated = {entry.get("type"): entry.text for entry in package.findall("url")}
        assert repeated == {"repository": known["repository"], "bugtracker": known["issues"]}, path
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["authors"] == [{"name": name}]
    assert citation["repository-code"] == known["repository"]
    assert re.search(rf'^SPDX-FileCopyrightText = "\d{{4}}(-\d{{4}})? {re.escape(name)}"$', REUSE, re.MULTILINE)


def test_the_licence_is_the_same_everywhere_and_its_text_is_there():
    licence = re.search(r'^license = \{ text = "(.+)" \}$', PYPROJECT, re.MULTILINE)
    assert licence is not None
    for path in (ROOT / "package.xml", ROOT / "msg_defs" / "package.xml"):
        assert package_xml(path).findtext("license") == licence[1]
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["license"] == licence[1]
    annotated = re.findall(r'^SPDX-License-Identifier = "(.+)"$', REUSE, re.MULTILINE)
    assert licence[1] in annotated
    assert {path.name for path in (ROOT / "LICENSES").iterdir()} == {f"{name}.txt" for name in annotated}
    assert (ROOT / "LICENSES" / f"{licence[1]}.txt").read_text() == (ROOT / "LICENSE").read_text()


def test_licences_are_annotated_in_one_place():
    """Every file has its licence by the annotations of REUSE.toml; none names one in a header of its own."""
    assert re.findall(r"^path = (.+)$", REUSE, re.MULTILINE)[0] == '"**"'
    tag = b"SPDX-" + b"License-Identifier:"
    folders = ("magnetosuture_thread", "msg_defs", "launch", "config", "test", "benchmarks", "examples", "docs")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file()]
    assert not [path for path in files if path.suffix != ".pyc" and tag in path.read_bytes()]


def test_workflows_run_what_is_there_for_every_python_that_is_supported():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())
    supported = re.findall(r'^  "Programming Language :: Python :: ([\d.]+)",$', PYPROJECT, re.MULTILINE)
    assert workflow["jobs"]["python"]["strategy"]["matrix"]["python"] == supported
    steps = "\n".join(step.get("run", "") for job in workflow["jobs"].values() for step in job["steps"])
    for path in re.findall(r"\.ci/[\w.]+", steps):
        assert (ROOT / path).is_file()
    (installed,) = re.findall(r"^pip install ('.*)$", steps, re.MULTILINE)
    assert any(installed in page.read_text() for page in (ROOT / "docs").rglob("installation.md"))


def test_kernels_are_handed_to_other_installations_alone():
    """In a workspace where the installed package is the one that is imported there is nothing to copy."""
    spec = importlib.util.spec_from_file_location("kernels", ROOT / ".ci" / "kernels.py")
    assert spec is not None
    assert spec.loader is not None
    kernels = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(kernels)
    kernels.copy_kernels(kernels.PACKAGE)


def test_every_message_is_built():
    listed = set(re.findall(r'"msg/(\w+)\.msg"', (ROOT / "msg_defs" / "CMakeLists.txt").read_text()))
    assert listed == {path.stem for path in (ROOT / "msg_defs" / "msg").glob("*.msg")}
    listed = set(re.findall(r'"srv/(\w+)\.srv"', (ROOT / "msg_defs" / "CMakeLists.txt").read_text()))
    assert listed == {path.stem for path in (ROOT / "msg_defs" / "srv").glob("*.srv")}
    listed = set(re.findall(r'"action/(\w+)\.action"', (ROOT / "msg_defs" / "CMakeLists.txt").read_text()))
    assert listed == {path.stem for path in (ROOT / "msg_defs" / "action").glob("*.action")}


def test_every_message_package_that_the_nodes_import_is_declared():
    declared = {entry.text for entry in package_xml(ROOT / "package.xml").findall("depend")}
    used = set()
    for path in (ROOT / "magnetosuture_thread" / "nodes").rglob("*.py"):
        used |= set(re.findall(r"^from (\w+)\.(?:msg|srv|action) import", path.read_text(), re.MULTILINE))
    interface = (ROOT / "magnetosuture_thread" / "interface.py").read_text()
    used |= set(re.findall(r'"(\w+)/msg/\w+"', interface))
    assert used <= declared


@pytest.mark.parametrize(
    "name", ["scene_server", "vision_tracker", "thread_model", "perception", "coil_bridge", "needle_planner", "console"]
)
def test_every_node_is_an_executable_and_launched(name: str):
    assert f'{name} = "magnetosuture_thread.nodes.program:main"' in PYPROJECT
    if name in ("vision_tracker", "thread_model"):
        return  # launched in one process: `perception`
    launch = ast.parse((ROOT / "launch" / "magnetosuture.launch.py").read_text())
    words = {node.value for node in ast.walk(launch) if isinstance(node, ast.Constant)}
    assert name in words


def listed(name: str) -> set[str]:
    """Return the entries of a list in pyproject.toml."""
    found = re.search(rf"^{name} = \[\n(.*?)^\]", PYPROJECT, re.MULTILINE | re.DOTALL)
    assert found is not None
    return set(re.findall(r'^  "(.+?)",', found[1], re.MULTILINE))


def test_colcon_builds_with_what_pip_builds_with():
    assert {entry for entry in listed("requires") if not entry.startswith("scikit-build-core")} <= listed("colcon")


def test_every_direct_dependency_is_pinned():
    pinned = {line.split("==")[0] for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line}
    asked = {
        entry
        for name in ("requires", "dependencies", "ros", "cluster", "peers", "dev", "docs", "colcon")
        for entry in listed(name)
    }
    names = {re.split(r"[<>=\[]", entry)[0].lower().replace("_", "-") for entry in asked}
    assert names <= pinned, names - pinned


def test_requires_python_is_left_out():
    """It breaks colcon with setuptools 68, which Ubuntu 24.04 has."""
    assert not re.search(r"^requires-python", PYPROJECT, re.MULTILINE)


def test_shared_files_are_found():
    assert (share_directory("magnetosuture_thread") / "config").is_dir()
    assert (share_directory("magnetosuture_msgs") / "msg" / "SafetyMargins.msg").is_file()
