"""Slow links between hosts: which messages cross them, and how few may wait.

A frame takes 14 s over a link of 64 kB/s, and delays all messages behind it. So messages that cannot cross in time are dropped
before they enter the link: each topic crosses at the rate `slow_hz`. The others must not wait in long queues. TCP's send buffer
and Zenoh's batches would hold seconds of such a link, so both are made small, and a message that finds them full is dropped.
Priorities (`topics.Priority`) let poses overtake waiting messages.
"""

from __future__ import annotations

import socket
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

BATCH = 4096
"""Bytes that are sent at once, which nothing overtakes: a sixteenth of a second at 64 kB/s."""
SEND_BUFFER = 8192
"""Size [bytes] of TCP's send buffer. The kernel doubles it, for its own bookkeeping."""


@dataclass(frozen=True)
class SlowLinks:
    """Slow links of a router. interfaces: network interfaces of this host, such as wlan0. rates_hz: maximum rate per key over
    them, 0 for never; other keys are not limited."""

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
        """Endpoints to listen on or to connect to, with a small send buffer for those on these interfaces."""
        import psutil  # slow to import, and slow links are rare

        known = psutil.net_if_addrs()
        own = {address.address for name in self.interfaces for address in known.get(name, ())}
        return tuple(
            f"{endpoint}{';' if '#' in endpoint else '#'}so_sndbuf={SEND_BUFFER}"
            if endpoint.startswith(("tcp/", "tls/")) and _local(endpoint, is_listening) in (None, *own)
            else endpoint
            for endpoint in endpoints
        )


def _local(endpoint: str, is_listening: bool) -> str | None:
    """Address of this host that an endpoint uses; None where it may be any."""
    host, _, port = endpoint.partition("#")[0].partition("/")[2].rpartition(":")
    host = host.strip("[]")
    if is_listening:
        return None if host in ("0.0.0.0", "::") else host
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.connect(address)  # sends nothing: only selects the route
            return str(probe.getsockname()[0])
    except OSError:  # no route yet
        return None
