"""Build of the ament_python package, used by colcon; pip reads pyproject.toml instead.

`colcon build --symlink-install` links this file, not pyproject.toml, into its build folder, so that name, version and
programs are read from there through the link.
"""

from pathlib import Path

from setuptools import find_packages, setup

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib

PROJECT = tomllib.loads((Path(__file__).resolve().parent / "pyproject.toml").read_text())["project"]
PACKAGE = PROJECT["name"]


def files(pattern: str) -> list[str]:
    """Return the files of the source tree that match a pattern, as setuptools wants them."""
    return sorted(str(path) for path in Path().glob(pattern))


setup(
    name=PACKAGE,
    version=PROJECT["version"],
    entry_points={"console_scripts": [f"{name} = {target}" for name, target in PROJECT["scripts"].items()]},
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={
        PACKAGE: ["py.typed", "console/page/*"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", files("config/*.yaml")),
        (f"share/{PACKAGE}/config/scenes", files("config/scenes/*")),
        (f"share/{PACKAGE}/config/procedures", files("config/procedures/*")),
        (f"share/{PACKAGE}/config/ros2_bag", files("config/ros2_bag/*")),
        (f"share/{PACKAGE}/config/security", files("config/security/*")),
        (f"share/{PACKAGE}/config/systemd", files("config/systemd/*")),
        (f"share/{PACKAGE}/config/viewers", files("config/viewers/*")),
        (f"share/{PACKAGE}/launch", files("launch/*.launch.py")),
    ],
    zip_safe=True,
)
