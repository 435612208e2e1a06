"""Checks of the arguments of public functions and dataclasses, by their annotations."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from functools import cache, wraps
from types import NoneType, UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

from magnetosuture_thread.settings.configuration import Quantity
from magnetosuture_thread.settings.errors import ConfigurationError

T = TypeVar("T")

WORDS: dict[type, str] = {bool: "true or false", NoneType: "nothing"}


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
            value = value.tolist() if hasattr(value, "tolist") else value
            if lists and not (may_be_number and isinstance(value, (int, float))):
                return quantity.checked(name, value, tuple, entry)
            return quantity.checked(name, value, kind)

        return check_number
    classes = tuple(Sequence if get_origin(kind) is tuple else get_origin(kind) or kind for kind in kinds)
    if not all(isinstance(kind, type) and not hasattr(kind, "__array__") for kind in classes):
        return None
    entries = get_args(kinds[0])

    def check_class(name: str, value: Any) -> Any:
        if not isinstance(value, classes) or (isinstance(value, str) and str not in classes):
            words = [WORDS.get(kind, f"an instance of {kind.__name__}") for kind in classes]
            raise ConfigurationError(name, value, " or ".join(words))
        if entries and isinstance(value, (list, tuple)) and (check := _checker(entries[0])) is not None:
            for index, item in enumerate(value):
                check(f"{name}[{index}]", item)
        return value

    return check_class
