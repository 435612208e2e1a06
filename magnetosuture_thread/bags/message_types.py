"""Message types: our own, known without ROS, and those that a bag defines."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from magnetosuture_thread.bags.definitions import Extent, parse_definition
from magnetosuture_thread.bags.storage import MessageDefinition
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.messages.building import MessageBuilder
from magnetosuture_thread.resources import share_directory
from magnetosuture_thread.untrusted import MAX_DECODED, BudgetError, ParserBudget

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


def make(type_name: str, **fields: Any) -> Any:
    """Return a message; fields that are not named are zero, or empty."""
    kinds = typestore().fielddefs[type_name][1]
    if len(fields) < len(kinds):
        fields = {name: fields[name] if name in fields else _zero(kind) for name, kind in kinds}
    return typestore().types[type_name](**fields)


def _zero(kind: Any) -> Any:
    """Return what a field of a kind, as rosbags describes it, holds at first."""
    node, detail = kind
    if node is Nodetype.NAME:
        return make(detail, w=1.0) if detail == "geometry_msgs/msg/Quaternion" else make(detail)  # its definition's
    if node is Nodetype.BASE:
        return {"string": "", "bool": False}.get(detail[0], 0.0 if detail[0].startswith("float") else 0)
    (inner, element), count = detail
    count = count if node is Nodetype.ARRAY else 0
    if inner is Nodetype.BASE and element[0] != "string":
        return np.zeros(count, element[0])
    return [_zero((inner, element)) for _ in range(count)]


MESSAGES = MessageBuilder(make)
"""Builds messages of the bags' type store."""


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
        self.type_name = definition.type_name
        self.problem = ""
        own, extent = dict[str, Any](), Extent({})
        try:
            own = _parsed(definition, budget)
            types = {**typestore().fielddefs, **own}
            extent = Extent(types)
            if self.type_name in types:
                extent.check(self.type_name)
        except BudgetError as error:
            # Not ours in its place either: its messages are of that definition.
            own, self.problem = {}, str(error)
        self._density = extent.density
        ours = typestore()
        self.is_ours = (
            not self.problem
            and self.type_name in ours.fielddefs
            and (self.type_name not in own or not _differ(self.type_name, own, ours.fielddefs))
        )
        self._store: Typestore = ours if self.is_ours else _store(own)
        self.is_known = self.type_name in self._store.fielddefs

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


def _parsed(definition: MessageDefinition, budget: ParserBudget) -> dict[str, Any]:
    """Return the types of a definition, by name; none where it cannot be parsed, or uses types without definition.

    An empty definition is ignored for a type that we know: some recorders leave it out.

    Raises:
        BudgetError: it asks for more than a message may be.
    """
    own: dict[str, Any] = {}
    if not definition.text.strip() and definition.type_name in typestore().fielddefs:
        return own
    try:
        own = parse_definition(definition, budget)
    except BudgetError:
        raise
    except Exception:  # The parser raises whatever the text makes it stumble over.
        return {}
    used = {inner for _, fields in own.values() for _, kind in fields for inner in _nested_types(kind)}
    return own if used <= {*own, *typestore().fielddefs} else {}


def _differ(type_name: str, own: dict[str, Any], ours: dict[str, Any]) -> bool:
    """Return whether two definitions of a type differ in a field, or in a type within it."""
    waiting, seen = [type_name], set[str]()
    while waiting:
        name = waiting.pop()
        if name in seen or name not in own:  # which is then ours
            continue
        seen.add(name)
        if name not in ours:
            return True
        fields = [(field.lower(), kind) for field, kind in own[name][1]]
        if fields != [(field.lower(), kind) for field, kind in ours[name][1]]:
            return True
        waiting += [inner for _, kind in fields for inner in _nested_types(kind)]
    return False


def _store(own: dict[str, Any]) -> Typestore:
    """Return a store of the types in a bag; nested types that it does not define are ours."""
    store = get_typestore(Stores.EMPTY)
    ours = typestore().fielddefs
    missing = {inner for _, fields in own.values() for _, kind in fields for inner in _nested_types(kind)} - set(own)
    types = dict(own)
    while missing:
        name = missing.pop()
        if name in types or name not in ours:
            continue
        types[name] = ours[name]
        missing |= {inner for _, kind in ours[name][1] for inner in _nested_types(kind)}
    try:
        store.register(types)
    except Exception:  # A name that is no name in Python, for example.
        return get_typestore(Stores.EMPTY)
    return store


def _nested_types(kind: Any) -> list[str]:
    """Return the name of the type that a field is of, or is a sequence of, where it has one."""
    code, value = int(kind[0]), kind[1]
    if code == 2:
        return [value]
    return _nested_types(value[0]) if code in (3, 4) else []
