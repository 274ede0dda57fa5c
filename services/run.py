"""Runs a service as a process: it ends with its launcher, and with the first of its threads that fails."""

from __future__ import annotations

import ctypes
import importlib
import logging
import os
import signal
import sys
import threading
from collections.abc import Sequence
from functools import partial

from penumbra.services import flags
from penumbra.shared.contract.processes import Process

SWITCH_S = 0.0005
"""Interval [s] after which a computing thread yields to a waiting one; Python's 5 ms would be half of the skin's period."""


def serve(process: Process, options: flags.Options, argv: Sequence[str]) -> int:
    """Run one service until SIGINT or SIGTERM; returns its exit code. argv: the words from which the options were parsed."""
    die_with_parent()
    entitle(" ".join(["penumbra", process.name, *argv]))
    sys.setswitchinterval(SWITCH_S)
    from penumbra.shared import native
    from penumbra.shared.cell import description
    from penumbra.shared.runtime import bus, logs, scheduling
    from penumbra.shared.runtime.node import Node

    module = importlib.import_module(process.module)
    options.mode = options.mode or getattr(module, "MODE", None)
    logs.configure(options.log_level, options.log_format, process.name, ends_with_thread=True)
    node = Node(module.NAME, description.load(options.cell), bus.connection(options))
    with flags.metrics(options.metrics_port, lambda: [node.report()]):
        native.prepare(partial(node.progress, "compiling"))
        module.start(node, options)
        if process.goes_first:  # only now: what it prepares takes seconds
            scheduling.go_first()
        node.run()
    return leave()


def leave() -> int:
    """End the process after its node has run."""
    if threading.active_count() > 1:  # a hanging thread must not keep the process, even if Zenoh cannot clean /dev/shm then
        logging.shutdown()
        sys.stdout.flush()
        os._exit(0)
    return 0


def entitle(title: str) -> None:
    """Show a title as the command line of this process, in ps and top."""
    import setproctitle

    setproctitle.setproctitle(title)


def die_with_parent() -> None:
    """End this process when its launcher ends: it must not stay behind, even if the launcher is killed with SIGKILL."""
    parent = os.environ.get("PENUMBRA_PARENT")
    if parent is None:
        return
    if sys.platform == "linux":
        PR_SET_PDEATHSIG = 1
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != int(parent):  # the launcher died before the request
        sys.exit(1)
