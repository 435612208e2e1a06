"""Who may watch and who may command."""

from __future__ import annotations

import pytest

from magnetosuture_thread.console.access import (
    host_refusal,
    is_loopback,
    new_token,
    origin_refusal,
    page_url,
    same_token,
    server_origin,
)
from magnetosuture_thread.console.client import MAX_UNACKNOWLEDGED, Outbox
from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.errors import ConfigurationError

TOKEN = "a-token-of-the-tests"


def test_the_addresses_of_this_machine_alone():
    assert all(is_loopback(address) for address in ("127.0.0.1", "127.8.0.1", "::1", "localhost"))
    assert not any(is_loopback(address) for address in ("0.0.0.0", "::", "10.0.0.1", "rig.example", ""))


@pytest.mark.parametrize("address", ["0.0.0.0", "::", "192.168.1.5", "rig.example"])
def test_an_address_that_others_reach_needs_a_token(address: str):
    with pytest.raises(ConfigurationError, match=r"console\.token.*expected a token"):
        ConsoleSettings(address=address)
    assert ConsoleSettings(address=address, token=TOKEN).token == TOKEN


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"token": "short"}, "console.token"),
        ({"token": "a token with spaces in it"}, "console.token"),
        ({"token": "ein-schönes-geheimnis"}, "console.token"),
        ({"address": ""}, "console.address"),
        ({"speed": 0.02, "max_speed": 0.01}, "console.speed"),
        ({"rate": 10.0, "hold_timeout": 0.1}, "console.rate"),
        ({"needle_curvature": 900.0}, "console.needle_curvature"),
        ({"port": 70000}, "console.port"),
        ({"private_key": "key.pem"}, "console.private_key"),
        *(
            ({"origin": origin}, "console.origin")
            for origin in (
                "rig.example",
                "https://rig.example/page",
                "ftp://rig.example",
                "https://",
                "https://u@rig.example",
            )
        ),
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
    assert page_url(server_origin("127.0.0.1", 8090), "a%b#c") == "http://127.0.0.1:8090/#token=a%25b%23c"
    assert page_url(server_origin("::1", 80, "https"), "t").startswith("https://[::1]:80/#")


@pytest.mark.parametrize("host", ["127.0.0.1:8090", "localhost:8090", "LOCALHOST:8090", "[::1]:8090"])
def test_this_machines_own_names_are_good(host: str):
    assert host_refusal(host, "127.0.0.1", 8090) == ""


@pytest.mark.parametrize(
    "host",
    ["", "evil.example:8090", "localhost.evil.example:8090", "127.0.0.1", "127.0.0.1:1", "user@127.0.0.1:8090",
     "127.0.0.1:8090/x", "[::1:8090", "127.0.0.1:port", "10.0.0.5:8090"],
)  # fmt: skip
def test_other_names_are_refused(host: str):
    """A name of somebody else's that points here is how a page of another site would get in."""
    assert "Host" in host_refusal(host, "127.0.0.1", 8090)


def test_where_every_address_is_bound_only_figures_are_good():
    assert host_refusal("192.168.1.5:8090", "0.0.0.0", 8090) == ""
    assert host_refusal("evil.example:8090", "0.0.0.0", 8090) != ""
    assert host_refusal("[fd00::5]:8090", "::", 8090) == ""
    assert host_refusal("Rig.example:8090", "rig.example", 8090) == ""
    for host in ("127.0.0.1:8090", "localhost:8090", "192.168.1.6:8090"):
        assert host_refusal(host, "192.168.1.5", 8090) != ""


def test_the_name_of_a_certificate_or_a_proxy_is_good_besides():
    origin = "https://rig.example"
    for host in ("rig.example", "RIG.example", "127.0.0.1:8090"):
        assert host_refusal(host, "127.0.0.1", 8090, origin=origin) == ""
        assert origin_refusal("https://rig.example", host, allowed=origin) == ""
    for host in ("rig.example:8090", "evil.example", "rig.example.evil.example"):
        assert host_refusal(host, "127.0.0.1", 8090, origin=origin) != ""
    for other in ("http://rig.example", "https://rig.example:8090", "https://evil.example"):
        assert "expected https://rig.example" in origin_refusal(other, "rig.example", allowed=origin)


def test_over_tls_only_pages_that_came_over_tls_open_the_socket():
    assert host_refusal("rig.example", "rig.example", 443, scheme="https") == ""
    assert host_refusal("rig.example", "rig.example", 443) != ""
    assert origin_refusal("https://127.0.0.1:8090", "127.0.0.1:8090", scheme="https") == ""
    assert origin_refusal("http://127.0.0.1:8090", "127.0.0.1:8090", scheme="https") != ""


def test_only_our_own_page_opens_the_socket_in_a_browser():
    assert origin_refusal("", "127.0.0.1:8090") == ""
    assert origin_refusal("http://127.0.0.1:8090", "127.0.0.1:8090") == ""
    for origin in (
        "http://evil.example",
        "null",
        "https://127.0.0.1:8090",
        "http://127.0.0.1:80",
        "http://localhost:8090",
    ):
        assert "Origin" in origin_refusal(origin, "127.0.0.1:8090")


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
