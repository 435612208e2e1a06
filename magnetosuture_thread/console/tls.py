"""TLS of the page's server, by a certificate in a file."""

from __future__ import annotations

import ssl

from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.errors import ConfigurationError


def server_context(settings: ConsoleSettings) -> ssl.SSLContext | None:
    """Return the TLS context of a server, version 1.2 or later; None where the settings name no certificate.

    Raises:
        ConfigurationError: certificate or key cannot be read, do not belong together, or the key has a password.
    """
    if not settings.certificate:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        # Without this password OpenSSL would ask at the terminal.
        context.load_cert_chain(settings.certificate, settings.private_key or None, password=lambda: b"")
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ConfigurationError(
            f"{ConsoleSettings.GROUP}.certificate",
            settings.certificate,
            f"a PEM file with a certificate, and its key without a password in it or in private_key ({reason})",
        ) from None
    return context
