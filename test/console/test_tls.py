"""The server over TLS, by a certificate that the tests sign themselves, and behind a proxy that ends TLS."""

from __future__ import annotations

import ssl
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from aiohttp import web
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec

from magnetosuture_thread.console.server import server_context
from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.settings.errors import ConfigurationError
from test.console.visitor import TOKEN, Console, run


def test_nothing_is_served_without_tls(certificate: tuple[Path, Path]):
    path, key = map(str, certificate)
    trusting = ssl.create_default_context(cafile=path)
    context = server_context(ConsoleSettings(certificate=path, private_key=key))
    assert context is not None
    assert context.minimum_version is ssl.TLSVersion.TLSv1_2

    async def test(here: Console) -> None:
        async with here.session.get(here.url, ssl=trusting) as answer:
            assert answer.status == 200
        with pytest.raises(aiohttp.ClientError):
            await here.session.get(here.url.replace("https", "http"))
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await here.session.ws_connect(here.url + "socket", ssl=trusting, origin=here.url.replace("https", "http"))
        assert refused.value.status == 403

    run(test, certificate=path, private_key=key)


def test_certificates_that_cannot_be_used_are_refused_in_one_line(certificate: tuple[Path, Path], tmp_path: Path):
    path, key = certificate
    other = ec.generate_private_key(ec.SECP256R1())
    pem, kind = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
    (tmp_path / "other.pem").write_bytes(other.private_bytes(pem, kind, serialization.NoEncryption()))
    locked = serialization.BestAvailableEncryption(b"secret")
    (tmp_path / "locked.pem").write_bytes(other.private_bytes(pem, kind, locked))
    refused_settings: tuple[dict[str, Any], ...] = (
        {"certificate": str(tmp_path / "none.pem")},
        {"certificate": str(path)},  # without a key
        {"certificate": str(path), "private_key": str(tmp_path / "other.pem")},
        {"certificate": str(path), "private_key": str(tmp_path / "locked.pem")},
        {"certificate": str(key), "private_key": str(key)},
    )
    for given in refused_settings:
        with pytest.raises(ConfigurationError, match=r"console\.certificate") as refused:
            server_context(ConsoleSettings(**given))
        assert "\n" not in str(refused.value)
    (tmp_path / "both.pem").write_bytes(path.read_bytes() + key.read_bytes())
    assert server_context(ConsoleSettings(certificate=str(tmp_path / "both.pem"))) is not None
    assert server_context(ConsoleSettings()) is None


def test_behind_a_proxy_that_ends_tls_pages_of_its_origin_command(certificate: tuple[Path, Path]):
    """The proxy passes the Host on, or puts its own address there."""
    origin = "https://rig.example"

    async def test(here: Console) -> None:
        assert here.url == f"{origin}/"
        here.url = f"http://127.0.0.1:{here.server._port}/"
        for headers in ({"Host": "rig.example"}, {}):
            page = await here.page(origin=origin, headers=headers)
            await page.acquire_control()
            await page.send(type="release_control")
        for other in ("http://rig.example", "https://evil.example"):
            with pytest.raises(aiohttp.WSServerHandshakeError):
                await here.session.ws_connect(here.url + "socket", origin=other, headers={"Host": "rig.example"})
        async with here.session.get(here.url, headers={"Host": "evil.example"}) as answer:
            assert answer.status == web.HTTPForbidden.status_code

    run(test, origin=origin, token=TOKEN)
