"""The web page's address, and the keys of those who open it on a secured bus.

A key is derived from the private key of a certificate: whoever has the certificate can make it, and it is the same after a
restart and on every host.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
from collections.abc import Iterable
from pathlib import Path

from penumbra.shared.contract.report import Report

PORT = 8470
"""Where the page is served, where nothing else is asked for."""
REPORT = "page"
"""Name of the address in the health report of the dashboard."""
KEY_BYTES = 18


def key(folder: Path, holder: str) -> str | None:
    """The key of the holder of a certificate of `penumbra certs`; None where the folder has no private key of that name that can
    be read."""
    try:
        secret = (folder / f"{holder}-key.pem").read_bytes()
    except OSError:
        return None
    found = hmac.digest(hashlib.sha256(secret).digest(), b"penumbra page", "sha256")
    return base64.urlsafe_b64encode(found[:KEY_BYTES]).decode()


def link(address: str, key: str | None) -> str:
    """The link that opens the page. A browser does not send what follows the `#`: the key stays out of logs and proxies."""
    return f"{address}#key={key}" if key else address


def address_in(reports: Iterable[Report]) -> str:
    """The address of the page that the reports of a cell name, empty where they name none."""
    found = (report.report.get(REPORT) for report in reports)
    return next((str(page["address"]) for page in found if isinstance(page, dict) and page.get("address")), "")
