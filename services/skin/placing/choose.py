"""Selects pads from many candidates: greedily, then by exchanges until no exchange helps.

The cost of a choice is the expected error of the position, by the Cramér-Rao bound with a prior, averaged over scenes: A-optimal
design. Greedy choice comes within 1 - 1/e of the best one where gains diminish (Nemhauser, Wolsey, Fisher 1978, DOI
10.1007/BF01588971; for placing sensors Krause, Singh, Guestrin 2008, JMLR 9:235). A-optimal costs have nearly this property
(Chamon, Ribeiro 2017, Approximate supermodularity bounds for experimental design, NeurIPS); exchanges improve on the rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from penumbra.shared.geometry.rigid import Array
from penumbra.shared.skin import bound

GAIN = 1e-3
"""Minimum relative gain of the cost for which a pad is exchanged."""
SWEEPS = 10
"""Maximum number of rounds of exchanges over all pads; few are needed."""


class Choice:
    """A selection problem. information (n, c, 8, 8): of each candidate in each scene; prior (8, 8); overlaps (c, c): pairs that
    cannot be chosen together."""

    def __init__(self, information: Array, prior: Array, overlaps: NDArray[np.bool_]):
        self._information, self._prior, self._overlaps = information, prior, overlaps

    def errors(self, chosen: Sequence[int]) -> Array:
        """Expected errors (n,) [m] of the position in each scene with these candidates."""
        return bound.position_error(self._total(chosen))

    def more(self, chosen: Sequence[int], number: int) -> list[int]:
        """Add candidates greedily, up to `number` in all or as many as there is room for."""
        out = list(chosen)
        while len(out) < number and (free := self._free(out)).any():
            costs = self._costs(out, free)
            out.append(int(np.argmin(costs)))
        return out

    def exchanged(self, chosen: Sequence[int]) -> list[int]:
        """Exchange candidates until no single exchange improves the cost."""
        out = list(chosen)
        best = float(self.errors(out).mean())
        for _ in range(SWEEPS):
            before = list(out)
            for place in range(len(out)):
                rest = out[:place] + out[place + 1 :]
                costs = self._costs(rest, self._free(rest))
                other = int(np.argmin(costs))
                if costs[other] < best * (1.0 - GAIN):
                    out[place], best = other, float(costs[other])
            if out == before:
                break
        return out

    def _total(self, chosen: Sequence[int]) -> Array:
        return self._prior + self._information[:, list(chosen)].sum(axis=1)

    def _free(self, chosen: Sequence[int]) -> NDArray[np.bool_]:
        """Candidates (c,) that can be added."""
        free = np.asarray(~self._overlaps[:, list(chosen)].any(axis=1))
        free[list(chosen)] = False
        return free

    def _costs(self, chosen: Sequence[int], free: NDArray[np.bool_]) -> Array:
        """The cost (c,) with one more candidate; infinite for one that cannot be added."""
        costs, total = np.full(len(free), np.inf), self._total(chosen)
        for candidate in np.flatnonzero(free):
            costs[candidate] = bound.position_error(total + self._information[:, candidate]).mean()
        return costs
