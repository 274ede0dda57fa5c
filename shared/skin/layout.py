"""Geometry and amplitudes [V] of the capacitive skin, as the cell file describes it.

An object near takes field lines away: the capacitance between ring and electrode falls by a `change` [fF], and the amplitude is v
= a3 + polarity * gain * sensitivity * change. `gain` is the calibrated signal relative to the design, about one. The field model
(`shared.skin.response`) gives the change for a limb at a pose. The paper's response law (eq. sensor_approx) replaces it where
only the gap d to the skin is known: v = a3 + polarity * a1 / (1 + a2 d^2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from penumbra.shared.body import anatomy
from penumbra.shared.cell import description as cells
from penumbra.shared.cell.pads import Pad, PadType
from penumbra.shared.geometry.rigid import Array

GAIN_GAPS = (0.02, 0.05, 0.10)
"""Gaps [m] at which a calibrated law is compared with the designed one."""
HOME_SIGMAS = 3.0
"""Maximum distance of a target from its home, in standard deviations."""
RANGES = 2.0
"""Maximum distance of a target, in ranges of a pad, at which the pad may sense it."""


def electrode_positions(pad_type: PadType) -> Array:
    """Centroids (e, 3) [m] of a pad's electrodes in the pad's frame (z out of the pad)."""
    return np.array([[*electrode.centroid, 0.0] for electrode in pad_type.electrodes.values()])


class Skin:
    """All n electrodes of a cell's p pads, in the order of the cell file.

    pads: names (p,); first (p + 1,): pad k has electrodes first[k] to first[k + 1]; names (n,) as PAD/ELECTRODE; centroids (n, 3)
    [m] in the frame of the electrode's pad; peak (n,) = a1 [V], a2, a3, polarity (n,): the calibrated law, or the designed one
    where there is none; gain (n,): signal relative to the designed one; sensitivity (n,) [V/fF]; noise (n,) [V^2]: variance of
    one sample of a millisecond; lsb (n,) [V]: a step of the converter; full_scale (n,) [V]: maximum amplitude.

    Raises ValueError where the cell has no pads.
    """

    def __init__(self, cell: cells.Cell):
        if not cell.pads:
            raise ValueError(f"cell {cell.name} has no pads: the skin needs at least one under `pads:`")
        self.pads = tuple(cell.pads)
        self.links = tuple(pad.link for pad in cell.pads.values())
        self.T_link_pads: Array = np.array([pad.T_link_pad for pad in cell.pads.values()])
        types = [cell.pad_types[pad.type] for pad in cell.pads.values()]
        counts = [len(kind.electrodes) for kind in types]
        self.first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        self.pad_of = np.repeat(np.arange(len(types)), counts)
        self.centroids: Array = np.concatenate([electrode_positions(kind) for kind in types])
        self.names = tuple(f"{name}/{e}" for name, kind in zip(cell.pads, types, strict=True) for e in kind.electrodes)
        laws = [
            pad.calibration.get(electrode) or kind.law(electrode)
            for pad, kind in zip(cell.pads.values(), types, strict=True)
            for electrode in kind.electrodes
        ]
        self.peak: Array = np.array([law.a1 for law in laws])
        self.a2: Array = np.array([law.a2 for law in laws])
        self.a3: Array = np.array([law.a3 for law in laws])
        self.polarity: Array = np.array([float(law.polarity) for law in laws])
        self.noise: Array = np.array([law.noise for law in laws])
        designed = [e.law for kind in types for e in kind.electrodes.values()]
        a1, a2, gaps = np.array([e.a1 for e in designed]), np.array([e.a2 for e in designed]), np.array(GAIN_GAPS)[:, None]
        ratio = self.peak / (1.0 + self.a2 * gaps**2) / (a1 / (1.0 + a2 * gaps**2))
        self.gain: Array = np.exp(np.log(ratio).mean(axis=0))  # a1 alone is correlated with a2
        self.sensitivity: Array = np.repeat([kind.chain.sensitivity for kind in types], counts)
        self.full_scale = np.repeat([kind.chain.adc_reference / 2.0 for kind in types], counts)
        self.lsb = np.repeat([kind.chain.adc_reference / (2.0**kind.chain.adc_bits - 1.0) for kind in types], counts)
        self.range = np.array([kind.range for kind in types])

    def __len__(self) -> int:
        return len(self.centroids)

    def of(self, pad: int) -> slice:
        """Slice of a pad's electrodes."""
        return slice(int(self.first[pad]), int(self.first[pad + 1]))

    def T_world_pads(self, links: Mapping[str, Array] | None = None) -> Array:
        """Pad poses (p, 4, 4), given the poses of the links that carry them, by `ROBOT/LINK`; `world` is not needed."""
        links = {"world": np.eye(4), **(links or {})}
        missing = sorted(set(self.links) - set(links))
        if missing:
            raise ValueError(f"expected the poses of the links {missing}, which carry pads, got {sorted(links)}")
        return np.stack([links[link] for link in self.links]) @ self.T_link_pads

    def positions(self, T_world_pads: Array) -> Array:
        """Electrode centroids (n, 3) [m] in the world."""
        T = T_world_pads[self.pad_of]
        turned: Array = np.einsum("nij,nj->ni", T[:, :3, :3], self.centroids)
        return turned + T[:, :3, 3]

    def signal(self, amplitude: ArrayLike) -> Array:
        """Contribution of the skin to electrodes' amplitudes (..., n): polarity * (v - a3) [V], positive near a person."""
        return self.polarity * (np.asarray(amplitude, float) - self.a3)

    def amplitude(self, change: ArrayLike) -> Array:
        """Noise-free amplitudes (..., n) [V] for changes of capacitance (..., n) [fF], up to full scale."""
        analog: Array = self.a3 + self.polarity * self.gain * self.sensitivity * np.asarray(change)
        return np.clip(analog, 0.0, self.full_scale)

    def volts(self, gaps: ArrayLike) -> Array:
        """Noise-free amplitudes (..., n) [V] of the response law at gaps (..., n) [m]. A negative gap counts as contact."""
        d = np.maximum(gaps, 0.0)
        return self.a3 + self.polarity * self.peak / (1.0 + self.a2 * d * d)


@dataclass(frozen=True)
class Near:
    """Pads of a cell that may sense one of its targets: all pads on robots, and other pads near the target's home. `cell`: the
    cell with these pads only; pads (k,) and electrodes (m,): their indices in the whole cell's `Skin`."""

    cell: cells.Cell
    pads: NDArray[np.int64]
    electrodes: NDArray[np.int64]

    @staticmethod
    def of(cell: cells.Cell, target: str) -> Near:
        found = cell.targets[target]
        limb = float(np.linalg.norm(anatomy.target_mesh(found, cell).vertices, axis=1).max())
        reach = HOME_SIGMAS * found.home_spread.position + limb

        def is_near(pad: Pad) -> bool:
            away = np.linalg.norm(np.subtract(pad.position, found.home.position))
            return pad.link != "world" or bool(away < reach + RANGES * cell.pad_types[pad.type].range)

        pads = {name: pad for name, pad in cell.pads.items() if is_near(pad)}
        places = np.array([place for place, name in enumerate(cell.pads) if name in pads], dtype=np.int64)
        counts = [len(cell.pad_types[pad.type].electrodes) for pad in cell.pads.values()]
        whose = np.repeat(np.arange(len(counts)), counts)
        return Near(cell.model_copy(update={"pads": pads}), places, np.flatnonzero(np.isin(whose, places)))


def link_names(robots: Mapping[str, Mapping[str, Array]]) -> dict[str, Array]:
    """Link poses of all robots with names as in pads: {"panda": {"link7": T}} gives {"panda/link7": T}."""
    return {f"{robot}/{link}": T for robot, links in robots.items() for link, T in links.items()}


def pad_poses(cell: cells.Cell, links: Mapping[str, Array]) -> dict[str, Array]:
    """T_world_pad (4, 4) of the pads on the world and on the links with a known pose, named as in `link_names`."""
    known = {"world": np.eye(4), **links}
    return {name: known[pad.link] @ pad.T_link_pad for name, pad in cell.pads.items() if pad.link in known}
