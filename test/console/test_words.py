"""What a page may say, and what is refused."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from magnetosuture_thread.console.words import Act, Got, Hello, Hold, Release, Visible, read_word
from magnetosuture_thread.errors import InvalidInputError

FASTEST = 0.01


def hold(direction: object, speed: object = 0.003, sent: object = 1.0) -> str:
    """Return a message that holds a direction."""
    return json.dumps({"type": "hold", "direction": direction, "speed": speed, "sent": sent})


def test_words_are_read():
    assert read_word('{"type": "hello", "token": "abc"}', FASTEST) == Hello("abc")
    assert read_word('{"type": "release"}', FASTEST) == Release()
    assert read_word('{"type": "got", "what": "frame"}', FASTEST) == Got("frame")
    assert read_word('{"type": "act", "action": "stop"}', FASTEST) == Act("stop")
    assert read_word('{"type": "visible", "seen": false}', FASTEST) == Visible(False)


def test_a_direction_and_a_speed_make_a_velocity():
    assert read_word(hold([1, 0]), FASTEST) == Hold((0.003, 0.0), 1.0)
    assert read_word(hold([0.0, -0.5]), FASTEST) == Hold((0.0, -0.0015), 1.0)


@pytest.mark.parametrize(
    ("direction", "speed"), [([1, 0], 5.0), ([3, 4], 0.02), ([1e308, 1e308], 1e308), ([10**300, 0], 1)]
)
def test_no_velocity_is_beyond_the_greatest(direction: list[float], speed: float):
    word = read_word(hold(direction, speed), FASTEST)
    assert isinstance(word, Hold)
    assert math.hypot(*word.velocity) == pytest.approx(FASTEST)


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
        ('{"type": ["hold"]}', "message.type"),
        ('{"type": "hold"}', "message.speed"),
        (hold([1, 0]).replace("0.003", "NaN"), "NaN"),
        (hold([1, 0]).replace("0.003", "-Infinity"), "-Infinity"),
        (hold([1, 0]).replace("0.003", "1e999"), "message.speed"),
        (hold([1, 0]).replace("0.003", "1" + "0" * 400), "message.speed"),
        (hold([1, 0]).replace("0.003", "9" * 4000), "message"),
        (hold([1, 0], -0.001), "message.speed"),
        (hold([1, 0], "fast"), "message.speed"),
        (hold([1, 0], True), "message.speed"),
        (hold([1]), "message.direction"),
        (hold([1, 0, 0]), "message.direction"),
        (hold([]), "message.direction"),
        (hold({"x": 1}), "message.direction"),
        (hold("10"), "message.direction"),
        (hold([None, 1]), "message.direction"),
        (hold([[1], [0]]), "message.direction"),
        (hold([1, 0], sent=None), "message.sent"),
        ('{"type": "act", "action": "explode"}', "message.action"),
        ('{"type": "act", "action": {}}', "message.action"),
        ('{"type": "pause", "still": 1}', "message.still"),
        ('{"type": "choose", "scenario": 7}', "message.scenario"),
        ('{"type": "hello"}', "message.token"),
        (json.dumps({"type": "release", "ballast": "x" * 5000}), "4096"),
    ],
)
def test_anything_else_is_refused_by_name(text: str, named: str):
    with pytest.raises(InvalidInputError) as refused:
        read_word(text, FASTEST)
    assert named in str(refused.value)
    assert len(str(refused.value)) < 300


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.sampled_from(["", "hold", "nan", "ü"]),
    lambda inner: st.lists(inner, max_size=4),
    max_leaves=6,
)


@given(st.dictionaries(st.sampled_from(["type", "direction", "speed", "sent", "token", "on"]), json_values))
def test_no_message_does_anything_but_be_read_or_refused(fields):
    fields.setdefault("type", "hold")
    try:
        word = read_word(json.dumps(fields), FASTEST)
    except InvalidInputError:
        return
    if isinstance(word, Hold):
        assert math.hypot(*word.velocity) <= FASTEST * (1 + 1e-9)
