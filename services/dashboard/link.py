"""`penumbra dashboard link`: prints the links that open the page of a secured cell, for the certificates in a folder."""

from __future__ import annotations

from pathlib import Path

from penumbra.services import flags
from penumbra.shared.contract import access
from penumbra.shared.runtime import bus, page


@flags.command(
    "dashboard link",
    "Prints the links that open the page of a secured cell: one to look, one to steer, as far as the folder holds the "
    "certificates of a viewer and of an operator. Whoever has a link has its right.",
    flags.SECURE,
    flags.Option("--at", default=f"http://127.0.0.1:{page.PORT}/", metavar="ADDRESS", help="where the page is served"),
    example="penumbra dashboard link --secure certs",
)
def main(options: flags.Options) -> None:
    """Print one line per right. Raises BusError if the folder has neither certificate."""
    if options.secure is None:
        flags.refuse("expected --secure FOLDER, got none: without certificates everybody who reaches the page may open it")
    print("\n".join(links(options.secure, options.at)))


def links(folder: Path, address: str) -> list[str]:
    """The lines. Raises BusError if there are none."""
    holders = {access.VIEWER: "to look", access.OPERATOR: "to steer"}
    keys = {right: page.key(folder, holder) for holder, right in holders.items()}
    found = [f"{right:9} {page.link(address, key)}" for right, key in keys.items() if key]
    if not found:
        raise bus.BusError(f"--secure {folder}: expected viewer-key.pem or operator-key.pem, got neither that can be read")
    return found
