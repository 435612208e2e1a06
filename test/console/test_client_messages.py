"""Parsing and validation of client messages."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from magnetosuture_thread.console.client import ClientMessage, parse_client_message
from magnetosuture_thread.settings.errors import InvalidInputError

MAX_SPEED = 0.01


def jog(direction: object, speed: object = 0.003, sent: object = 1.0) -> str:
    """Return a jog message."""
    return json.dumps({"type": "jog", "direction": direction, "speed": speed, "sent": sent})


def parsed(text: str) -> ClientMessage:
    """Return a message."""
    return parse_client_message(text, MAX_SPEED)


def test_messages_are_parsed():
    assert parsed('{"type": "hello", "token": "abc"}') == ClientMessage("hello", {"token": "abc", "automated": None})
    assert parsed('{"type": "end_jog"}') == ClientMessage("end_jog")
    assert parsed('{"type": "bridge_action", "action": "stop"}') == ClientMessage("bridge_action", {"action": "stop"})
    assert parsed('{"type": "tip", "position": [0.001, -0.002]}') == ClientMessage("tip", {"position": (0.001, -0.002)})
    assert parsed(jog([1, 0])) == ClientMessage("jog", {"velocity": (0.003, 0.0)}, 1.0)
    assert parsed(jog([0.0, -0.5])).values["velocity"] == (0.0, -0.0015)


def test_only_what_starts_something_has_to_say_when_it_was_pressed():
    def request(name: str, sent: object) -> ClientMessage:
        *kind, action = name.split()
        values = {"procedure": "", "hold_to_run": False} if kind else {}
        return parsed(json.dumps({"type": (kind or ["bridge_action"])[0], "action": action, "sent": sent, **values}))

    for name in ("stop", "disarm", "procedure pause", "procedure abort", "procedure plan"):
        assert request(name, "yesterday").sent is None
        assert request(name, 2.5).sent == 2.5
    for name in ("arm", "reset", "procedure resume"):
        assert request(name, 2.5).sent == 2.5
        for sent in (None, "yesterday"):
            with pytest.raises(InvalidInputError, match=r"message\.sent"):
                request(name, sent)


@pytest.mark.parametrize(
    ("direction", "speed"), [([1, 0], 5.0), ([3, 4], 0.02), ([1e308, 1e308], 1e308), ([10**300, 0], 1)]
)
def test_jog_velocity_is_limited(direction: list[float], speed: float):
    assert math.hypot(*parsed(jog(direction, speed)).values["velocity"]) == pytest.approx(MAX_SPEED)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "JSON"),
        ("[" * 4000, "JSON"),
        ("[]", "a list"),
        ('{"type": ["jog"]}', "message.type"),
        ('{"type": "jog"}', "message.speed"),
        (jog([1, 0]).replace("0.003", "NaN"), "NaN"),
        (jog([1, 0]).replace("0.003", "1e999"), "message.speed"),
        (jog([1, 0]).replace("0.003", "1" + "0" * 400), "message.speed"),
        (jog([1, 0]).replace("0.003", "9" * 4000), "message"),
        (jog([1, 0], -0.001), "message.speed"),
        (jog([1]), "message.direction"),
        (jog([None, 1]), "message.direction"),
        (jog([1, 0], sent=None), "message.sent"),
        ('{"type": "bridge_action", "action": "explode"}', "message.action"),
        ('{"type": "pause", "paused": 1}', "message.paused"),
        ('{"type": "select_setup", "setup": 7}', "message.setup"),
        ('{"type": "hello"}', "message.token"),
        ('{"type": "measure", "action": "teach", "marks": []}', "message.marks"),
        ('{"type": "measure", "action": "teach", "marks": [1, 2, 3]}', "message.marks"),
        ('{"type": "measure", "action": "teach", "marks": [1, 2, 3, 4, 5, 6, 7, 8]}', "message.marks"),
        ('{"type": "measure", "action": "cancel", "marks": [1, 2, 3, 4]}', "message.marks"),
        ('{"type": "measure", "action": "commission", "marks": []}', "message.sent"),
        (json.dumps({"type": "end_jog", "ballast": "x" * 5000}), "4096"),
    ],
)
def test_invalid_messages_are_rejected_with_the_field(text: str, named: str):
    with pytest.raises(InvalidInputError) as refused:
        parse_client_message(text, MAX_SPEED)
    assert named in str(refused.value)
    assert len(str(refused.value)) < 300


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.sampled_from(["", "jog", "nan", "ü"]),
    lambda inner: st.lists(inner, max_size=4),
    max_leaves=6,
)


@given(st.dictionaries(st.sampled_from(["type", "direction", "speed", "sent", "token", "recording"]), json_values))
def test_every_message_is_parsed_or_rejected(fields):
    fields.setdefault("type", "jog")
    try:
        message = parse_client_message(json.dumps(fields), MAX_SPEED)
    except InvalidInputError:
        return
    if message.type == "jog":
        assert math.hypot(*message.values["velocity"]) <= MAX_SPEED * (1 + 1e-9)
