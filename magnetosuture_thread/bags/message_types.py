"""Message types: our own, known without ROS, and those that a bag defines.

Definitions of a bag are parsed within its budget: one of a kilobyte may describe a message of gigabytes.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import make_typesdict
from rosbags.typesys.idl import IDLParser
from rosbags.typesys.msg import MSGParser
from rosbags.typesys.peg import Failure, Parser
from rosbags.typesys.store import Typestore

from magnetosuture_thread.bags.storage import Budget, MessageDefinition
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import share_directory

Types = dict[str, Any]  # constants and fields by type, as rosbags describes them


@cache
def typestore() -> Typestore:
    """Return the types of ROS 2 Jazzy and of magnetosuture_msgs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for path in sorted((share_directory("magnetosuture_msgs") / "msg").glob("*.msg")):
        types.update(get_types_from_msg(path.read_text(encoding="utf-8"), f"magnetosuture_msgs/msg/{path.stem}"))
    store.register(types)
    return store


def own_definition(type_name: str) -> MessageDefinition:
    """Return our definition of a type; its text is empty if we have none."""
    store = typestore()
    if type_name not in store.fielddefs:
        return MessageDefinition(type_name)
    return MessageDefinition(type_name, "ros2msg", store.generate_msgdef(type_name, ros_version=2)[0])


class MessageDecoder:
    """Decodes messages of one type.

    Args:
        definition: of the type in the bag. Ours is used where the bag has none, an equivalent one, or one that
            cannot be parsed.
        budget: of the bag.

    Attributes:
        type_name: for example `nav_msgs/msg/Path`.
        is_ours: whether our definition of the type is used.
        is_known: whether there is any definition that can be used.
    """

    def __init__(self, definition: MessageDefinition, budget: Budget) -> None:
        self.type_name = name = definition.type_name
        self._store, self._problem, self._density = get_typestore(Stores.EMPTY), "", 0.0
        ours = typestore()
        try:
            types: Types = {**ours.fielddefs, **_parsed_types(definition, budget)}
            fields = _fields_within(name, types) if name in types else {}
            self._density = _extent((Nodetype.NAME, name), types)[2] if fields else 0.0
        except BagError as error:
            # Not ours in its place either: its messages are of that definition.
            self._problem, fields = error.problem, {}
        self.is_ours = bool(fields) and name in ours.fielddefs and fields == _fields_within(name, ours.fielddefs)
        if self.is_ours:
            self._store = ours
        elif fields:
            try:
                self._store.register({kind: types[kind] for kind in fields})
            except Exception:  # A name that is no name in Python, for example.
                self._store = get_typestore(Stores.EMPTY)
        self.is_known = name in self._store.fielddefs

    def decode(self, topic: str, data: bytes) -> Any:
        """Return a message as an object of a type store.

        Raises:
            BagError: the bytes are not of the type, or the type has no definition.
        """
        if len(data) * self._density > 1_000_000:  # objects that it may become
            raise BagError(topic, f"a message of {len(data)} bytes may have more than 1000000 parts")
        if not self.is_known:
            problem = self._problem or "no definition"
            raise BagError(topic, f"the type {self.type_name or '(no name)'} of its messages has {problem}")
        try:
            return self._store.deserialize_cdr(data, self.type_name)
        except Exception as error:  # The decoder raises whatever the bytes make it stumble over.
            raise BagError(topic, f"a message cannot be decoded as {self.type_name}: {error}") from None

    def has_header(self) -> bool:
        """Return whether a message is a header or begins with one."""
        fields = self._store.fielddefs[self.type_name][1] if self.is_known else []
        header = "std_msgs/msg/Header"
        return self.type_name == header or (bool(fields) and fields[0][1][1] == header)


class _Bounded(Parser):
    """A parser that ends after a number of steps: some texts make it try every way to read them."""

    budget: Budget

    def literal(self, pos: int, text: str) -> Any:
        """Match a literal."""
        self.budget.spend("steps to parse its definitions", 1)
        return super().literal(pos, text)

    def regex(self, pos: int, pattern: str, flags: int = 0) -> Any:
        """Match a pattern."""
        self.budget.spend("steps to parse its definitions", 1)
        return super().regex(pos, pattern, flags)


class _BoundedMsgParser(_Bounded, MSGParser):
    """Parser of .msg files."""


class _BoundedIdlParser(_Bounded, IDLParser):
    """Parser of .idl files, without operators in constants: those of ROS have none, and a shift may be huge."""

    def _binop(self, pos: int, left: Any, op: str, right: Any) -> Any:
        return Failure(pos, "", {"a constant without an operator"})


def _parsed_types(definition: MessageDefinition, budget: Budget) -> Types:
    """Return the types of a definition; none where it cannot be parsed, or uses types without definition.

    An empty definition is ignored for a type that we know: some recorders leave it out.

    Raises:
        BagError: it takes too much to parse.
    """
    name, text = definition.type_name, definition.text
    ours = typestore().fielddefs
    if definition.encoding not in ("ros2msg", "ros2idl") or (not text.strip() and name in ours):
        return {}
    if len(text) > 200_000:
        raise BagError(name, f"a definition of {len(text)} characters; at most 200000 are read")
    try:
        is_msg = definition.encoding == "ros2msg"
        parser = _BoundedMsgParser(f"MSG: {name}\n{text}") if is_msg else _BoundedIdlParser(text)
        parser.budget = budget
        types = dict(make_typesdict(parser.specification()))
    except BagError:
        raise BagError(name, "a definition that takes too many steps to parse") from None
    except Exception:  # The parser raises whatever the text makes it stumble over.
        return {}
    used = {_type_within(kind) for _, fields in types.values() for _, kind in fields} - {""}
    return types if used <= {*types, *ours} else {}


def _fields_within(name: str, types: Types) -> Types:
    """Return the fields of a type and of all types in it, by type; those of ROS 1 have capitals in their names."""
    fields: Types = {}
    waiting = [name]
    while waiting:
        kind = waiting.pop()
        if kind not in fields:
            fields[kind] = [(field.lower(), inner) for field, inner in types[kind][1]]
            waiting += [inner for _, field_kind in fields[kind] if (inner := _type_within(field_kind))]
    return fields


def _type_within(kind: Any) -> str:
    """Return the name of the type that a field is of, or is a sequence of; empty where it has none."""
    node, detail = kind
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        node, detail = detail[0]
    return detail if node is Nodetype.NAME else ""


def _extent(kind: Any, types: Types, depth: int = 0) -> tuple[int, int, float]:
    """Return number of objects and least bytes of a field, and how many objects a byte of a sequence in it may become.

    Raises:
        BagError: messages have more parts than they may whatever their data, parts in parts too deep, or sequences
            of parts that take no bytes.
    """
    node, detail = kind
    objects, size, density = 1, 1, 0.0
    if node is Nodetype.BASE:
        size = 4 if detail[0] == "string" else 1
    elif node is Nodetype.NAME:
        if depth > 32:
            raise BagError(detail, "a definition with types more than 32 deep in each other")
        parts = [_extent(inner, types, depth + 1) for _, inner in types[detail][1]]
        objects, size = 1 + sum(part[0] for part in parts), sum(part[1] for part in parts)
        density = max((part[2] for part in parts), default=0.0)
    else:
        inner, count = detail
        is_numbers = inner[0] is Nodetype.BASE and inner[1][0] != "string"  # one array, whatever its length
        objects, size, density = (1, 1, 0.0) if is_numbers else _extent(inner, types, depth)
        if node is Nodetype.ARRAY:
            objects, size = objects if is_numbers else count * objects, count * size
        elif not size:
            raise BagError("", "a definition with a sequence of parts that hold nothing")
        else:
            objects, size, density = 1, 4, density if is_numbers else max(density, objects / size)
    if not 0 <= objects <= 4_000:  # for each, whatever the data, a decoder is made
        raise BagError("", "a definition of more than 4000 fields, nested ones counted")
    return objects, size, density
