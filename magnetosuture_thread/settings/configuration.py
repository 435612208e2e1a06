"""Configuration classes: frozen dataclasses with unit, bounds and description of each field.

Validation of YAML files, the parameters that a node declares, and their descriptions are derived from the class.
Values are checked when the object is created, so every object is valid.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, TypeVar, cast, get_type_hints

import yaml

from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.settings.files import MAX_TEXT_BYTES, MAX_YAML_DEPTH, BudgetError, check_yaml, read_regular

C = TypeVar("C", bound="Configuration")


# Parameters that rclpy declares for every node.
ROS_PARAMETERS = frozenset({"qos_overrides", "start_type_description_service", "use_sim_time"})


@dataclass(frozen=True)
class Quantity:
    """Allowed values of a configuration field.

    Attributes:
        description: one sentence for a person.
        unit: SI unit, empty for text and switches.
        minimum: minimum value accepted, also of each entry of a list.
        maximum: maximum value accepted, also of each entry of a list.
        choices: the texts accepted, also in a list; empty for any.
        multiple: a list's length must be a multiple of this.
        unlimited: whether inf is accepted too, as no limit.
    """

    description: str
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()
    multiple: int = 1
    unlimited: bool = False

    def expectation(self, kind: type, value: Any = None) -> str:
        """Return the accepted values as text, with a hint where a thousandth of the value given would be accepted."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        words = {float: "a number", int: "a whole number", bool: "true or false", str: "text", tuple: "a list"}[kind]
        if kind is tuple and self.multiple > 1:
            words += f" of a multiple of {self.multiple} numbers"
        if self.minimum is not None and self.maximum is not None:
            words += f" from {self.minimum:g} to {self.maximum:g}"
        elif self.minimum is not None:
            words += f" of at least {self.minimum:g}"
        elif self.maximum is not None:
            words += f" of at most {self.maximum:g}"
        return f"{words} {self.unit}".rstrip() + (", or inf" if self.unlimited else "") + self.hint(value)

    def hint(self, value: Any) -> str:
        """Return a question for a length or a speed of which a thousandth would be accepted; empty for another."""
        wrong = [part for part in (value if isinstance(value, (list, tuple)) else [value]) if not self.within(part)]
        # A number above 1e6 is no length in millimetres, and may be too great for a float.
        scaled = all(_is_number(part) and abs(part) <= 1e6 and self.within(1e-3 * part) for part in wrong)
        asks = self.unit.split("/")[0] == "m" and wrong and scaled
        return f"; given in {'metres' if self.unit == 'm' else self.unit}?" if asks else ""

    def checked(self, name: str, value: Any, kind: type = float, entry: type = float, source: str = "") -> Any:
        """Return a value in its type.

        Args:
            name: of the value, for the error.
            value: as it was given.
            kind: float, int, bool, str, or tuple for a list.
            entry: type of each entry of a list.
            source: file that it is from, for the error.

        Raises:
            ConfigurationError: it is of another type, or out of bounds.
        """
        entries = value if kind is tuple else [value]
        good = isinstance(entries, Sequence) and not isinstance(entries, str) and len(entries) % self.multiple == 0
        if not (good and all(self._fits(each, entry if kind is tuple else kind) for each in entries)):
            of = {int: "a list of whole numbers", str: "a list of texts"}.get(entry, "a list")
            raise ConfigurationError(name, value, self.expectation(kind, value).replace("a list", of), source)
        if kind is tuple:
            return tuple(entry(each) for each in value)
        return float(value) if kind is float else value

    def _fits(self, value: Any, kind: type) -> bool:
        """Return whether a value, or an entry of a list, is of a kind and accepted."""
        if kind in (str, bool):
            return isinstance(value, kind) and (not self.choices or value in self.choices)
        return self.within(value) and (kind is float or isinstance(value, int))

    def within(self, number: Any) -> bool:
        """Return whether something is a number, finite and within the bounds."""
        try:
            value = float(number) if _is_number(number) else math.nan
        except OverflowError:  # a whole number beyond any float
            return False
        if self.unlimited and value == math.inf:
            return True
        low, high = self.minimum, self.maximum
        return math.isfinite(value) and (low is None or value >= low) and (high is None or value <= high)


def quantity(
    default: Any,
    description: str,
    unit: str = "",
    minimum: float | None = None,
    maximum: float | None = None,
    *,
    choices: Sequence[str] = (),
    multiple: int = 1,
) -> Any:
    """Make a dataclass field that carries a `Quantity`."""
    about = Quantity(description, unit, minimum, maximum, tuple(choices), multiple)
    return field(default=default, metadata={"quantity": about})


def autostart_parameter() -> Any:
    """Return the dataclass field of a lifecycle node's parameter `autostart`."""
    states = ("unconfigured", "inactive", "active")
    return quantity("active", "state that the node enters by itself at start", choices=states)


class Configuration:
    """Base of the configuration dataclasses: checks every field when an object is made.

    A subclass is a frozen dataclass with a `GROUP`, the name of its section in a setup file, and all
    of whose fields are made by `quantity`. It checks what concerns several fields in `check`.
    """

    GROUP: ClassVar[str] = ""

    def __post_init__(self) -> None:
        """Check every field by its quantity, then the fields together."""
        for about in configuration_fields(type(self)):
            object.__setattr__(self, about.name, about.checked(getattr(self, about.name)))
        self.check()

    def check(self) -> None:
        """Raise `ConfigurationError` where fields that are valid apart contradict each other."""

    def refused(self, name: str, expected: str) -> ConfigurationError:
        """Return the error of a field whose value does not fit the others."""
        value = getattr(self, name)
        return ConfigurationError(f"{self.GROUP}.{name}", list(value) if isinstance(value, tuple) else value, expected)


@dataclass(frozen=True)
class ConfigurationField:
    """One field of a configuration class: its name, type, default and quantity."""

    group: str
    name: str
    kind: type
    default: Any
    quantity: Quantity
    entry: type = float  # of each entry of a list

    def checked(self, value: Any, source: str = "") -> Any:
        """Return the value in the field's type, or raise `ConfigurationError`."""
        return self.quantity.checked(f"{self.group}.{self.name}", value, self.kind, self.entry, source)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _read_fields(cls: type[Configuration]) -> tuple[ConfigurationField, ...]:
    hints, found = get_type_hints(cls), []
    for entry in fields(cast(Any, cls)):
        hint = hints[entry.name]
        kind, entries = getattr(hint, "__origin__", hint), getattr(hint, "__args__", (float,))[0]
        assert entry.default is not MISSING, f"{cls.__name__}.{entry.name} has no default"
        about = entry.metadata["quantity"]
        found.append(ConfigurationField(cls.GROUP, entry.name, kind, entry.default, about, entries))
    return tuple(found)


# To read type hints takes longer than to check a value.
configuration_fields = cast("Callable[[type[Configuration]], tuple[ConfigurationField, ...]]", cache(_read_fields))
"""Return the fields of a configuration class."""


def from_mapping(cls: type[C], values: Mapping[str, Any], source: str = "") -> C:
    """Make a configuration object from a mapping, refusing keys that it does not know.

    Args:
        cls: a configuration class.
        values: values by field name; fields that are missing keep their default.
        source: the file that the values came from, named in errors.

    Raises:
        ConfigurationError: a key is unknown, or a value is of the wrong type or out of its bounds.
    """
    about = {entry.name: entry for entry in configuration_fields(cls)}
    checked = {}
    for name, value in values.items():
        if name not in about:
            raise ConfigurationError(f"{cls.GROUP}.{name}", value, suggest_names(name, list(about)), source)
        checked[name] = about[name].checked(value, source)
    try:
        return cls(**checked)
    except ConfigurationError as error:
        raise ConfigurationError(error.name, error.value, error.expectation, source) from None


def to_mapping(settings: Configuration) -> dict[str, Any]:
    """Return a configuration object's values by field name, tuples as lists."""
    values = {about.name: getattr(settings, about.name) for about in configuration_fields(type(settings))}
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


class _RosLoader(yaml.CSafeLoader):  # the loader without libyaml takes ten times as long
    """Reads a parameter file as ROS does, and refuses a key that is given twice.

    1e-5 is a number, as in YAML 1.2, and nothing is a date.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return a mapping, or raise where a key occurs twice."""
        keys = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in keys:
                raise yaml.constructor.ConstructorError(None, None, f"{key.value} is given twice", key.start_mark)
            keys.add(key.value if isinstance(key, yaml.ScalarNode) else None)
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        return mapping


def use_ros_numbers(loader: type[Any]) -> None:
    """Make a YAML loader, a class, read numbers as ROS does: 1e-5 is a number, and nothing is a date."""
    loader.yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in entries if not tag.endswith((":float", ":timestamp"))]
        for first, entries in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    number = r"^[-+]?(?:(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|\.(?:inf|Inf|INF))$|^\.(?:nan|NaN|NAN)$"
    loader.add_implicit_resolver("tag:yaml.org,2002:float", re.compile(number), list("-+0123456789."))


use_ros_numbers(_RosLoader)


def _load(text: str, *, plain: bool = False) -> Any:
    check_yaml(text, plain=plain)
    return yaml.load(text, _RosLoader)


def read_yaml(path: Path, what: str, *, plain: bool = False) -> Any:
    """Return the content of a YAML file, read as ROS does: 1e-5 is a number, nothing is a date, keys are unique.

    Args:
        path: the file.
        what: it is, for the error.
        plain: whether tags, and numbers that ROS takes for octal and the like, are refused.

    Raises:
        ConfigurationError: the file cannot be read, is not regular or too large, or is no plain YAML.
    """
    try:
        text = read_regular(path, MAX_TEXT_BYTES).decode("utf-8")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "not text"
        raise ConfigurationError(what, reason, "a readable YAML file", str(path)) from None
    return read_yaml_text(text, what, str(path), plain=plain)


def read_yaml_text(text: str, what: str, source: str = "", *, plain: bool = False) -> Any:
    """Return the content of a text as `read_yaml` does that of a file.

    Args:
        text: of at most `MAX_TEXT_BYTES` characters.
        what: it is, for the error.
        source: file that it is from, for the error.
        plain: as of `read_yaml`.

    Raises:
        ConfigurationError: it is too large, or no plain YAML.
    """
    if len(text) > MAX_TEXT_BYTES:
        raise ConfigurationError(what, f"{len(text)} characters", f"at most {MAX_TEXT_BYTES}", source)
    try:
        return _load(text, plain=plain)
    except BudgetError as error:
        raise ConfigurationError(what, str(error), f"plain YAML, at most {MAX_YAML_DEPTH} deep", source) from None
    except yaml.YAMLError as error:
        problem = str(getattr(error, "problem", error))
        mark = getattr(error, "problem_mark", None)
        line = f" in line {mark.line + 1}" if mark else ""
        raise ConfigurationError(what, problem + line, "valid YAML", source) from None
    except ValueError:
        raise ConfigurationError(what, "not text", "a readable YAML file", source) from None


def parse_parameter_value(text: str) -> Any:
    """Return the value of a text as in a parameter file; the text itself where it is no YAML."""
    try:
        return _load(text)
    except (yaml.YAMLError, BudgetError):
        return text


def suggest_names(name: str, known: list[str]) -> str:
    """Return the known names as text, with the closest match as a hint."""
    close = difflib.get_close_matches(name, known, n=1)
    hint = f" (did you mean {close[0]}?)" if close else ""
    return f"one of {', '.join(known)}{hint}"
