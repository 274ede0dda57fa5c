"""Access control of the page: who may view it, and who may steer.

A browser also runs pages of other sites, which must neither view nor steer: `refusal` gives the reason to refuse a request that
our page did not send, or that reached us under a foreign name (DNS rebinding). Steering also needs a key, which only our page can
read. Without certificates everybody who reaches the page may view it, and the steering key is drawn at the start. With them
(`--secure`) there is a viewing key and a steering key, derived from the certificates of viewer and operator
(`shared.runtime.page`), and a client without a key sees nothing.
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
    # frames: another page must not embed ours and trick users into pressing its buttons
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
"""Headers of every answer."""


@dataclass(frozen=True)
class Keys:
    """The keys of the page. look: None if everybody may view it; steer: None if nobody may steer."""

    look: tuple[str, ...] | None
    steer: str | None

    def right(self, key: str) -> Right | None:
        """The right that a key grants, None for nothing."""
        given = key.encode()
        if self.steer is not None and hmac.compare_digest(given, self.steer.encode()):
            return "steer"
        if self.look is None or any(hmac.compare_digest(given, key.encode()) for key in self.look):
            return "look"
        return None


def hosts(address: str, named: Iterable[str] = ()) -> frozenset[str]:
    """The names under which a server that listens on an address is reached; named: those that a user adds."""
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
    """The reason to refuse a request, empty if it is allowed.

    headers: of the request. known: names of this server. needs_origin: whether the request must state that our page sent it, as a
    browser does for a websocket and for every request that changes something.
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
    # behind a proxy the page has TLS and we do not: either scheme is valid
    if found.scheme not in ("http", "https") or found.netloc.lower() != host.lower():
        return f"expected an Origin of the page itself, got {origin!r:.80}"
    return ""


def _name(host: str) -> str:
    """The name in a Host header, without the port; empty if there is none."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""
