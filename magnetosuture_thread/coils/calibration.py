"""Coil calibration: the measured properties of a rig's coils, as a YAML file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from magnetosuture_thread.coils.field import CoilProperties
from magnetosuture_thread.configuration import from_mapping, read_yaml, to_mapping
from magnetosuture_thread.errors import ConfigurationError

MODEL = "loops"  # of the field of a coil
MIN_COILS = 3  # needed to pull in every direction
TEXT_KEYS = ("name", "date", "notes")
REQUIRED_KEYS = ("name", "angle", "distance", "radius", "field_per_current")

FILE_HEADER = """\
# Calibration of a rig's coils, for the parameter `calibration` of coil_bridge. SI units: rad, m, T/A, ohm, T.
"""


@dataclass(frozen=True)
class CoilCalibration:
    """Measured properties of a rig's coils.

    Attributes:
        name: of the rig.
        date: of the measurement, as text.
        notes: anything else.
        coils: in the order of their currents.
    """

    name: str
    date: str
    notes: str
    coils: tuple[CoilProperties, ...]

    def to_yaml(self) -> str:
        """Return the calibration as YAML text."""
        head = {**{key: getattr(self, key) for key in TEXT_KEYS}, "model": MODEL}
        coils = [_rounded(to_mapping(coil)) for coil in self.coils]
        return FILE_HEADER + yaml.dump({**head, "coils": coils}, Dumper=_Dumper, sort_keys=False, allow_unicode=True)


def read_calibration(path: Path) -> CoilCalibration:
    """Read a calibration from a YAML file.

    Raises:
        ConfigurationError: the file is unreadable or no YAML, a key is missing or unknown, or a value has the wrong
            type or is out of bounds; with file, key, value and expectation.
    """
    content, source = read_yaml(path, "coil calibration"), str(path)
    keys = (*TEXT_KEYS, "model", "coils")
    if not isinstance(content, Mapping):
        raise ConfigurationError("coil calibration", content, f"keys {', '.join(keys)}", source)
    unknown = next((key for key in content if key not in keys), None)
    if unknown is not None:
        raise ConfigurationError(str(unknown), content[unknown], f"one of {', '.join(keys)}", source)
    _require_keys(content, ("coils",), "", source)
    texts = {key: content.get(key, "") for key in TEXT_KEYS}
    for key, text in texts.items():
        if not isinstance(text, str):
            raise ConfigurationError(key, text, "text", source)
    if content.get("model", MODEL) != MODEL:
        raise ConfigurationError(
            "model", content["model"], f"{MODEL}, the only model; calibrate the coils again", source
        )
    listed = content["coils"]
    if not isinstance(listed, list) or len(listed) < MIN_COILS:
        given = f"{len(listed)} coils" if isinstance(listed, list) else listed
        raise ConfigurationError("coils", given, f"a list of at least {MIN_COILS} coils", source)
    coils = tuple(_coil(values, f"coils[{index}]", source) for index, values in enumerate(listed))
    names = [coil.name for coil in coils]
    duplicate = next((name for index, name in enumerate(names) if name in names[:index]), None)
    if duplicate is not None:
        raise ConfigurationError("coils", f"two of the name {duplicate}", "a name of its own for each", source)
    return CoilCalibration(texts["name"], texts["date"], texts["notes"], coils)


def _coil(values: Any, where: str, source: str) -> CoilProperties:
    if not isinstance(values, Mapping):
        raise ConfigurationError(where, values, f"keys {', '.join(REQUIRED_KEYS)}", source)
    try:
        _require_keys(values, REQUIRED_KEYS, f"{CoilProperties.GROUP}.", "")
        return from_mapping(CoilProperties, {str(key): value for key, value in values.items()})
    except ConfigurationError as error:
        name = error.name.replace(CoilProperties.GROUP, where, 1)
        raise ConfigurationError(name, error.value, error.expectation, source) from None


def _require_keys(given: Mapping[Any, Any], needed: tuple[str, ...], group: str, source: str) -> None:
    missing = next((key for key in needed if key not in given), None)
    if missing is not None:
        raise ConfigurationError(f"{group}{missing}", None, f"a value: {', '.join(needed)} are needed", source)


def _rounded(values: dict[str, Any]) -> dict[str, Any]:
    """Return values rounded to eight digits, without those that were not measured."""
    named = {key: float(f"{value:.8g}") if isinstance(value, float) else value for key, value in values.items()}
    return {key: value for key, value in named.items() if key in REQUIRED_KEYS or value}


class _Dumper(yaml.SafeDumper):
    """Writes numbers so that YAML 1.1 takes them for numbers too: 1.0e-05, not 1e-05."""


def _float(dumper: yaml.SafeDumper, value: float) -> yaml.ScalarNode:
    text = repr(value)
    if "e" in text and "." not in text:
        text = text.replace("e", ".0e", 1)
    assert math.isfinite(value)
    return dumper.represent_scalar("tag:yaml.org,2002:float", text)


_Dumper.add_representer(float, _float)
