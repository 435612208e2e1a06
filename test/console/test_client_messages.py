"""Parsing and validation of client messages."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from magnetosuture_thread.console.client_messages import (
    Acknowledge,
    BridgeAction,
    EndJog,
    Hello,
    Jog,
    Visibility,
    parse_client_message,
)
from magnetosuture_thread.errors import InvalidInputError

MAX_SPEED = 0.01


def jog(direction: object, speed: object = 0.003, sent: object = 1.0) -> str:
    """Return a jog message."""
    return json.dumps({"type": "jog", "direction": direction, "speed": speed, "sent": sent})


def test_messages_are_parsed():
    assert parse_client_message('{"type": "hello", "token": "abc"}', MAX_SPEED) == Hello("abc")
    assert parse_client_message('{"type": "end_jog"}', MAX_SPEED) == EndJog()
    assert parse_client_message('{"type": "acknowledge", "kind": "frame"}', MAX_SPEED) == Acknowledge("frame")
    assert parse_client_message('{"type": "bridge_action", "action": "stop"}', MAX_SPEED) == BridgeAction("stop")
    assert parse_client_message('{"type": "visibility", "visible": false}', MAX_SPEED) == Visibility(False)


def test_jog_velocity_is_direction_times_speed():
    assert parse_client_message(jog([1, 0]), MAX_SPEED) == Jog((0.003, 0.0), 1.0)
    assert parse_client_message(jog([0.0, -0.5]), MAX_SPEED) == Jog((0.0, -0.0015), 1.0)


@pytest.mark.parametrize(
    ("direction", "speed"), [([1, 0], 5.0), ([3, 4], 0.02), ([1e308, 1e308], 1e308), ([10**300, 0], 1)]
)
def test_jog_velocity_is_limited(direction: list[float], speed: float):
    message = parse_client_message(jog(direction, speed), MAX_SPEED)
    assert isinstance(message, Jog)
    assert math.hypot(*message.velocity) == pytest.approx(MAX_SPEED)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "JSON"),
        ("nonsense", "JSON"),
        ("[" * 4000, "JSON"),
        ('{"a":' * 800, "JSON"),
        ("[]", "a list"),
        ("null", "JSON object"),
        ("12", "JSON object"),
        ("{}", "message.type"),
        ('{"type": ["jog"]}', "message.type"),
        ('{"type": "jog"}', "message.speed"),
        (jog([1, 0]).replace("0.003", "NaN"), "NaN"),
        (jog([1, 0]).replace("0.003", "-Infinity"), "-Infinity"),
        (jog([1, 0]).replace("0.003", "1e999"), "message.speed"),
        (jog([1, 0]).replace("0.003", "1" + "0" * 400), "message.speed"),
        (jog([1, 0]).replace("0.003", "9" * 4000), "message"),
        (jog([1, 0], -0.001), "message.speed"),
        (jog([1, 0], "fast"), "message.speed"),
        (jog([1, 0], True), "message.speed"),
        (jog([1]), "message.direction"),
        (jog([1, 0, 0]), "message.direction"),
        (jog([]), "message.direction"),
        (jog({"x": 1}), "message.direction"),
        (jog("10"), "message.direction"),
        (jog([None, 1]), "message.direction"),
        (jog([[1], [0]]), "message.direction"),
        (jog([1, 0], sent=None), "message.sent"),
        ('{"type": "bridge_action", "action": "explode"}', "message.action"),
        ('{"type": "bridge_action", "action": {}}', "message.action"),
        ('{"type": "pause", "paused": 1}', "message.paused"),
        ('{"type": "select_setup", "setup": 7}', "message.setup"),
        ('{"type": "hello"}', "message.token"),
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
    if isinstance(message, Jog):
        assert math.hypot(*message.velocity) <= MAX_SPEED * (1 + 1e-9)
