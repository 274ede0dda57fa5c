"""The `penumbra` command. Each subcommand imports only what it needs: fusion starts without torch, `pose` at once."""

from __future__ import annotations

import ctypes
import importlib
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

COMMANDS = {
    "up": "start every process of a cell with a router, and show what they do",
    "restart": "restart services of the running `penumbra up`, one after another, without losing the pose",
    "scale": "change the number of replicas of a service of the running `penumbra up`",
    "router": "the meeting point of all processes",
    "emulator": "a simulated cell: frames, joints, skin and truth",
    "segmentation": "frames to masks (`segmentation infer`: of files; `segmentation train`: learn the network again)",
    "search": "masks to the camera's pose (`search refine`, `search track`: of any rigid mesh on mask files)",
    "posecnn": "frames to the camera's pose, in place of segmentation and search (`posecnn train`: learn the network again)",
    "skin": "sensing boards on serial ports to voltages (`skin decode`, `calibrate`, `characterise`, `model`: see each --help)",
    "haptics": "voltages to the skin's pose (`haptics train`: learn the network again)",
    "fusion": "both poses to the one pose",
    "pose": "print the current pose",
    "topics": "list the topics, and with --hz what really arrives",
    "sim": "steer the emulator: occlude, motion, pause, resume, speed, skin, state",
    "snapshot": "write a picture of the cell and its pose",
    "bench": "run a benchmark",
    "certs": "make certificates for a cell on a network",
    "doctor": "check this machine and say how to mend it",
}
SERVICES = ("router", "emulator", "segmentation", "search", "posecnn", "skin", "haptics", "fusion")
TOOLS = {
    ("segmentation", "train"): "services.segmentation.training.train:main",
    ("segmentation", "infer"): "services.segmentation.files:main",
    ("segmentation", "photographs"): "services.segmentation.training.photographs:main",
    ("search", "refine"): "services.search.objects.tools:refine",
    ("search", "track"): "services.search.objects.tools:track",
    ("posecnn", "train"): "services.posecnn.training.train:main",
    ("skin", "decode"): "services.skin.decode:main",
    ("skin", "calibrate"): "services.skin.calibration.calibrate:main",
    ("skin", "characterise"): "services.skin.calibration.characterise:main",
    ("skin", "model"): "services.skin.model:main",
    ("haptics", "train"): "services.haptics.train:main",
}
"""What a service's name can be followed by: `penumbra segmentation infer`."""
SWITCH_S = 0.0005
"""A reader thread waits at most this long for a computing one; Python's 5 ms would be half of the skin's period."""
FUNCTIONS = {
    "up": "services.launcher.launch:main",
    "restart": "services.command.steer:restart",
    "scale": "services.command.steer:scale",
    "pose": "services.command.look:pose",
    "topics": "services.command.look:list_topics",
    "sim": "services.command.look:sim",
    "snapshot": "services.command.snapshot:main",
    "certs": "services.command.certs:main",
    "doctor": "services.command.doctor:main",
}


def main(argv: list[str] | None = None) -> int:
    """Runs `penumbra ARGV...` and returns the exit code: 0 well, 1 failed, 2 asked for something that is not there."""
    argv = sys.argv[1:] if argv is None else argv
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(_usage())
        return 0 if argv else 2
    command, rest = argv[0], argv[1:]
    if command not in COMMANDS:
        print(f"penumbra: no command {command!r}: one of {', '.join(COMMANDS)} expected", file=sys.stderr)
        return 2
    try:
        return _run(command, rest)
    except ImportError as error:
        return _explain_import(command, error)
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # `penumbra topics | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        if not _is_ours(error):
            raise
        for line in str(error).splitlines():
            _complain(command, line)
        return 2


def _run(command: str, argv: list[str]) -> int:
    tool = TOOLS.get((command, argv[0])) if argv else None
    if tool is None and command in SERVICES:
        return serve(command, argv)
    if tool is None and command == "bench":
        return _bench(argv)
    module, _, function = (tool or FUNCTIONS[command]).partition(":")
    run: Callable[[list[str]], int | None] = getattr(importlib.import_module(module), function)
    return run(argv[1:] if tool else argv) or 0


def serve(name: str, argv: list[str]) -> int:
    """One service until SIGINT or SIGTERM."""
    die_with_parent()
    sys.setswitchinterval(SWITCH_S)
    from services import flags
    from shared.cell import description
    from shared.runtime import bus, logs
    from shared.runtime.node import Node

    module = importlib.import_module(f"services.{name}.service")
    _compile_on_full_disk()
    parser = flags.parser(name, module.__doc__ or COMMANDS[name])
    flags.add_metrics(parser)
    module.arguments(parser)
    options = parser.parse_args(argv)
    options.mode = options.mode or getattr(module, "MODE", None)
    logs.configure(options.log_level, options.log_format, name)
    _die_with_thread()
    node = Node(module.NAME, description.load(options.cell), bus.connection(options))
    with flags.metrics(parser, options.metrics_port, lambda: [node.health()]):
        module.start(node, options)
        node.run()
    return leave()


def leave() -> int:
    """Lets a process end whose node has run."""
    if threading.active_count() > 1:  # something hangs: it must not keep the process, even if Zenoh cannot clean /dev/shm then
        logging.shutdown()
        sys.stdout.flush()
        os._exit(0)
    return 0


def _bench(argv: list[str]) -> int:
    folder = Path(__file__).parents[2] / "tests" / "bench"
    names = sorted(path.stem for path in folder.glob("*.py") if path.stem != "__init__")
    if not argv or argv[0] not in names:
        print(f"penumbra bench: one of {', '.join(names) or '(none installed)'} expected", file=sys.stderr)
        return 2
    return importlib.import_module(f"tests.bench.{argv[0]}").main(argv[1:]) or 0


def _usage() -> str:
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:{width}}  {about}" for name, about in COMMANDS.items())
    return f"usage: penumbra COMMAND [--help] ...\n\nTracks a forearm beside a robot, also while something hides it.\n\n{rows}"


def _complain(command: str, line: str) -> None:
    from shared.runtime import logs

    if logs.is_json():
        logs.get(command).error(line)
    else:
        print(f"penumbra {command}: {line}", file=sys.stderr)


def _is_ours(error: Exception) -> bool:
    """Whether the text of an error already says what was expected, what came and what to do."""
    from shared.cell.description import CellError
    from shared.runtime.bus import BusError, Refused

    return isinstance(error, BusError | Refused | CellError | FileNotFoundError)


def _explain_import(command: str, error: ImportError) -> int:
    """Names the extra that installs what is missing; an error in our own code is not explained away."""
    name = (error.name or "").partition(".")[0]
    if not name or (name in ("services", "shared", "sim") and error.name != f"services.{command}"):
        raise error
    if error.name == f"services.{command}":
        print(f"penumbra {command}: not part of this installation", file=sys.stderr)
        return 2
    extra = command if command in (*SERVICES, "certs") else ("test" if command == "bench" else "all")
    print(f"penumbra {command}: {name} is not installed: pip install -e '.[{extra}]'", file=sys.stderr)
    return 2


def die_with_parent() -> None:
    """Ties a service to the launcher that started it: it must not stay behind, even if the launcher is killed with SIGKILL."""
    parent = os.environ.get("PENUMBRA_PARENT")
    if parent is None:
        return
    if sys.platform == "linux":
        PR_SET_PDEATHSIG = 1
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != int(parent):  # it died before we asked
        sys.exit(1)


def _die_with_thread() -> None:
    """Ends the process with the first of its threads that fails: it would look alive and do a part of its work only. Whoever
    started it starts it again. A thread without the memory to begin is one, for which its starter would wait for ever."""
    tell, tell_unraisable = threading.excepthook, sys.unraisablehook

    def end(failed: threading.ExceptHookArgs) -> None:
        try:
            tell(failed)
        finally:  # also without memory for words
            os._exit(1)

    def end_without_memory(failed: sys.UnraisableHookArgs) -> None:
        try:
            tell_unraisable(failed)
        finally:
            if failed.exc_type is MemoryError:
                os._exit(1)

    threading.excepthook, sys.unraisablehook = end, end_without_memory


def _compile_on_full_disk() -> None:
    """Lets numba go on where there is no room to keep what it has compiled: it would fail, and the service with it."""
    if "numba" not in sys.modules:
        return
    from numba.core.caching import IndexDataCacheFile

    from shared.runtime import logs

    save = IndexDataCacheFile.save

    def save_where_there_is_room(file: IndexDataCacheFile, key: Any, data: Any) -> None:
        with logs.lost_where_full():
            save(file, key, data)

    IndexDataCacheFile.save = save_where_there_is_room  # type: ignore[method-assign]


if __name__ == "__main__":
    sys.exit(main())
