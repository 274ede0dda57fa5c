"""The capacitive skin as the cell describes it: where its electrodes are, and the paper's response law both ways.

The law (paper, eq. sensor_approx): v = a3 + polarity * gain * a1 / (1 + a2 d^2), d the gap between electrode and skin [m].
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shared import cell as cells

Array = NDArray[np.float64]


def electrode_positions(pad_type: cells.PadType) -> Array:
    """Centroids (e, 3) [m] of a pad's electrodes in the pad's frame (z out of the pad)."""
    return np.array([[*electrode.centroid, 0.0] for electrode in pad_type.electrodes.values()])


def volts(law: cells.Law, gap: ArrayLike, gain: ArrayLike = 1.0) -> Array:
    """Noise-free amplitude [V] at gaps [m]; a negative gap counts as contact. Shapes broadcast."""
    d = np.maximum(gap, 0.0)
    return law.a3 + law.polarity * np.asarray(gain) * law.a1 / (1.0 + law.a2 * d * d)


def gap(law: cells.Law, amplitude: ArrayLike, gain: ArrayLike = 1.0, farthest: float = 1.0) -> Array:
    """The gap [m] that gives an amplitude [V]: the law's inverse, within [0, farthest]. Shapes broadcast."""
    peak = np.asarray(gain) * law.a1
    signal = np.clip(law.polarity * (np.asarray(amplitude) - law.a3), peak / (1.0 + law.a2 * farthest**2), peak)
    return np.sqrt(np.maximum(peak / signal - 1.0, 0.0) / law.a2)


class Skin:
    """All electrodes of a cell's pads in one row, n in all, in the order of the cell file.

    pads: names (p,); first (p + 1,): pad k holds electrodes first[k] to first[k + 1]; centroids (n, 3) in the frame of
    each one's pad; peak (n,) = gain * a1 [V], a2, a3, polarity (n,): the law; noise (n,) [V^2]: variance of one sample
    with the ADC's own rounding; reference (n,) [V]: where the ADC ends.
    Raises ValueError where the cell has no pads.
    """

    def __init__(self, cell: cells.Cell):
        if not cell.pads:
            raise ValueError(f"cell {cell.name} has no pads: the skin needs at least one under `pads:`")
        self.pads = tuple(cell.pads)
        self.links = tuple(pad.link for pad in cell.pads.values())
        self.T_link_pads = np.array([pad.T_link_pad for pad in cell.pads.values()])
        types = [cell.pad_types[pad.type] for pad in cell.pads.values()]
        counts = [len(kind.electrodes) for kind in types]
        self.first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        self.pad_of = np.repeat(np.arange(len(types)), counts)
        self.centroids = np.concatenate([electrode_positions(kind) for kind in types])
        gain = np.concatenate([[e.gain for e in kind.electrodes.values()] for kind in types])

        def spread(name: str) -> Array:
            return np.repeat([float(getattr(kind.law, name)) for kind in types], counts)

        self.peak, self.a2, self.a3, self.polarity = gain * spread("a1"), spread("a2"), spread("a3"), spread("polarity")
        self.reference = spread("adc_reference")
        self.lsb = self.reference / (2.0 ** spread("adc_bits") - 1.0)
        self.noise = spread("noise") + self.lsb**2 / 12.0
        self.range = np.array([kind.range for kind in types])

    def __len__(self) -> int:
        return len(self.centroids)

    def of(self, pad: int) -> slice:
        """Which electrodes belong to a pad."""
        return slice(int(self.first[pad]), int(self.first[pad + 1]))

    def T_world_pads(self, links: Mapping[str, Array] | None = None) -> Array:
        """Pad poses (p, 4, 4) for the poses of the links that carry them, by `ROBOT/LINK`; `world` needs none."""
        links = {"world": np.eye(4), **(links or {})}
        missing = sorted(set(self.links) - set(links))
        if missing:
            raise ValueError(f"poses of the links {missing} expected: pads sit on them; came {sorted(links)}")
        return np.stack([links[link] for link in self.links]) @ self.T_link_pads

    def positions(self, T_world_pads: Array) -> Array:
        """Electrode centroids (n, 3) [m] in the world."""
        T = T_world_pads[self.pad_of]
        return np.einsum("nij,nj->ni", T[:, :3, :3], self.centroids) + T[:, :3, 3]

    def signal(self, amplitude: ArrayLike) -> Array:
        """What the skin adds to an electrode's amplitude (..., n): polarity * (v - a3) [V], positive near a person."""
        return self.polarity * (np.asarray(amplitude) - self.a3)

    def volts(self, gaps: ArrayLike) -> Array:
        """Noise-free amplitudes (..., n) [V] at gaps (..., n) [m]; a negative gap counts as contact."""
        d = np.maximum(gaps, 0.0)
        return self.a3 + self.polarity * self.peak / (1.0 + self.a2 * d * d)

    def gaps(self, amplitude: ArrayLike, farthest: float = 1.0) -> Array:
        """Gaps (..., n) [m] of amplitudes (..., n) [V]: the law's inverse, within [0, farthest]."""
        signal = np.clip(self.signal(amplitude), self.peak / (1.0 + self.a2 * farthest**2), self.peak)
        return np.sqrt(np.maximum(self.peak / signal - 1.0, 0.0) / self.a2)


def link_names(robots: Mapping[str, Mapping[str, Array]]) -> dict[str, Array]:
    """Link poses of all robots under the names that pads use: {"panda": {"link7": T}} gives {"panda/link7": T}."""
    return {f"{robot}/{link}": T for robot, links in robots.items() for link, T in links.items()}
