"""Why a router cannot be reached, with real sockets: each cause is reported in its own words."""

import contextlib
import socket
import ssl
import threading
from pathlib import Path

import pytest

from penumbra.services.command import certs
from penumbra.shared.runtime import bus, diagnosis
from penumbra.tests.support.live import free_port


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> tuple[Path, Path]:
    """Certificates of two authorities."""
    out = tmp_path_factory.mktemp("certs")
    for name in ("ours", "theirs"):
        certs.make(out / name)
    return out / "ours", out / "theirs"


@contextlib.contextmanager
def listener(folder: Path | None = None):
    """A server that accepts, with TLS where it has certificates, and says nothing; its port."""
    context = None
    if folder is not None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(folder / "router.pem", folder / "router-key.pem")
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve():
            with contextlib.suppress(OSError):
                while True:
                    link, _ = server.accept()
                    with contextlib.suppress(OSError):
                        if context is not None:
                            link = context.wrap_socket(link, server_side=True)
                        link.close()

        threading.Thread(target=serve, daemon=True).start()
        yield server.getsockname()[1]


@pytest.mark.parametrize(
    ("endpoint", "words"),
    [
        ("tcp/127.0.0.1:99999", "expected tcp/HOST:PORT with a port from 1 to 65535, got port 99999"),
        ("tcp/127.0.0.1", "expected tcp/HOST:PORT with a port from 1 to 65535, got port none"),
        ("tcp/nowhere.invalid:7447", "unknown host 'nowhere.invalid'"),
    ],
)
def test_an_impossible_address_and_an_unknown_host_are_distinguished(endpoint, words):
    assert diagnosis.no_router(bus.Connection(connect=(endpoint,))).startswith(f"no router at {endpoint}: {words}")


@pytest.mark.parametrize(
    ("is_router", "is_secure", "words"),
    [
        (True, False, "another router runs there"),
        (True, True, "another router runs there"),
        (False, False, "what listens there does not answer as a Zenoh router"),
    ],
)
def test_a_port_that_is_taken_is_reported_with_who_has_it(folders, is_router, is_secure, words):
    secure = folders[0] if is_secure else None
    with contextlib.ExitStack() as stack:
        port = free_port() if is_router else stack.enter_context(listener())
        endpoint = f"{'tls' if is_secure else 'tcp'}/127.0.0.1:{port}"
        asked = bus.Connection("router", listen=(endpoint,), secure=secure)
        if is_router:
            stack.enter_context(bus.open_session(asked, threading.Event(), lambda: None, 5.0))
        with pytest.raises(bus.BusError, match=rf"the port of {endpoint} is taken: {words}; stop it.* --port {port + 1};"):
            bus.open_session(asked, threading.Event(), lambda: None, 0.0)


def test_a_port_where_nothing_listens_is_reported_with_what_to_start():
    where = f"tcp/127.0.0.1:{free_port()}"
    assert diagnosis.no_router(bus.Connection(connect=(where,))) == (
        f"no router at {where}: nothing listens there: start `penumbra router` or `penumbra up`, or give another endpoint "
        "(--connect, in Python endpoint=)"
    )


def test_a_server_that_is_no_router_is_reported():
    with listener() as port:
        assert "does not answer as a Zenoh router" in diagnosis.no_router(bus.Connection(connect=(f"tcp/127.0.0.1:{port}",)))


def test_a_plain_connection_to_a_secured_router_is_advised_to_use_secure(folders):
    with listener(folders[0]) as port:
        said = diagnosis.no_router(bus.Connection(connect=(f"tcp/127.0.0.1:{port}",)))
    assert said.endswith("without TLS: give a folder of `penumbra certs` (--secure FOLDER, in Python secure=)")


def test_a_secured_connection_to_a_plain_router_is_advised_to_leave_secure_out(folders):
    with listener() as port:
        said = diagnosis.no_router(bus.Connection(connect=(f"tls/127.0.0.1:{port}",), secure=folders[0]))
    assert said.endswith("that speaks TLS: leave --secure (in Python secure=) out, or start it with --secure")


def test_a_router_of_another_authority_is_distinguished_from_one_of_ours(folders):
    with listener(folders[1]) as port:
        said = diagnosis.no_router(bus.Connection(connect=(f"tls/127.0.0.1:{port}",), secure=folders[0]))
    assert f"with a certificate of the CA in {folders[0]}" in said


def test_a_folder_without_certificates_is_reported_before_anything_is_tried(tmp_path):
    with pytest.raises(bus.BusError, match=r"expected ca\.pem, viewer\.pem, viewer-key\.pem, got no readable ca\.pem"):
        bus.configuration(bus.Connection(connect=("tls/127.0.0.1:7447",), secure=tmp_path))
