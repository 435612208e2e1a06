"""Configuration classes: frozen dataclasses with default, unit, bounds and one sentence for each field.

Validation of YAML files, the parameters that a node declares, and their descriptions are derived from the class.
Values are checked when the object is created, so every object is valid. Arguments of public functions and dataclasses
are checked by the same quantities, in their annotations; see `checked_arguments`.

The standard library's dataclasses carry this. attrs has nothing more that would be used here; msgspec checks what it
decodes, not what is constructed; pydantic 2 adds 0.1 s to the start of every node, and Ubuntu 24.04 has pydantic 1.10.
None of them refuses a number by its unit, so the check itself is ours with each.
"""

from __future__ import annotations

import difflib
import inspect
import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields
from functools import cache, wraps
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import yaml

from magnetosuture_thread.settings.errors import MAX_NAME_CHARS, ConfigurationError
from magnetosuture_thread.settings.files import MAX_TEXT_BYTES, MAX_YAML_DEPTH, BudgetError, check_yaml, read_regular

C = TypeVar("C", bound="Configuration")
T = TypeVar("T")

# Parameters that rclpy declares for every node.
ROS_PARAMETERS = frozenset({"qos_overrides", "start_type_description_service", "use_sim_time"})


@dataclass(frozen=True)
class Quantity:
    """Allowed values of a configuration field.

    Attributes:
        description: one sentence for a person.
        unit: SI unit, empty for text and switches.
        minimum: minimum value accepted, also of each entry of a list; -inf for any.
        maximum: maximum value accepted, likewise.
        choices: the texts accepted, also in a list; empty for any.
        multiple: a list's length must be a multiple of this.
        unlimited: whether inf is accepted too, as no limit.
    """

    description: str
    unit: str = ""
    minimum: float = -math.inf
    maximum: float = math.inf
    choices: Sequence[str] = ()
    multiple: int = 1
    unlimited: bool = False

    @property
    def bounds(self) -> str:
        """The bounds as text, empty without any."""
        if math.isfinite(self.maximum):
            return f"from {self.minimum:g} to {self.maximum:g}"
        return f"of at least {self.minimum:g}" if math.isfinite(self.minimum) else ""

    def expectation(self, kind: type, value: Any = None, entry: type = float) -> str:
        """Return the accepted values as text, with a hint where a thousandth of the value given would be accepted."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        lists = {int: "a list of whole numbers", str: "a list of texts"}
        words = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}
        text = lists.get(entry, "a list") if kind is tuple else words[kind]
        several = f"of a multiple of {self.multiple} numbers" if kind is tuple and self.multiple > 1 else ""
        text = " ".join(part for part in (text, several, self.bounds, self.unit) if part)
        return text + (", or inf" if self.unlimited else "") + self.hint(value)

    def hint(self, value: Any) -> str:
        """Return a question for a length or a speed of which a thousandth would be accepted; empty for another."""
        wrong = [part for part in (value if isinstance(value, (list, tuple)) else [value]) if not self.within(part)]
        # A number above 1e6 is no length in millimetres, and may be too great for a float.
        scaled = all(_is_number(part) and abs(part) <= 1e6 and self.within(1e-3 * part) for part in wrong)
        asks = self.unit.split("/")[0] == "m" and wrong and scaled
        return f"; given in {'metres' if self.unit == 'm' else self.unit}?" if asks else ""

    def checked(self, name: str, value: Any, kind: type = float, entry: type = float) -> Any:
        """Return a value in its type.

        Args:
            name: of the value, for the error.
            value: as it was given.
            kind: float, int, bool, str, or tuple for a list.
            entry: type of each entry of a list.

        Raises:
            ConfigurationError: it is of another type, or out of bounds.
        """
        value = plain(value)
        entries = value if kind is tuple else [value]
        is_list = isinstance(entries, Sequence) and not isinstance(entries, str) and len(entries) % self.multiple == 0
        if not is_list or not all(self._fits(part, entry if kind is tuple else kind) for part in entries):
            raise ConfigurationError(name, value, self.expectation(kind, value, entry))
        return tuple(map(entry, value)) if kind is tuple else kind(value)

    def _fits(self, value: Any, kind: type) -> bool:
        """Return whether a value, or an entry of a list, is of a kind and accepted."""
        if kind in (str, bool):
            return isinstance(value, kind) and (not self.choices or value in self.choices)
        return self.within(value) and (kind is float or isinstance(value, Integral))

    def within(self, number: Any) -> bool:
        """Return whether something is a number, finite and within the bounds."""
        number = plain(number)
        if not _is_number(number):
            return False
        finite = abs(number) <= sys.float_info.max  # not nan, and no whole number beyond any float
        return (finite and self.minimum <= number <= self.maximum) or (self.unlimited and number == math.inf)


def quantity(default: Any, *arguments: Any, **options: Any) -> Any:
    """Return a dataclass field with a default and a `Quantity`, which is made of the other arguments."""
    return field(default=default, metadata={"quantity": Quantity(*arguments, **options)})


class Configuration:
    """Base of the configuration dataclasses: checks every field when an object is made.

    A subclass is a frozen dataclass with a `GROUP`, the name of its section in a setup file, and all of whose fields
    are made by `quantity`. It checks what concerns several fields in `check`; those of its bases are called too.
    """

    GROUP: ClassVar[str] = ""

    def __post_init__(self) -> None:
        """Check every field by its quantity, then the fields together."""
        for setting in configuration_fields(type(self)):
            object.__setattr__(self, setting.name, setting.checked(getattr(self, setting.name)))
        for cls in reversed(type(self).__mro__):
            if "check" in vars(cls):
                cls.check(self)  # type: ignore[attr-defined]

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
    entry: type  # of each entry of a list

    def checked(self, value: Any) -> Any:
        """Return the value in the field's type, or raise `ConfigurationError`."""
        return self.quantity.checked(f"{self.group}.{self.name}", value, self.kind, self.entry)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def plain(value: Any) -> Any:
    """Return a number, or an array, of numpy or another library as numbers of Python; anything else as it is."""
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, (int, float)) or not isinstance(value, Real):
        return value
    try:
        return float(value)
    except OverflowError:  # beyond any bound, which no float tells
        return math.trunc(value)


def _read_fields(cls: type[Configuration]) -> tuple[ConfigurationField, ...]:
    hints = get_type_hints(cls)

    def read(entry: Any) -> ConfigurationField:
        hint = hints[entry.name]
        kind, entries = get_origin(hint) or hint, get_args(hint) or (float,)
        return ConfigurationField(cls.GROUP, entry.name, kind, entry.default, entry.metadata["quantity"], entries[0])

    return tuple(map(read, fields(cast(Any, cls))))


# To read type hints takes longer than to check a value.
configuration_fields = cast("Callable[[type[Configuration]], tuple[ConfigurationField, ...]]", cache(_read_fields))
"""Return the fields of a configuration class."""


def bounded(*arguments: Any, **options: Any) -> Quantity:
    """Return a quantity without a description, to annotate an argument's type, as in `Annotated[float, LENGTH]`."""
    return Quantity("", *arguments, **options)


def checked_arguments(owner: str, kind: Callable[..., Exception] = ConfigurationError) -> Callable[[T], T]:
    """Make a function, or a dataclass, refuse arguments that are not as annotated: of another type, or out of bounds.

    A number has to be finite and within its quantity, see `within`; it may be one of numpy, and a list an array. They
    arrive as numbers of Python and tuples of them. None is accepted where it is the default.

    Args:
        owner: what the arguments are of, for errors.
        kind: of the errors, made from name, value and expectation.
    """

    def decorate(target: Any) -> Any:
        function = vars(target)["__init__"] if isinstance(target, type) else target
        signature = inspect.signature(function)

        @cache
        def checkers() -> dict[str, Callable[[str, Any], Any]]:  # at the first call, when all names are known
            hints = get_type_hints(target, include_extras=True).items()
            return {name: check for name, hint in hints if (check := _checker(hint)) is not None}

        @wraps(function)
        def checked(*args: Any, **kwargs: Any) -> Any:
            bound = signature.bind(*args, **kwargs)
            try:
                for name, value in bound.arguments.items():
                    check = checkers().get(name)
                    if check is not None and (value is not None or signature.parameters[name].default is not None):
                        bound.arguments[name] = check(f"{owner}.{name}", value)
            except ConfigurationError as error:
                raise kind(error.name, error.value, error.expectation) from None
            return function(*bound.args, **bound.kwargs)

        if function is target:
            return checked
        target.__init__ = checked
        return target

    return decorate


@cache
def _checker(hint: Any) -> Callable[[str, Any], Any] | None:
    """Return what checks an argument of an annotation; None for one that is neither class nor number, as an array."""
    hint, quantity = get_args(hint)[:2] if get_origin(hint) is Annotated else (hint, Quantity(""))
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    lists = [kind for kind in kinds if {int, float} & {*get_args(kind)}]
    if lists or {int, float} & {*kinds}:
        kind, entry = int if int in kinds else float, get_args(lists[0])[0] if lists else float
        may_be_number = not lists or len(kinds) > 1

        def check_number(name: str, value: Any) -> Any:
            if lists and not (may_be_number and _is_number(plain(value))):
                return quantity.checked(name, value, tuple, entry)
            return quantity.checked(name, value, kind)

        return check_number
    classes = tuple(Sequence if get_origin(kind) is tuple else get_origin(kind) or kind for kind in kinds)
    if not all(isinstance(kind, type) and not hasattr(kind, "__array__") for kind in classes):
        return None
    entries = get_args(kinds[0])

    def check_class(name: str, value: Any) -> Any:
        if not isinstance(value, classes) or (isinstance(value, str) and str not in classes):
            usual = {bool: "true or false", NoneType: "nothing"}
            words = [usual.get(kind, f"an instance of {kind.__name__}") for kind in classes]
            raise ConfigurationError(name, value, " or ".join(words))
        if entries and isinstance(value, (list, tuple)) and (check := _checker(entries[0])) is not None:
            for index, item in enumerate(value):
                check(f"{name}[{index}]", item)
        return value

    return check_class


@contextmanager
def errors_of_file(source: str, prefix: str = "") -> Iterator[None]:
    """Name a file in every `ConfigurationError` that names none yet, and put a prefix before what it is about."""
    try:
        yield
    except ConfigurationError as error:
        name, source = f"{prefix}{error.name}", error.source or source
        raise ConfigurationError(name, error.value, error.expectation, source) from None


def from_mapping(cls: type[C], values: Mapping[str, Any], source: str = "") -> C:
    """Make a configuration object from a mapping, refusing keys that it does not know.

    Args:
        cls: a configuration class.
        values: values by field name; fields that are missing keep their default.
        source: the file that the values came from, named in errors.

    Raises:
        ConfigurationError: a key is unknown, or a value is of the wrong type or out of its bounds.
    """
    known = [setting.name for setting in configuration_fields(cls)]
    with errors_of_file(source):
        for name, value in values.items():
            if name not in known:
                raise ConfigurationError(f"{cls.GROUP}.{name}", value, suggest_names(name, known))
        return cls(**values)


def to_mapping(settings: Configuration) -> dict[str, Any]:
    """Return a configuration object's values by field name, tuples as lists."""
    values = {setting.name: getattr(settings, setting.name) for setting in configuration_fields(type(settings))}
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


_RosLoader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in entries if not tag.endswith((":float", ":timestamp"))]
    for first, entries in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_NUMBER = r"^[-+]?(?:(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|\.(?:inf|Inf|INF))$|^\.(?:nan|NaN|NAN)$"
_RosLoader.add_implicit_resolver("tag:yaml.org,2002:float", re.compile(_NUMBER), list("-+0123456789."))


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
        check_yaml(text, plain=plain)
        return yaml.load(text, _RosLoader)
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
    with suppress(ConfigurationError):
        return read_yaml_text(text, "parameter")
    return text


def suggest_names(name: str, known: Sequence[str]) -> str:
    """Return known names as text, the most similar ones of many, with the closest match as a hint."""
    name = name[:MAX_NAME_CHARS]  # to compare long texts takes long
    similar = difflib.get_close_matches(name, known, n=20, cutoff=0.0)
    hint = f" (did you mean {similar[0]}?)" if difflib.get_close_matches(name, similar[:1]) else ""
    shown = known if len(known) <= 20 else [*similar, "…"]  # in one line
    return f"one of {', '.join(shown)}{hint}"
