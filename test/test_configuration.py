"""Configuration: what is refused, and in which words."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from magnetosuture_thread.settings import shared_parameters as shared
from magnetosuture_thread.settings.configuration import Configuration, from_mapping, quantity
from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.settings.shared_parameters import load_setup


@dataclass(frozen=True)
class Oven(Configuration):
    """An example."""

    GROUP: ClassVar[str] = "oven"

    temperature: float = quantity(290.0, "how hot", unit="K", minimum=273.0, maximum=800.0)
    shelves: int = quantity(2, "how many", minimum=1, maximum=5)
    kind: str = quantity("gas", "what burns", choices=("gas", "wood"))
    lit: bool = quantity(False, "whether it burns")
    names: tuple[str, ...] = quantity((), "of the shelves", choices=("a", "b"))
    corners: tuple[float, ...] = quantity((), "x and y in turn", unit="m", minimum=-1.0, maximum=1.0, multiple=2)

    def check(self) -> None:
        """Refuse a fire without heat."""
        if self.lit and self.temperature < 300.0:
            raise ConfigurationError("oven.temperature", self.temperature, "at least 300 K when lit")


def test_values_are_kept_in_the_fields_type():
    oven = from_mapping(Oven, {"temperature": 500, "corners": [0, 1, 0.5, -1]})
    assert isinstance(oven.temperature, float)
    assert oven.corners == (0.0, 1.0, 0.5, -1.0)


def test_a_number_may_be_of_another_library():
    oven = from_mapping(Oven, {"temperature": np.float32(500), "shelves": np.int16(3), "corners": np.array([0.5, -1])})
    assert [type(value) for value in (oven.temperature, oven.shelves, *oven.corners)] == [float, int, float, float]
    assert oven == Oven(500.0, 3, corners=(0.5, -1.0))
    for value in (np.float32(2.0), np.bool_(True), np.array([2])):
        with pytest.raises(ConfigurationError, match="expected a whole number"):
            from_mapping(Oven, {"shelves": value})


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"temperature": 5000.0}, "oven.temperature: got 5000.0, expected a number from 273 to 800 K"),
        ({"temperature": float("nan")}, "oven.temperature: got nan, expected a number from 273 to 800 K"),
        ({"temperature": "400 K"}, "oven.temperature: got '400 K', expected a number from 273 to 800 K"),
        ({"kind": "coal"}, "oven.kind: got 'coal', expected one of gas, wood"),
        ({"lit": 1}, "oven.lit: got 1, expected true or false"),
        ({"corners": [0.0]}, "oven.corners: got [0.0], expected a list of a multiple of 2 numbers from -1 to 1 m"),
        ({"corners": [0.0, 7.0]}, "-1 to 1 m; given in metres?"),
        ({"names": ["a", "c"]}, "oven.names: got ['a', 'c'], expected one of a, b"),
        ({"temprature": 400.0}, "did you mean temperature?"),
        ({"lit": True, "temperature": 280.0}, "oven.temperature: got 280.0, expected at least 300 K when lit"),
    ],
)
def test_an_invalid_value_is_refused_in_one_line(values, words):
    with pytest.raises(ConfigurationError) as caught:
        from_mapping(Oven, values, "oven.yaml")
    assert words in str(caught.value)
    assert str(caught.value).startswith("oven.yaml: ")
    assert "\n" not in str(caught.value)


@dataclass(frozen=True)
class Kettle(shared.Viscosity):
    """Another example, with something that it shares."""

    GROUP: ClassVar[str] = "kettle"

    volume: float = quantity(0.001, "of the water", unit="m^3", minimum=0.0, maximum=0.01)


@dataclass(frozen=True)
class Pot(shared.Viscosity, shared.ThreadLength):
    """One more."""

    GROUP: ClassVar[str] = "pot"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("oven: [", "valid YAML"),
        ("oven: {temperature: 400.0}", "one key, ros__parameters"),
        ("ofen: {ros__parameters: {}}", "/ofen: got 'ofen', expected one of /**, oven, kettle, pot (did you mean"),
        ("oven: {ros__parameters: {temperature: 4.0}}", "oven.temperature: got 4.0"),
        ("oven: {ros__parameters: {temperature: 1" + 400 * "0" + "}}", "expected a number from 273 to 800 K"),
        ("oven: {ros__parameters: {shelves: 1, shelves: 2}}", "shelves is given twice"),
        ("oven: {ros__parameters: {corners: [0.0, 1]}}", "entries of one kind"),
        ("/**: {ros__parameters: {volume: 0.002}}", "/**.volume: got 0.002, expected a shared parameter"),
        ("/**: {ros__parameters: {viscosity: 2e6}}", "kettle.viscosity: got 2000000.0"),
        ("/**/kettle: {ros__parameters: {thread_length: 0.02}}", "kettle.thread_length: got 0.02, expected one of"),
        ("/lab1/*: {ros__parameters: {viscosity: 2.0}}", "/lab1/*: got"),
        (
            "/lab1/kettle: {ros__parameters: {volume: 0.002}}\n/lab2/kettle: {ros__parameters: {volume: 0.001}}",
            "/lab2/kettle: got '/lab2', expected one namespace in a setup, as /lab1 before",
        ),
    ],
)
def test_a_setup_file_that_is_not_valid_is_refused_and_named(tmp_path: Path, text: str, words: str):
    path = tmp_path / "kitchen.yaml"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        load_setup(path, [Oven, Kettle, Pot])
    assert str(caught.value).startswith(str(path))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_setup_file_is_read_as_ros_reads_it(tmp_path: Path):
    path = tmp_path / "oven.yaml"
    path.write_text("oven: {ros__parameters: {temperature: 4e2, use_sim_time: true, qos_overrides: {a: 1}}}")
    assert load_setup(path, [Oven])["oven"].temperature == 400.0


def test_an_unreadable_setup_file_is_refused(tmp_path: Path):
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x80")
    (tmp_path / "large.yaml").write_text("# " + "x" * 5_000_000)
    for path in (tmp_path / "missing.yaml", tmp_path / "binary.yaml", tmp_path / "large.yaml", tmp_path):
        with pytest.raises(ConfigurationError, match="a readable YAML file"):
            load_setup(path, [Oven])


COMMON, OWN = "/**: {ros__parameters: {viscosity: 2.0}}\n", "/**/kettle: {ros__parameters: {viscosity: 3.0}}\n"


@pytest.mark.parametrize(
    ("text", "kettle", "pot"),
    [
        (COMMON + OWN, 3.0, 2.0),
        (OWN + COMMON, 2.0, 2.0),  # as rclpy has it: what stands later counts, however general
        ("/lab1/kettle: {ros__parameters: {viscosity: 3.0}}\n", 3.0, 1.0),
        ("lab1: {kettle: {ros__parameters: {viscosity: 3.0}}, pot: {ros__parameters: {viscosity: 4.0}}}\n", 3.0, 4.0),
    ],
)
def test_sections_are_for_whom_ros_has_them(tmp_path: Path, text: str, kettle: float, pot: float):
    path = tmp_path / "kitchen.yaml"
    path.write_text(text)
    loaded = load_setup(path, [Kettle, Pot])
    assert (loaded["kettle"].viscosity, loaded["pot"].viscosity) == (kettle, pot)
