"""Who may watch and who may command."""

from __future__ import annotations

from typing import Any

import pytest

from magnetosuture_thread.console.client import MAX_UNACKNOWLEDGED, Outbox
from magnetosuture_thread.console.settings import ConsoleSettings, is_loopback, new_token, same_token
from magnetosuture_thread.settings.errors import ConfigurationError

TOKEN = "a-token-of-the-tests"


def settings(address: str = "127.0.0.1", **options: Any) -> ConsoleSettings:
    """Return settings of a server that is bound to an address."""
    return ConsoleSettings(address=address, token=TOKEN, **options)


def test_the_addresses_of_this_machine_alone():
    assert all(is_loopback(address) for address in ("127.0.0.1", "127.8.0.1", "::1", "localhost"))
    assert not any(is_loopback(address) for address in ("0.0.0.0", "::", "10.0.0.1", "rig.example", ""))


@pytest.mark.parametrize("address", ["0.0.0.0", "::", "rig.example"])
def test_an_address_that_others_reach_needs_a_token(address: str):
    with pytest.raises(ConfigurationError, match=r"console\.token.*expected a token"):
        ConsoleSettings(address=address)
    assert ConsoleSettings(address=address, token=TOKEN).token == TOKEN


ORIGINS = ("rig.example", "https://rig.example/page", "https://u@rig.example")


@pytest.mark.parametrize(
    ("values", "named"),
    [
        *(
            ({"token": token}, "console.token")
            for token in ("short", "a token with spaces in it", "ein-schönes-geheimnis")
        ),
        *(({"origin": origin}, "console.origin") for origin in ORIGINS),
        ({"address": ""}, "console.address"),
        ({"speed": 0.02, "max_speed": 0.01}, "console.speed"),
        ({"rate": 10.0, "hold_timeout": 0.1}, "console.rate"),
        ({"private_key": "key.pem"}, "console.private_key"),
    ],
)
def test_settings_that_do_not_fit_are_refused(values: dict, named: str):
    with pytest.raises(ConfigurationError, match=named) as refused:
        ConsoleSettings(**values)
    assert str(values.get("token") or "no token") not in str(refused.value)


def test_tokens_are_compared_whole():
    assert same_token(TOKEN, TOKEN)
    for wrong in ("", TOKEN[:-1], TOKEN + "x", TOKEN.upper(), None, 7, [TOKEN], "ü", "\ud800"):
        assert not same_token(wrong, TOKEN)
    assert not same_token("", "")


def test_every_start_has_a_token_of_its_own_and_it_is_in_the_fragment_alone():
    assert new_token() != new_token()
    assert ConsoleSettings(token="a%b#c" * 4).page_url(8090) == "http://127.0.0.1:8090/#token=" + "a%25b%23c" * 4
    assert settings("::1", certificate="c.pem").page_url(80).startswith("https://[::1]:80/#")


LOCAL, RIG = "127.0.0.1", "https://rig.example"
HOSTS: dict[str, list[tuple[str, dict[str, str]]]] = {  # by the bound address: what is accepted
    LOCAL: [(host, {}) for host in ("127.0.0.1:8090", "localhost:8090", "LOCALHOST:8090", "[::1]:8090")]
    + [(host, {"origin": RIG}) for host in ("rig.example", "RIG.example", "127.0.0.1:8090")],
    "0.0.0.0": [("192.168.1.5:8090", {})],
    "::": [("[fd00::5]:8090", {})],
    "rig.example": [("Rig.example:8090", {})],
}
# A name of somebody else's that points here is how a page of another site would get in.
OTHERS: dict[str, list[tuple[str, dict[str, str]]]] = {
    LOCAL: [(host, {}) for host in ("", "evil.example:8090", "localhost.evil.example:8090", "127.0.0.1", "127.0.0.1:1")]
    + [
        (host, {})
        for host in ("user@127.0.0.1:8090", "127.0.0.1:8090/x", "[::1:8090", "127.0.0.1:port", "10.0.0.5:8090")
    ]
    + [(host, {"origin": RIG}) for host in ("rig.example:8090", "evil.example", "rig.example.evil.example")],
    "0.0.0.0": [("evil.example:8090", {})],
    "192.168.1.5": [(host, {}) for host in ("127.0.0.1:8090", "localhost:8090", "192.168.1.6:8090")],
}


@pytest.mark.parametrize("address", HOSTS)
def test_own_names_and_those_of_a_certificate_or_a_proxy_are_accepted(address: str):
    for host, options in HOSTS[address]:
        assert settings(address, **options).host_refusal(host, 8090) == ""


@pytest.mark.parametrize("address", OTHERS)
def test_other_names_are_refused(address: str):
    for host, options in OTHERS[address]:
        assert "Host" in settings(address, **options).host_refusal(host, 8090)


def test_over_tls_a_host_without_a_port_is_the_default_one():
    assert settings("rig.example", certificate="c.pem").host_refusal("rig.example", 443) == ""
    assert settings("rig.example").host_refusal("rig.example", 443) != ""


@pytest.mark.parametrize(
    ("origin", "host", "options", "is_ours"),
    [
        ("", "127.0.0.1:8090", {}, True),
        ("http://127.0.0.1:8090", "127.0.0.1:8090", {}, True),
        *((origin, "127.0.0.1:8090", {}, False) for origin in ("http://evil.example", "null", "http://127.0.0.1:80")),
        *((origin, "127.0.0.1:8090", {}, False) for origin in ("https://127.0.0.1:8090", "http://localhost:8090")),
        ("https://127.0.0.1:8090", "127.0.0.1:8090", {"certificate": "c.pem"}, True),
        ("http://127.0.0.1:8090", "127.0.0.1:8090", {"certificate": "c.pem"}, False),
        *((RIG, host, {"origin": RIG}, True) for host in ("rig.example", "RIG.example", "127.0.0.1:8090")),
        ("http://rig.example", "rig.example", {"origin": RIG}, False),
        ("https://rig.example:8090", "rig.example", {"origin": RIG}, False),
        ("https://evil.example", "rig.example", {"origin": RIG}, False),
    ],
)
def test_only_our_own_page_opens_the_socket(origin: str, host: str, options: dict[str, str], is_ours: bool):
    assert ("Origin" not in settings(**options).origin_refusal(origin, host)) == is_ours


def test_a_page_that_is_behind_gets_the_newest_only():
    outbox = Outbox()
    sent = []
    for number in range(100):
        outbox.put("state", str(number))
        if (message := outbox.next()) is not None:
            sent.append(message)
    assert sent == [str(number) for number in range(MAX_UNACKNOWLEDGED)]
    outbox.acknowledge("state")
    assert outbox.next() == "99"
    assert outbox.next() is None
