"""Random inputs for everything that reads what others have made: `python -m penumbra.tests.fuzz --inputs 1000000`.

A decoder answers, or refuses with the one error that it documents, in a text of bounded length; whatever else happens is a fault,
which hypothesis makes small and prints. Processor time per input and memory are bounded too.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from rich.progress import Progress

from penumbra.services import flags
from penumbra.services.skin import decode as skin_decode
from penumbra.shared.cell import description as cells
from penumbra.shared.contract import messages
from penumbra.shared.skin import board
from penumbra.tests.support.inputs import KINDS, SPOILERS, damaged
from penumbra.tests.support.nodes import pose

BATCH = 1000
"""Inputs of one run of hypothesis, which remembers all of a run."""
MOST_S = 5.0
"""Processor time for one input; the slowest takes some tens of milliseconds."""
MOST_MB = 300.0
"""By which memory may grow over all inputs, hypothesis' own included."""
SHARE = {"messages": 0.6, "board": 0.3, "cell": 0.1}
"""Of the inputs."""

SMALL_CELL = b"""name: small
cameras: {front: {width: 64, height: 48, fx: 50, fy: 50, cx: 31.5, cy: 23.5, position: [0, -1, 1], look_at: [0, 0, 0]}}
pad_types:
  five:
    board: {size: [0.06, 0.06], ground: [0.05, 0.05], thickness: 0.0015}
    ring: {radii: [0.016, 0.021]}
    electrodes: {c: {disc: 0.015, law: {a1: 4.0, a2: 4.6e+4}}}
    chain: {excitation_V: 11.5, frequency_hz: 1.0e+5, feedback_ohm: 1.0e+6}
    rest: {a3: 0.2, noise: 6.2e-6}
pads: {p0: {type: five, position: [0, 0, 0]}}
targets: {forearm: {mesh: "body:forearm", labels: [forearm, hand], home: {position: [0, 0, 0.2]}}}
"""


def _good(kind: type[messages.Message]) -> bytes:
    """One small message of a kind."""
    now = pose(10**18)
    fields: dict[str, Any] = msgspec.structs.asdict(now) | {
        "sample_stamp_ns": now.stamp_ns,
        "information": now.covariance,
        "state": "in_range" if kind is messages.HapticPose else "tracking",
        "camera": "front",
        "image": np.zeros((2, 3, 3), np.uint8),
        "labels": np.zeros((2, 3), np.uint8),
        "volts": np.ones((2, 5), np.float32),
    }
    fields |= {"x0": 0, "y0": 0, "scale": 1, "period_ns": 10**6, "overlap": 0.9, "hidden": 0.1, "gap": 0.05, "confidence": 0.9}
    point = messages.SurfacePoint("arm/link5", (0.0, 0.0, 0.1), distance=0.05, along=0.005, across=0.02, gap=0.05)
    fields |= {"surface": {"pad": point}, "contact": "touch", "touched": ("pad",), "step": np.zeros(6)}
    if kind is messages.Joints:
        fields["position"] = np.zeros(7)
    return messages.encode(kind(**{name: fields[name] for name in kind.__struct_fields__}))


def check_message(kind: type[messages.Message], payload: bytes) -> None:
    _bounded(lambda: messages.encode(messages.decode(kind, payload, 10**18)), messages.BadMessage)


def check_board(data: bytes) -> None:
    def reply() -> None:
        found = board.decode(data)
        found.is_possible(100)
        found.fourier()

    _bounded(reply, board.PacketError)
    _bounded(lambda: board.Command.unpack(data).is_answered(4), board.PacketError)
    _bounded(lambda: board.realign_answer(data, 3), board.PacketError)
    _bounded(lambda: skin_decode.describe(skin_decode.from_hex(data)), board.PacketError)
    _bounded(lambda: skin_decode.describe(skin_decode.from_hex(data.hex().encode())), board.PacketError)


def check_cell(text: bytes, folder: Path) -> None:
    path = folder / "cell.yaml"
    path.write_bytes(text)
    _bounded(lambda: cells.load(path), cells.CellError, 30_000)


def _bounded(call: Callable[[], Any], error: type[Exception], most: int = 1000) -> None:
    started = time.thread_time()
    try:
        call()
    except error as refusal:
        assert len(str(refusal)) <= most, f"a refusal of {len(str(refusal))} characters"
    took = time.thread_time() - started
    assert took < MOST_S, f"{took:.1f} s for one input"


def _packets() -> st.SearchStrategy[bytes]:
    rng = np.random.default_rng(1)
    replies = [board.encode([128] * 6, rng.integers(0, 128 * board.FULL_SCALE, (6, n))) for n in board.SAMPLES_PER_CYCLE]
    good = [*replies, board.send_measures(100), board.set_frequency(1e5, 4), b"".join(board.realign_probes(3))]
    return st.binary(max_size=300) | st.sampled_from(good).flatmap(damaged)


def targets(folder: Path) -> dict[str, Callable[[], None]]:
    """Functions of hypothesis by name, each of which tries one input. folder: for cell files."""
    good = {kind: _good(kind) for kind in KINDS}
    payloads = st.sampled_from(list(good)).flatmap(lambda kind: st.tuples(st.just(kind), damaged(good[kind])))
    lines = SMALL_CELL.splitlines(keepends=True)
    shuffled = st.lists(st.sampled_from(lines) | st.sampled_from(SPOILERS), max_size=16).map(b"".join)
    texts = damaged(SMALL_CELL) | shuffled | st.text(max_size=200).map(lambda text: text.encode(errors="surrogatepass"))
    return {
        "messages": given(payloads)(lambda found: check_message(*found)),
        "board": given(_packets())(check_board),
        "cell": given(texts)(lambda text: check_cell(text, folder)),
    }


def run(name: str, inputs: int, start: int, folder: Path, done: Callable[[int], None] = lambda count: None) -> None:
    """Tries so many inputs, from a seed on. Raises whatever a decoder raised, with the smallest input that makes it."""
    for batch in range(0, inputs, BATCH):
        count = min(BATCH, inputs - batch)
        limits = settings(
            max_examples=count,
            database=None,
            deadline=None,
            phases=[Phase.generate, Phase.shrink],
            suppress_health_check=list(HealthCheck),
        )
        seed(start + batch)(limits(targets(folder)[name]))()
        done(count)


def memory_mb() -> float:
    """The most that this process has held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


@flags.command(
    "fuzz",
    __doc__ or "",
    flags.Option("--inputs", type=int, default=100000, help="of all decoders together"),
    flags.Option("--seed", type=int, default=1),
    example="python -m penumbra.tests.fuzz --inputs 10000",
)
def main(options: flags.Options) -> int:
    before = memory_mb()
    with tempfile.TemporaryDirectory() as folder, Progress() as progress:
        for name, share in SHARE.items():
            inputs = max(1, round(share * options.inputs))
            bar = progress.add_task(name, total=inputs)
            run(name, inputs, options.seed, Path(folder), partial(progress.advance, bar))
    grown = memory_mb() - before
    print(f"{options.inputs} inputs: every one answered or refused; memory grew by {grown:.0f} MB (at most {MOST_MB:.0f})")
    return int(grown > MOST_MB)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
