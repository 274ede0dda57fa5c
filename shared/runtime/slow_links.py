"""Slow links between hosts: what crosses them, and how little may wait before them.

A frame takes 14 s over a link of 64 kB/s, and whatever waits behind it comes as late. So what cannot cross in time is left out
before it enters the link, whole messages of it: each topic crosses as often as its `slow_hz` says. What does cross waits in no
long queue: TCP's send buffer and Zenoh's batches would hold seconds of such a link, so both are made small, and a message that
finds them full is dropped. Priorities (`topics.Priority`) let poses pass what waits.
"""

from __future__ import annotations

import socket
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

BATCH = 4096
"""Bytes that are sent in one piece, which nothing overtakes: a sixteenth of a second at 64 kB/s."""
SEND_BUFFER = 8192
"""Bytes that TCP may hold; the kernel takes twice as many, for its own bookkeeping."""


@dataclass(frozen=True)
class SlowLinks:
    """interfaces: network interfaces of this host, such as wlan0. rates_hz: how often each key may leave by them, 0 for never;
    a key that is not named leaves as often as it comes."""

    interfaces: tuple[str, ...]
    rates_hz: Mapping[str, float]

    def settings(self) -> dict[str, Any]:
        """Zenoh's settings of a router."""
        rule = {
            "id": "slow",
            "interfaces": self.interfaces,
            "flows": ["egress"],
            "messages": ["put"],
            "rules": [{"key_expr": key, "freq": rate_hz} for key, rate_hz in self.rates_hz.items()],
        }
        return {"downsampling": [rule], "transport/link/tx/batch_size": BATCH}

    def bounded(self, endpoints: Iterable[str], is_listening: bool) -> tuple[str, ...]:
        """Endpoints, to listen on or to connect to, with a small send buffer where they lie on these interfaces."""
        import psutil  # slow to import, and few have a slow link

        known = psutil.net_if_addrs()
        own = {address.address for name in self.interfaces for address in known.get(name, ())}
        return tuple(
            f"{endpoint}{';' if '#' in endpoint else '#'}so_sndbuf={SEND_BUFFER}"
            if endpoint.startswith(("tcp/", "tls/")) and _local(endpoint, is_listening) in (None, *own)
            else endpoint
            for endpoint in endpoints
        )


def _local(endpoint: str, is_listening: bool) -> str | None:
    """The address of this host that an endpoint uses; None where it may be any."""
    host, _, port = endpoint.partition("#")[0].partition("/")[2].rpartition(":")
    host = host.strip("[]")
    if is_listening:
        return None if host in ("0.0.0.0", "::") else host
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.connect(address)  # sends nothing: only finds the way
            return str(probe.getsockname()[0])
    except OSError:  # no way yet
        return None
