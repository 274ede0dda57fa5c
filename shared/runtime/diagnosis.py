"""Diagnosis of an unreachable router: one sentence for each cause, with a remedy."""

from __future__ import annotations

import contextlib
import socket
import ssl
from pathlib import Path

from penumbra.shared.contract import access
from penumbra.shared.runtime.connection import Connection

ATTEMPT_S = 0.5
"""Timeout [s] of one attempt to connect to an address."""
OTHER = "give another endpoint (--connect, in Python endpoint=)"
START = f"start `penumbra router` or `penumbra up`, or {OTHER}"
STRANGER = "what listens there does not answer as a Zenoh router"
WITHOUT_TLS = "without TLS: give a folder of `penumbra certs` (--secure FOLDER, in Python secure=)"
BY_TCP = ("tcp", "tls", "ws")
"""Protocols for which a TCP connection shows whether a process listens."""


def no_router(connection: Connection) -> str:
    """Fault of each endpoint of a connection that does not open, one sentence per endpoint."""
    endpoints = connection.connect or (() if connection.config else (connection.default,))
    if not endpoints:
        return f"no router {connection.whereabouts}: {START}"
    return "\n".join(_of(endpoint, connection.secure) for endpoint in endpoints)


def _of(endpoint: str, secure: Path | None) -> str:
    protocol, _, rest = endpoint.partition("/")
    if protocol not in BY_TCP:
        return f"no router at {endpoint}: {START}"
    host, colon, digits = rest.partition("#")[0].rpartition(":")
    if not colon or not digits.isdecimal() or not 0 < int(digits) < 65536:
        got = digits if colon else "none"
        return f"no router at {endpoint}: expected {protocol}/HOST:PORT with a port from 1 to 65535, got port {got}"
    try:
        found = socket.getaddrinfo(host.strip("[]"), int(digits), type=socket.SOCK_STREAM)
    except OSError as error:
        return f"no router at {endpoint}: unknown host {host!r} ({error.strerror or error}): check its name, or give its address"
    with socket.socket(found[0][0], socket.SOCK_STREAM) as link:
        link.settimeout(ATTEMPT_S)
        try:
            link.connect(found[0][4])
        except ConnectionRefusedError:
            return f"no router at {endpoint}: nothing listens there: {START}"
        except OSError as error:
            return f"no router at {endpoint}: {host} does not answer ({error.strerror or error}): check the address and firewalls"
        return _who_listens(endpoint, link, host, secure)


def _who_listens(endpoint: str, link: socket.socket, host: str, secure: Path | None) -> str:
    """Fault where a process listens but no session opens."""
    try:
        context = _context(secure)
    except (OSError, ssl.SSLError) as error:
        return f"no router at {endpoint}: the certificates in {secure} cannot be used ({error}): make them with `penumbra certs`"
    try:
        with context.wrap_socket(link, server_hostname=host.strip("[]")):
            pass
    except ssl.SSLCertVerificationError as error:
        return (
            f"no router at {endpoint} with a certificate of the CA in {secure} for {host} ({error.verify_message}): use the "
            "folder of that router's `penumbra certs`, or name the host with --hosts"
        )
    except OSError:  # no TLS, or no answer
        if secure is not None or endpoint.startswith("tls/"):
            return f"no router at {endpoint} that speaks TLS: leave --secure (in Python secure=) out, or start it with --secure"
        return f"no router at {endpoint}: {STRANGER}: {OTHER}"
    if secure is None:
        return f"no router at {endpoint} {WITHOUT_TLS}"
    return f"no router at {endpoint} that accepts the certificate in {secure}: use the folder of that router's `penumbra certs`"


def _context(secure: Path | None) -> ssl.SSLContext:
    """TLS context of a client. Without certificates it accepts every router, only to find out whether the router uses TLS."""
    context = ssl.create_default_context()
    if secure is None:
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        return context
    context = ssl.create_default_context(cafile=str(secure / "ca.pem"))
    holder = access.holder(access.VIEWER, False)
    with contextlib.suppress(FileNotFoundError):
        context.load_cert_chain(secure / f"{holder}.pem", secure / f"{holder}-key.pem")
    return context
