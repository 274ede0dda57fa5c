"""Publishes the voltages of a capacitive skin: a thousand rows a second of every pad, in batches of 20.

    penumbra up --cell mycell.yaml               # in another terminal; a cell file without `sim` starts no emulator
    python examples/own_skin.py

Put the call of your electronics into `measure`. Boards of this project's kind need none of this: `penumbra skin` reads them.
"""

import contextlib
import sys
import time

import numpy as np

import penumbra

ROWS = 20
PERIOD_NS = 1_000_000


def measure(pad: penumbra.Pad) -> tuple[np.ndarray, np.ndarray]:
    """Amplitudes [V] (rows, electrodes), oldest first, and the stamp of each row [ns since the epoch]. Here: a pad at rest."""
    stamps_ns = time.time_ns() - PERIOD_NS * np.arange(ROWS)[::-1]
    return np.random.default_rng().normal(0.2, 0.0025, (ROWS, len(pad.electrodes))), stamps_ns


def main() -> None:
    with penumbra.connect() as cell:
        print(f"pads: {', '.join(cell.pads)}", flush=True)
        while True:
            for name in cell.pads:
                pad = cell.pad(name)
                pad.publish(*measure(pad))
            time.sleep(ROWS * PERIOD_NS * 1e-9)


if __name__ == "__main__":
    try:
        with contextlib.suppress(KeyboardInterrupt):
            main()
    except penumbra.BusError as error:  # no router, no cell
        sys.exit(str(error))
