"""Message types: our own, known without ROS, and those that a bag defines.

Definitions of a bag are parsed within a budget: one of a kilobyte may describe a message of gigabytes.
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

from magnetosuture_thread.bags.budgets import MAX_DECODED, MAX_DEFINITION_CHARS, MAX_ELEMENTS, MAX_NESTING, ParserBudget
from magnetosuture_thread.bags.storage import MessageDefinition
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import BudgetError, share_directory

Types = dict[str, Any]  # constants and fields by type, as rosbags describes them

HEADER = "std_msgs/msg/Header"


@cache
def typestore() -> Typestore:
    """Return the types of ROS 2 Jazzy and of magnetosuture_msgs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    own = {}
    for path in sorted((share_directory("magnetosuture_msgs") / "msg").glob("*.msg")):
        own.update(get_types_from_msg(path.read_text(encoding="utf-8"), f"magnetosuture_msgs/msg/{path.stem}"))
    store.register(own)
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
        problem: why the bag's definition is not used; empty where it is, or none is needed.
    """

    def __init__(self, definition: MessageDefinition, budget: ParserBudget) -> None:
        self.type_name = name = definition.type_name
        self.problem = ""
        self._store: Typestore = get_typestore(Stores.EMPTY)
        self._density = 0.0
        ours = typestore()
        types: Types = ours.fielddefs
        try:
            types = {**types, **_parsed_types(definition, budget)}
            if name in types:
                self._density = _density(name, types)
        except BudgetError as error:
            # Not ours in its place either: its messages are of that definition.
            self.problem = str(error)
        fields = {} if self.problem or name not in types else _fields_within(name, types)
        self.is_ours = bool(fields) and name in ours.fielddefs and fields == _fields_within(name, ours.fielddefs)
        if self.is_ours:
            self._store = ours
        elif fields:
            try:
                self._store.register({each: types[each] for each in fields})
            except Exception:  # A name that is no name in Python, for example.
                self._store = get_typestore(Stores.EMPTY)
        self.is_known = name in self._store.fielddefs

    def decode(self, topic: str, data: bytes) -> Any:
        """Return a message as an object of a type store.

        Raises:
            BagError: the bytes are not of the type, or the type has no definition.
        """
        if self.problem:
            raise BagError(topic, f"the type {self.type_name} of its messages has {self.problem}")
        if len(data) * self._density > MAX_DECODED:
            text = f"a message of {len(data)} bytes may have more than {MAX_DECODED} parts; so many are not decoded"
            raise BagError(topic, text)
        if not self.is_known:
            raise BagError(topic, f"the type {self.type_name or '(no name)'} of its messages has no definition")
        try:
            return self._store.deserialize_cdr(data, self.type_name)
        except Exception as error:  # The decoder raises whatever the bytes make it stumble over.
            raise BagError(topic, f"a message cannot be decoded as {self.type_name}: {error}") from None

    def has_header(self) -> bool:
        """Return whether a message is a header or begins with one."""
        if self.type_name == HEADER and not self.problem:
            return True
        fields = self._store.fielddefs[self.type_name][1] if self.is_known else []
        return bool(fields) and fields[0][1][1] == HEADER


class DecoderCache:
    """Decoders of the messages of one bag, whose definitions are parsed within one budget.

    Those of another bag are not shared: whether a definition is still parsed depends on those before it.
    """

    def __init__(self) -> None:
        self._budget = ParserBudget()
        self._decoders: dict[MessageDefinition, MessageDecoder] = {}

    def decoder_of(self, definition: MessageDefinition) -> MessageDecoder:
        """Return the decoder of messages of a definition."""
        if definition not in self._decoders:
            self._decoders[definition] = MessageDecoder(definition, self._budget)
        return self._decoders[definition]


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


def _parsed_types(definition: MessageDefinition, budget: ParserBudget) -> Types:
    """Return the types of a definition; none where it cannot be parsed, or uses types without definition.

    An empty definition is ignored for a type that we know: some recorders leave it out.

    Raises:
        BudgetError: it takes too much to parse.
    """
    name, text = definition.type_name, definition.text
    ours = typestore().fielddefs
    if definition.encoding not in ("ros2msg", "ros2idl") or (not text.strip() and name in ours):
        return {}
    if len(text) > MAX_DEFINITION_CHARS:
        raise BudgetError(f"a definition of {len(text)} characters; at most {MAX_DEFINITION_CHARS} are read")
    budget.begin()
    try:
        parser: _Bounded
        if definition.encoding == "ros2msg":
            parser = _BoundedMsgParser(f"MSG: {name}\n{text}")
        else:
            parser = _BoundedIdlParser(text)
        parser.budget = budget
        own = dict(make_typesdict(parser.specification()))
    except BudgetError:
        raise
    except Exception:  # The parser raises whatever the text makes it stumble over.
        return {}
    used = {_type_within(kind) for _, fields in own.values() for _, kind in fields} - {""}
    return own if used <= {*own, *ours} else {}


def _fields_within(name: str, types: Types) -> Types:
    """Return the fields of a type and of all types in it, by type; those of ROS 1 have capitals in their names."""
    found: Types = {}
    waiting = [name]
    while waiting:
        each = waiting.pop()
        if each not in found:
            found[each] = [(field.lower(), kind) for field, kind in types[each][1]]
            waiting += [inner for _, kind in found[each] if (inner := _type_within(kind))]
    return found


def _type_within(kind: Any) -> str:
    """Return the name of the type that a field is of, or is a sequence of; empty where it has none."""
    node, detail = kind
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        node, detail = detail[0]
    return detail if node is Nodetype.NAME else ""


def _density(type_name: str, types: Types) -> float:
    """Return how many objects a byte of a sequence in a message may become, at most.

    Raises:
        BudgetError: messages have more parts than they may whatever their data, parts in parts too deep, or sequences
            of parts that take no bytes.
    """
    known: dict[str, tuple[int, int]] = {}
    density = 0.0

    def extent_of(name: str, depth: int) -> tuple[int, int]:
        """Return number of objects and least bytes of a type."""
        if depth > MAX_NESTING:
            raise BudgetError(f"a definition with types more than {MAX_NESTING} deep in each other")
        if name not in known:
            objects, size = 1, 0
            for _, kind in types[name][1]:
                more, bytes_more = extent_of_field(kind, depth)
                objects, size = objects + more, size + bytes_more
                if objects > MAX_ELEMENTS:
                    raise BudgetError(f"a definition of more than {MAX_ELEMENTS} fields, nested ones counted")
            known[name] = objects, size
        return known[name]

    def extent_of_field(kind: Any, depth: int) -> tuple[int, int]:
        nonlocal density
        node, detail = kind
        if node is Nodetype.BASE:
            return 1, 4 if detail[0] == "string" else 1
        if node is Nodetype.NAME:
            return extent_of(detail, depth + 1)
        inner, count = detail
        if count < 0:
            raise BudgetError(f"a definition of an array of {count} parts")
        if inner[0] is Nodetype.BASE and inner[1][0] != "string":  # one array of numbers, whatever its length
            return 1, count if node is Nodetype.ARRAY else 4
        objects, size = extent_of_field(inner, depth)
        if node is Nodetype.ARRAY:
            return count * objects, count * size
        if not size:
            raise BudgetError("a definition with a sequence of parts that hold nothing")
        density = max(density, objects / size)
        return 1, 4

    extent_of(type_name, 0)
    return density
