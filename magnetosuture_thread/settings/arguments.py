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
        hints = cache(lambda: get_type_hints(target, include_extras=True))  # later, when all names are known

        @wraps(function)
        def checked(*args: Any, **kwargs: Any) -> Any:
            bound = signature.bind(*args, **kwargs)
            try:
                for name, value in bound.arguments.items():
                    hint = hints().get(name)
                    if hint is not None and (value is not None or signature.parameters[name].default is not None):
                        bound.arguments[name] = _checked_argument(f"{owner}.{name}", value, hint)
            except ConfigurationError as error:
                raise kind(error.name, error.value, error.expectation) from None
            return function(*bound.args, **bound.kwargs)

        if function is target:
            return checked
        target.__init__ = checked
        return target

    return decorate


def _checked_argument(name: str, value: Any, hint: Any) -> Any:
    """Return an argument as its annotation has it; what is neither class nor number is not, nor an array."""
    hint, quantity = get_args(hint)[:2] if get_origin(hint) is Annotated else (hint, Quantity(""))
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    lists = [kind for kind in kinds if {int, float} & {*get_args(kind)}]
    if lists or {int, float} & {*kinds}:
        value = value.tolist() if hasattr(value, "tolist") else value
        if lists and not (len(kinds) > 1 and isinstance(value, (int, float))):
            return quantity.checked(name, value, tuple, get_args(lists[0])[0])
        return quantity.checked(name, value, int if int in kinds else float)
    classes = [Sequence if get_origin(kind) is tuple else get_origin(kind) or kind for kind in kinds]
    if all(isinstance(kind, type) and not hasattr(kind, "__array__") for kind in classes):
        if not isinstance(value, tuple(classes)) or (isinstance(value, str) and str not in classes):
            words = [WORDS.get(kind, f"an instance of {kind.__name__}") for kind in classes]
            raise ConfigurationError(name, value, " or ".join(words))
        if isinstance(value, (list, tuple)) and get_args(kinds[0]):
            for index, entry in enumerate(value):
                _checked_argument(f"{name}[{index}]", entry, get_args(kinds[0])[0])
    return value
