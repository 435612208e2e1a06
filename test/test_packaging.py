"""The files that the three builds read say the same."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml
from catkin_pkg.packages import find_packages

import magnetosuture_thread
from magnetosuture_thread.settings.errors import missing_module
from test.shared import ROOT, known
from test.test_imports import MODULES, imported

PYPROJECT = (ROOT / "pyproject.toml").read_text()
INSTALLATION = (ROOT / "docs" / "how_to" / "installation.md").read_text()


def package_xml(path: Path) -> ElementTree.Element:
    """Return the root element of a package.xml."""
    return ElementTree.parse(path).getroot()


def test_the_version_is_the_same_everywhere():
    version = known(re.search(r'^version = "(.+)"$', PYPROJECT, re.MULTILINE))
    for path in (ROOT / "package.xml", ROOT / "msg_defs" / "package.xml"):
        assert package_xml(path).findtext("version") == version[1]
    assert magnetosuture_thread.__version__ == version[1]
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == version[1]
    heading = rf"^## \[{re.escape(version[1])}\] - \d{{4}}-\d\d-\d\d$"
    assert re.search(heading, (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)


LINK = "ln -sfn magnetosuture_thread/msg_defs src/magnetosuture_msgs"


def test_the_documented_link_makes_the_messages_a_sibling_of_the_package(tmp_path: Path):
    """By the same search rosdep and colcon find packages: not inside of another, but through links."""
    places = ("README.md", "docs/how_to/installation.md", ".github/workflows/ci.yml")
    assert all(re.search(rf"^ *{re.escape(LINK)}\b", (ROOT / name).read_text(), re.MULTILINE) for name in places)
    (tmp_path / "src" / "other").mkdir(parents=True)
    other = (ROOT / "msg_defs" / "package.xml").read_text().replace("<name>magnetosuture_msgs<", "<name>other<")
    (tmp_path / "src" / "other" / "package.xml").write_text(other)
    (tmp_path / "src" / "magnetosuture_thread").symlink_to(ROOT)
    found = {each.name for each in find_packages(str(tmp_path / "src")).values()}
    assert found == {"magnetosuture_thread", "other"}
    subprocess.run(shlex.split(LINK), cwd=tmp_path, check=True)
    found = {each.name for each in find_packages(str(tmp_path / "src")).values()}
    assert found == {"magnetosuture_thread", "magnetosuture_msgs", "other"}


def test_every_folder_of_config_is_installed():
    folders = {str(path.parent.relative_to(ROOT)) for path in (ROOT / "config").rglob("*") if path.is_file()}
    setup = (ROOT / "setup.py").read_text()
    assert folders == set(re.findall(r'files\("(config[\w/]*)/\*[.\w]*"\)', setup))


def test_every_message_is_built():
    built = (ROOT / "msg_defs" / "CMakeLists.txt").read_text()
    for kind in ("msg", "srv", "action"):
        listed = set(re.findall(rf'"{kind}/(\w+)\.{kind}"', built))
        assert listed == {path.stem for path in (ROOT / "msg_defs" / kind).glob(f"*.{kind}")}


def test_every_import_has_a_key_of_rosdep_or_is_in_the_list_for_pip():
    keys = {entry.text for tag in ("depend", "exec_depend") for entry in package_xml(ROOT / "package.xml").iter(tag)}
    line = known(re.search(r"^ +pip install --break-system-packages (.+)$", INSTALLATION, re.MULTILINE))
    by_pip = {re.split("[^a-z0-9]", word)[0] for word in shlex.split(line[1])}
    own = {"magnetosuture_thread", "typing_extensions"}  # the latter for mypy only
    cluster = {"dask", "distributed", "pyarrow", "upath"}
    names = {"cv2": "opencv", "PIL": "pil", "rosbags": "rosbags-pip", "simplejpeg": "simplejpeg-pip"}
    used = {name.split(".")[0] for path in MODULES for name in imported(path)} | {"lz4"}  # by import_module
    used -= {*sys.stdlib_module_names, *own, *cluster}
    missing = {name for name in used if not {name, f"python3-{names.get(name, name)}"} & keys}
    assert missing == by_pip


@pytest.mark.parametrize(
    ("module", "words"),
    [
        ("cv2", "pip install 'opencv-python-headless>=4.6'"),
        ("rclpy", "source the setup.bash of ROS"),
        ("type_description_interfaces", "source the setup.bash of ROS"),
        ("upath", r"pip install '\.\[cluster\]'"),
    ],
)
def test_a_missing_package_is_named_with_the_line_that_installs_it(module: str, words: str):
    text = missing_module(ModuleNotFoundError(f"No module named {module!r}", name=module))
    assert text.startswith(f"No module named {module!r}; ")
    assert re.search(words, text)
    assert ("'.[ros]'" in text) == ("setup.bash" in text)


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["", "--symlink-install", "--merge-install"])
def test_colcon_installs_programs_version_launch_file_and_settings(tmp_path: Path, layout: str):
    """The messages are those of this environment; `.ci/run` builds them too, and starts every node."""
    (tmp_path / "src").mkdir()
    (tmp_path / "src" / "magnetosuture_thread").symlink_to(ROOT)
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "HOME": str(tmp_path)}
    subprocess.run(["colcon", "build", *layout.split()], cwd=tmp_path, env=environment, check=True, timeout=600)
    prefix = tmp_path / "install" / ("" if layout == "--merge-install" else "magnetosuture_thread")
    programs, share = prefix / "lib" / "magnetosuture_thread", prefix / "share" / "magnetosuture_thread"
    listed = known(re.search(r"^\[project\.scripts\]\n((?:.+\n)+)", PYPROJECT, re.MULTILINE))
    assert {path.name for path in programs.iterdir()} == set(re.findall(r"^(\w+) =", listed[1], re.MULTILINE))
    assert (share / "launch" / "magnetosuture.launch.py").is_file()
    assert (share / "config" / "hernia_ring.yaml").is_file()

    shell = f". {tmp_path}/install/setup.sh && exec {programs}/magnetosuture --version"
    done = subprocess.run(["sh", "-c", shell], cwd="/", env=environment, check=True, timeout=300, capture_output=True)
    assert done.stdout.decode().split()[-1] == magnetosuture_thread.__version__
    start = [sys.executable, str(ROOT / ".ci" / "installed_nodes.py"), str(tmp_path / "install"), "scene_server"]
    subprocess.run(start, env=environment, check=True, timeout=600)
