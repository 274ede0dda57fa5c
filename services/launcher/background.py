"""`penumbra up --detach`: starts a launcher in the background and reports the progress of its start.

The launcher writes to a pipe what it is waiting for, one line at a time, and finally that the cell is up. If the pipe ends before
that, the launcher has ended, and its log says why.
"""

from __future__ import annotations

import math
import os
import re
import select
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from penumbra.services.command import runs
from penumbra.services.launcher.forkserver import import_path
from penumbra.shared.runtime import bus

UP = "up: "
"""Prefix of the launcher's last line, which names what is up."""
PATIENCE_S = 120.0
"""Time [s] after which a start that is not finished is reported; it continues. A first start compiles."""
TELL_S = 2.0
"""Minimum time [s] between two lines about the start: on a slow machine what is waited for changes every moment."""
ENDS_S = 10.0
NUMBERS = re.compile(r"[\d.]+ m?s\b")
"""Durations in the launcher's lines."""


def start(cell: str, argv: Sequence[str]) -> int:
    """Start `penumbra up ARGV...` in the background. Returns 0 once the cell is up, the launcher's exit code if it ended, or 1 if
    the cell is not up after PATIENCE_S. Raises BusError if the cell runs already."""
    if other := next((run for run in runs.running() if run.cell == cell and run.logs), None):
        raise bus.BusError(f"cell {cell} runs already (pid {other.pid}): end it with `penumbra down {cell}`")
    logs = runs.logs_of(cell)
    logs.mkdir(parents=True, exist_ok=True)
    log = logs / "launcher.log"
    if log.exists():
        log.replace(log.with_name("launcher.log.1"))
    said, say = os.pipe()
    words = [word for word in argv if word != "--detach"]
    with log.open("w") as output:
        launcher = subprocess.Popen(
            [sys.executable, "-m", "penumbra", "up", *words, "--notify", str(say)],
            env={**os.environ, **import_path()},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            pass_fds=[say],
            start_new_session=True,
        )
    os.close(say)
    try:
        return _follow(launcher, said, log)
    except KeyboardInterrupt:
        launcher.terminate()
        launcher.wait(ENDS_S)
        raise
    finally:
        os.close(said)


def _follow(launcher: subprocess.Popen[bytes], said: int, log: Path) -> int:
    """Print the launcher's lines until the cell is up, or the launcher has ended."""
    deadline = time.monotonic() + PATIENCE_S
    text = last = shown = ""
    told = -math.inf
    while select.select([said], [], [], max(0.0, deadline - time.monotonic()))[0]:
        part = os.read(said, 4096).decode(errors="replace")
        if not part:
            code = launcher.wait()
            print(log.read_text(errors="replace").strip(), file=sys.stderr)
            return code or 1
        text += part
        *lines, text = text.split("\n")
        for line in lines:
            if line.startswith(UP):
                print(f"{line.removeprefix(UP)} (pid {launcher.pid}): see penumbra ps, logs and down")
                return 0
            last = line
            # skip lines in which only durations changed
            if NUMBERS.sub("", line) != NUMBERS.sub("", shown) and time.monotonic() - told >= TELL_S:
                print(line, flush=True)
                shown, told = line, time.monotonic()
    print(f"not up after {PATIENCE_S:.0f} s, and still running (pid {launcher.pid}): {last}; see penumbra logs", file=sys.stderr)
    return 1
