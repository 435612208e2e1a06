"""Finds the files that ship with the packages: setups, scenes, procedures, message definitions."""

from __future__ import annotations

import os
import sysconfig
from pathlib import Path

from magnetosuture_thread.settings.errors import ConfigurationError

_CHECKOUT = Path(__file__).resolve().parents[2]
_IN_CHECKOUT = {"magnetosuture_thread": _CHECKOUT, "magnetosuture_msgs": _CHECKOUT / "msg_defs"}


def share_directory(package: str) -> Path:
    """Return the share directory of a package.

    In a source checkout that is the checkout itself; otherwise `share/` below a prefix that ROS names
    in AMENT_PREFIX_PATH, or below a place that pip installs into.

    Raises:
        FileNotFoundError: the package is not installed.
    """
    candidates = [Path(prefix) for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]
    candidates += [
        Path(sysconfig.get_path("data", scheme))
        for scheme in sysconfig.get_scheme_names()
        if scheme.startswith("posix")
    ]
    folders = [_IN_CHECKOUT[package], *(prefix / "share" / package for prefix in candidates)]
    for folder in folders:
        if (folder / "package.xml").is_file():
            return folder
    raise FileNotFoundError(f"{package} is not installed: no package.xml in any of {[str(f) for f in folders]}")


def find_setup_file(name: str) -> Path:
    """Return the file of a setup, given as a path or as the name of one that ships with the package.

    Raises:
        ConfigurationError: there is no such file.
    """
    return _named_file("setup", name, "config", (".yaml", ".yml"))


def find_scene_file(name: str) -> Path:
    """Return the file of a scene, given as a path or as the name of one that ships with the package.

    Raises:
        ConfigurationError: there is no such file.
    """
    return _named_file("scene", name, "config/scenes", (".yaml", ".yml", ".json", ".geojson"))


def find_procedure_file(name: str) -> Path:
    """Return the file of a procedure, given as a path or as the name of one that ships with the package.

    Raises:
        ConfigurationError: there is no such file.
    """
    return _named_file("procedure", name, "config/procedures", (".yaml", ".yml"))


def shipped_procedures() -> list[str]:
    """Return the names of the procedures that ship with the package."""
    return sorted(path.stem for path in (share_directory("magnetosuture_thread") / "config/procedures").glob("*.yaml"))


def _named_file(what: str, name: str, folder: str, endings: tuple[str, ...]) -> Path:
    shipped = share_directory("magnetosuture_thread") / folder
    path = Path(name) if Path(name).suffix in endings or os.sep in name else shipped / f"{name}.yaml"
    try:
        exists = path.is_file()
    except (OSError, ValueError):  # no name that a file could have
        exists = False
    if not exists:
        known = ", ".join(sorted(p.stem for p in shipped.glob("*.yaml")))
        formats = "YAML or GeoJSON" if ".geojson" in endings else "YAML"
        raise ConfigurationError(what, name, f"a {formats} file, or one of {known}")
    return path
