"""`penumbra up`, from its first moment: what all processes are forked from imports while the launcher does."""

from __future__ import annotations

from services.launcher.forkserver import ForkServer


def main(argv: list[str]) -> int:
    """`penumbra up`"""
    forkserver = ForkServer()
    if not {"-h", "--help"} & set(argv):
        forkserver.start()
    try:
        from services.launcher import launch

        return launch.main(argv, forkserver)
    finally:
        forkserver.stop()
