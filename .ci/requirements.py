"""Prints what this project needs, one requirement a line: to run, and of some extras."""

from __future__ import annotations

import sys
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    from pip._vendor import tomli as tomllib

PYPROJECT = Path(__file__).parent.parent / "pyproject.toml"


def requirements(extras: list[str]) -> list[str]:
    """Return the requirements of the project, and of extras."""
    mapping = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))
    project = mapping["project"]
    optional = [name for extra in extras for name in project["optional-dependencies"][extra]]
    return sorted({*project["dependencies"], *optional})


if __name__ == "__main__":
    print("\n".join(requirements(sys.argv[1:])))
