"""Address of the web page, and access keys for it on a secured bus.

A key is derived from the private key of a certificate. Whoever has the certificate can derive it, and it is the same after a
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
"""Default port of the page."""
REPORT = "page"
"""Entry of the address in the dashboard's health report."""
KEY_BYTES = 18


def key(folder: Path, holder: str) -> str | None:
    """Access key of the holder of a certificate of `penumbra certs`; None where the folder has no readable private key of that
    name."""
    try:
        secret = (folder / f"{holder}-key.pem").read_bytes()
    except OSError:
        return None
    found = hmac.digest(hashlib.sha256(secret).digest(), b"penumbra page", "sha256")
    return base64.urlsafe_b64encode(found[:KEY_BYTES]).decode()


def link(address: str, key: str | None) -> str:
    """Link that opens the page. A browser does not send what follows the `#`, so the key stays out of logs and proxies."""
    return f"{address}#key={key}" if key else address


def address_in(reports: Iterable[Report]) -> str:
    """Address of the page from the health reports of a cell; empty where none contains it."""
    found = (report.report.get(REPORT) for report in reports)
    return next((str(page["address"]) for page in found if isinstance(page, dict) and page.get("address")), "")
