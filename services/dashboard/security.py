"""Who may open the page, and who may steer.

A browser runs pages of others beside ours. None of them may look, and none may steer: `refusal` says why a request is refused
that was not sent by our page, or that reached us by a name that is not ours (DNS rebinding). Steering also needs a key, which our
page alone can read. Without certificates everybody who reaches the page may look, and the key to steer is drawn at the start.
With them (`--secure`) there is a key to look and one to steer, derived from the certificates of viewer and operator
(`shared.runtime.page`), and who has neither sees nothing.
"""

from __future__ import annotations

import hmac
import ipaddress
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal
from urllib.parse import urlsplit

Right = Literal["look", "steer"]
LOCAL = frozenset({"localhost", "127.0.0.1", "::1"})
HEADERS = {
    # frames: another page must not show ours and have its buttons pressed by people who mean something else
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
"""Sent with every answer."""


@dataclass(frozen=True)
class Keys:
    """The keys of the page. look: None where everybody may look; steer: None where nobody may steer."""

    look: tuple[str, ...] | None
    steer: str | None

    def right(self, key: str) -> Right | None:
        """What somebody with this key may do, None for nothing."""
        given = key.encode()
        if self.steer is not None and hmac.compare_digest(given, self.steer.encode()):
            return "steer"
        if self.look is None or any(hmac.compare_digest(given, key.encode()) for key in self.look):
            return "look"
        return None


def hosts(address: str, named: Iterable[str] = ()) -> frozenset[str]:
    """The names by which a server is reached that listens on an address; named: those that a user adds."""
    found = {name.lower() for name in named} | LOCAL
    if not _is_any(address):
        found.add(address.lower())
    return frozenset(found)


def _is_any(address: str) -> bool:
    try:
        return ipaddress.ip_address(address).is_unspecified
    except ValueError:
        return False


def refusal(headers: Mapping[str, str], known: frozenset[str], needs_origin: bool) -> str:
    """Why a request is refused, empty where it is not.

    headers: of the request. known: names by which this server is reached. needs_origin: whether the request must say that our
    page sent it, as a browser's does for a websocket and for every request that changes something.
    """
    host = headers.get("Host", "")
    name = _name(host)
    if name not in known:
        return f"expected a request to {', '.join(sorted(known))}, got Host {host!r:.80}; penumbra dashboard --host adds a name"
    origin = headers.get("Origin")
    if origin is None:
        if needs_origin:
            return "expected an Origin, got none: this is for the page itself"
        site = headers.get("Sec-Fetch-Site", "none")
        return "" if site in ("none", "same-origin") else f"expected a request of the page itself, got one from {site}"
    try:
        found = urlsplit(origin)
    except ValueError:
        return f"expected an Origin of the page itself, got {origin!r:.80}"
    # behind a proxy the page has TLS and we have not: the scheme may be either
    if found.scheme not in ("http", "https") or found.netloc.lower() != host.lower():
        return f"expected an Origin of the page itself, got {origin!r:.80}"
    return ""


def _name(host: str) -> str:
    """The name in a Host header, without the port; empty where it has none."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""
