"""Zenoh configuration of a process's connection to the bus, with TLS where it is requested."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import zenoh

from penumbra.shared.contract import access
from penumbra.shared.runtime.slow_links import SlowLinks

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
SECURE_ENDPOINT = "tls/127.0.0.1:7447"
SECURE_PROTOCOLS = ("tls",)
PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws", "unixsock-stream", "unixpipe", "serial", "vsock")
POOL_BYTES = 8 << 20
"""Minimum size of the shared memory: nine frames of a small camera. With half of it, the second of two frames in transit
sometimes finds no space and goes through a socket, at 0.4 of the rate."""
SHARED_BYTES = 100_000
"""Minimum size [bytes] of a message in shared memory, such as a frame. Smaller ones are as fast through a socket, and leave
nothing behind: readers keep the pool of a publisher that died for as long as they live."""
ATTEMPT_MS = 500
"""Maximum time [ms] of one attempt to reach the router, inside Zenoh, where no signal is handled."""

RETRY = {"period_init_ms": 10, "period_max_ms": 200, "period_increase_factor": 1.5}
"""Pauses between the attempts: a router that died listens again after some 40 ms, and the pose is missing until then."""


class BusError(RuntimeError):
    """The bus cannot be used as requested. The text says what to do."""


@dataclass(frozen=True)
class Connection:
    """Settings of a session.

    `mode`: client (behind a router), peer or router; `connect`, `listen`: endpoints such as tcp/127.0.0.1:7447; `config`: a Zenoh
    JSON5 file, whose settings apply unless `connect` or `listen` override them; `secure`: a folder of `penumbra certs`: all
    traffic is encrypted, and every participant needs a certificate; `service`: the service that connects, which selects its
    certificate; `slow`: a router's links of low bandwidth; `is_announced`: whether a router answers searches on the network;
    `pool_bytes`: size of the shared memory that carries large messages to processes of the same host. Readers keep the pool of a
    terminated publisher for as long as they live, so it should be no larger than necessary.
    """

    mode: str | None = None
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    config: Path | None = None
    secure: Path | None = None
    service: str = access.VIEWER
    slow: SlowLinks | None = None
    is_announced: bool = False
    pool_bytes: int = POOL_BYTES

    @property
    def default(self) -> str:
        """The default endpoint."""
        return SECURE_ENDPOINT if self.secure else DEFAULT_ENDPOINT

    @property
    def where(self) -> str:
        """The endpoints as text."""
        return ", ".join(self.connect) or (f"the endpoints of {self.config}" if self.config else self.default)

    @property
    def whereabouts(self) -> str:
        """Where a router is expected, and the certificate that it needs."""
        return f"at {self.where}" + (f" with a certificate of the same CA as in {self.secure}" if self.secure else "")


def connection(options: SimpleNamespace) -> Connection:
    """Connection from the flags of `services.flags.BUS` and the environment."""
    connect = tuple(options.connect)
    if not connect and options.config is None and options.mode in (None, "client"):
        connect = connect_by_environment()
    return Connection(options.mode, connect, tuple(options.listen), options.config, options.secure)


def connect_by_environment() -> tuple[str, ...]:
    """Endpoints in $PENUMBRA_CONNECT; none where it is not set."""
    return tuple(os.environ.get("PENUMBRA_CONNECT", "").split())


def secure_by_environment() -> Path | None:
    """Folder in $PENUMBRA_SECURE; None where it is not set."""
    folder = os.environ.get("PENUMBRA_SECURE")
    return Path(folder) if folder else None


def mode(connection: Connection) -> str:
    """Mode of the connection or its file: client, peer or router. Raises BusError like `configuration`."""
    return str(json.loads(configuration(connection).get_json("mode")))


def configuration(connection: Connection) -> zenoh.Config:
    """Zenoh configuration of a connection. Raises BusError for a file or an endpoint that Zenoh does not accept."""
    try:
        config = zenoh.Config.from_file(str(connection.config)) if connection.config else zenoh.Config()
    except zenoh.ZError as error:
        raise BusError(f"--config {connection.config}: expected a Zenoh configuration (JSON5): {short(error)}") from None

    def is_set(key: str) -> bool:
        return connection.config is not None and config.get_json(key) not in ("null", "[]")

    mode = connection.mode or (json.loads(config.get_json("mode")) if is_set("mode") else "client")
    settings: dict[str, Any] = {"mode": mode}
    if connection.connect:
        settings["connect/endpoints"] = connection.connect
    elif mode == "client" and not is_set("connect/endpoints"):
        settings["connect/endpoints"] = [connection.default]
    if connection.listen:
        settings["listen/endpoints"] = connection.listen
    elif mode == "router" and connection.config is None:
        settings["listen/endpoints"] = [connection.default]
    defaults = {
        # one attempt is short, because Ctrl-C has no effect inside it; `open_session` repeats it, and later Zenoh itself does
        "connect/timeout_ms": ATTEMPT_MS,
        "connect/exit_on_failure": False,
        "connect/retry": RETRY,
        # processes connect to the router only: no peer is found by chance
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,  # no wait for scouting
        "transport/shared_memory/transport_optimization/pool_size": connection.pool_bytes,
        "transport/shared_memory/transport_optimization/message_size_threshold": SHARED_BYTES,
    }
    settings |= {key: value for key, value in defaults.items() if not is_set(key)}
    if connection.is_announced:
        nobody: dict[str, list[str]] = {"router": [], "peer": [], "client": []}
        settings |= {"scouting/multicast/enabled": True, "scouting/multicast/autoconnect": nobody}  # it opens no links itself
    if connection.config is None:
        settings["transport/link/tx/lease"] = 1000  # ms after which a frozen process counts as gone
    for endpoint in (*connection.connect, *connection.listen):
        protocols = SECURE_PROTOCOLS if connection.secure else PROTOCOLS
        if endpoint.partition("/")[0] not in protocols:  # Zenoh would retry it forever
            raise BusError(
                f"endpoint: expected PROTOCOL/ADDRESS, as in {connection.default}, got {endpoint!r}; "
                f"protocols{' with certificates' if connection.secure else ''}: {', '.join(protocols)}"
            )
    if connection.secure is not None:
        settings |= _secure(connection.secure, access.holder(connection.service, mode == "router"), mode)
    if connection.slow is not None:
        settings |= connection.slow.settings()
        for side in ("connect", "listen"):
            if (found := settings.get(f"{side}/endpoints")) is not None:
                settings[f"{side}/endpoints"] = connection.slow.bounded(found, side == "listen")
    for key, value in settings.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise BusError(f"{key}: expected what Zenoh accepts, got {json.dumps(value)}: {short(error)}") from None
    return config


def _secure(folder: Path, holder: str, mode: str) -> dict[str, Any]:
    """Zenoh's settings for mutual TLS, and a router's access control."""
    if mode == "peer":
        raise BusError("--mode: expected client or router with --secure, got peer; only a router checks who publishes what")
    files = {name: folder / f"{name}.pem" for name in ("ca", holder, f"{holder}-key")}
    for path in files.values():
        try:
            path.read_bytes()
        except OSError as error:
            names = ", ".join(file.name for file in files.values())
            raise BusError(
                f"certificates in {folder}: expected {names}, got no readable {path.name} ({error.strerror}); make them with "
                f"`penumbra certs --out {folder}`, or copy them from where they were made"
            ) from None
    tls = {
        "root_ca_certificate": str(files["ca"]),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }
    for side in ("listen", "connect"):
        tls |= {f"{side}_certificate": str(files[holder]), f"{side}_private_key": str(files[f"{holder}-key"])}
    settings: dict[str, Any] = {"transport/link/tls": tls, "transport/link/protocols": SECURE_PROTOCOLS}
    if mode == "router":
        settings |= {"access_control": access.control(), "low_pass_filter": access.limits()}
    return settings


def short(error: Exception) -> str:
    """First line of Zenoh's error text, without the location in its sources."""
    return str(error).partition(" at /")[0].strip().replace("\n", " ")[:300]
