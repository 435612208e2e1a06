"""Parses message definitions of bags within a budget: one of a kilobyte may describe a message of gigabytes."""

from __future__ import annotations

from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys.base import make_typesdict
from rosbags.typesys.idl import IDLParser
from rosbags.typesys.msg import MSGParser
from rosbags.typesys.peg import Failure, Parser

from magnetosuture_thread.bags.storage import MessageDefinition
from magnetosuture_thread.untrusted import (
    MAX_DEFINITION_CHARS,
    MAX_ELEMENTS,
    MAX_NESTING,
    BudgetError,
    ParserBudget,
)

Types = dict[str, Any]  # fields by type, as rosbags describes them
_MAX_EMPTY = 16  # parts of a message that take no bytes


class _Bounded(Parser):
    """A parser that ends after a number of steps: some texts make it try every way to read them."""

    budget: ParserBudget

    def literal(self, pos: int, text: str) -> Any:
        """Match a literal."""
        self.budget.spend()
        return super().literal(pos, text)

    def regex(self, pos: int, pattern: str, flags: int = 0) -> Any:
        """Match a pattern."""
        self.budget.spend()
        return super().regex(pos, pattern, flags)


class _BoundedMsgParser(_Bounded, MSGParser):
    """Parser of .msg files."""


class _BoundedIdlParser(_Bounded, IDLParser):
    """Parser of .idl files, without operators in constants: those of ROS have none, and a shift may be huge."""

    def _binop(self, pos: int, left: Any, op: str, right: Any) -> Any:
        return Failure(pos, "", {"a constant without an operator"})


def parse_definition(definition: MessageDefinition, budget: ParserBudget) -> Types:
    """Return the types of a definition by name; none where its encoding is another than ROS has.

    Args:
        definition: in a bag.
        budget: of the bag.

    Raises:
        BudgetError: it asks for more than a message may be.
        Exception: whatever the parser raises on a text that is no definition.
    """
    if len(definition.text) > MAX_DEFINITION_CHARS:
        raise BudgetError(f"a definition of {len(definition.text)} characters; at most {MAX_DEFINITION_CHARS} are read")
    budget.begin()
    parser: _Bounded
    if definition.encoding == "ros2msg":
        parser = _BoundedMsgParser(f"MSG: {definition.type_name}\n{definition.text}")
    elif definition.encoding == "ros2idl":
        parser = _BoundedIdlParser(definition.text)
    else:
        return {}
    parser.budget = budget
    messages = parser.specification()
    return dict(make_typesdict(messages))


class Extent:
    """What the definition of a type makes of a message.

    Args:
        types: all types that it uses.

    Attributes:
        density: objects that a byte of a sequence may become, at most.
    """

    def __init__(self, types: Types) -> None:
        self._types = types
        self._known: dict[str, tuple[int, int, int]] = {}
        self.density = 0.0

    def check(self, type_name: str) -> None:
        """Refuse a type whose messages have more parts than may be, or parts in parts too deep.

        Raises:
            BudgetError: it does.
        """
        self._of(type_name, 0)

    def _of(self, name: str, depth: int) -> tuple[int, int, int]:
        """Return elements, least bytes and empty parts of a type."""
        if depth > MAX_NESTING:
            raise BudgetError(f"a definition with types more than {MAX_NESTING} deep in each other")
        if name not in self._known:
            elements, size, empty = 1, 0, 0
            for _, kind in self._types[name][1]:
                more = self._of_field(kind, depth)
                elements, size, empty = elements + more[0], size + more[1], empty + more[2]
                if elements > MAX_ELEMENTS:
                    raise BudgetError(f"a definition of more than {MAX_ELEMENTS} fields, nested ones counted")
            empty += not size
            if empty > _MAX_EMPTY:
                raise BudgetError(f"a definition with more than {_MAX_EMPTY} parts that hold nothing")
            self._known[name] = elements, size, empty
        return self._known[name]

    def _of_field(self, kind: Any, depth: int) -> tuple[int, int, int]:
        node, detail = kind
        if node is Nodetype.BASE:
            return 1, 4 if detail[0] == "string" else 1, 0
        if node is Nodetype.NAME:
            return self._of(detail, depth + 1)
        inner, count = detail
        if count < 0:
            raise BudgetError(f"a definition of an array of {count} parts")
        is_numeric = inner[0] is Nodetype.BASE and inner[1][0] != "string"
        if is_numeric:  # one array, whatever its length
            return 1, count if node is Nodetype.ARRAY else 4, 0
        elements, size, empty = self._of_field(inner, depth)
        if node is Nodetype.ARRAY:
            return count * elements, count * size, count * empty
        if not size:
            raise BudgetError("a definition with a sequence of parts that hold nothing")
        self.density = max(self.density, elements / size)
        return 1, 4, 0
